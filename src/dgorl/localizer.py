"""The public door: one robot's Localizer, and the Team behind it that every robot computes alike. Alg. 3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import degrees, hypot, isfinite, sqrt

import numpy as np

from dgorl.configuration import Configuration
from dgorl.estimate import Estimate, PeerEstimate, Status
from dgorl.expansion.ticks import Weighed, hypotheses_now
from dgorl.graph import optimized_graph
from dgorl.history import WORLD_KEY, History
from dgorl.measurements import LARGEST, WORLD, Measurement
from dgorl.nodes import SPACING, Memo
from dgorl.places import places_of
from dgorl.se2 import Array
from dgorl.team_state import TeamState, team_state
from dgorl.tracks import Track, TrackKey
from dgorl.window import grow

RETAINED = 10.0
"""Raw data is kept this much longer [s] than the history and the window need."""


@dataclass(frozen=True)
class TeamNow:
    """The team at one time: joined components, and for each cluster its hypotheses, most probable first."""

    joined: tuple[TeamState, ...]
    clusters: tuple[tuple[Weighed, ...], ...]
    suspects: frozenset[TrackKey] = frozenset()
    """members that do not fit their component"""


class Team:
    """What the whole team knows: a pure function of the measurements admitted and of ``now``."""

    def __init__(self, configuration: Configuration | None = None) -> None:
        self.configuration = configuration or Configuration()
        self.history = History(self.configuration)
        self._memo = Memo(self.history)
        self._last_node = -np.inf

    def add(self, measurement: Measurement) -> None:
        """Take a measurement, own or received, in any order, twice without harm."""
        self.history.add(measurement)

    def update(self, now: float) -> TeamNow:
        """Components of more than one member and hypotheses about the others, optimised and carried on to ``now`` [s].

        Raises ValueError when ``now`` is not a time.
        """
        if not abs(now) <= LARGEST:
            raise ValueError(f"now must be a time in seconds, got {now}")
        g = self._memo.due(now)
        self._memo.invalidate(self.history.admit(now, node_due=g > self._last_node))
        if g > self._last_node:
            self._last_node = g
            self._forget(now)
        node, low = self._memo.node(g), self._memo.low(g)
        states = []
        for component in grow(self.history, node.components, low, now, node.since):
            if len(component.stretches) > 1:
                try:
                    states.append(team_state(self.history, component, low, now))
                except ValueError:  # the graph leaves a pose undetermined: its members stay unjoined
                    continue
        clusters = (hypotheses_now(self.history, cluster, now) for cluster in node.clusters)
        return TeamNow(
            tuple(states), tuple(tuple(weighed) for weighed in clusters if weighed), frozenset(node.suspects)
        )

    def _forget(self, now: float) -> None:
        history = self.configuration.history
        self._memo.forget(now - history - RETAINED - SPACING)
        if self.configuration.window != "all":
            self.history.forget(now - history - float(self.configuration.window) - RETAINED - 2 * SPACING)


class Localizer:
    """Where are my peers? One robot's relative localization from its own and received measurements.

    robot: this robot's name. team: share one between the localizers of several robots that hear the same.
    """

    def __init__(self, robot: str, config: Configuration | None = None, *, team: Team | None = None) -> None:
        self.robot = robot
        self.team = team or Team(config)

    def add(self, measurement: Measurement) -> None:
        """Take a measurement, own or received, in any order, twice without harm; nothing is computed yet."""
        self.team.add(measurement)

    def update(self, now: float) -> Estimate:
        """Every peer's relative pose at ``now`` [s] (Alg. 3: formation → expansion → optimisation)."""
        return self.view(self.team.update(now), now)

    def view(self, team: TeamNow, now: float) -> Estimate:
        """The team as this robot sees it: the ego frame is applied last."""
        history = self.team.history
        own = _current(history, self.robot, now)
        state = next((s for s in team.joined if own is not None and own.key in s.members), None)
        relative = state.relative(own.key) if state is not None and own is not None else {}
        possible = _possible(team, own)
        peers = {}
        for name in sorted(history.trails):
            track = _current(history, name, now)
            if name != self.robot and track is not None:
                peers[name] = self._peer(own, track, relative, possible, team.suspects, now)
        if WORLD_KEY in relative:
            pose, covariance = relative[WORLD_KEY]
            status, reason = _status(pose, covariance, self.team.configuration)
            peers[WORLD] = PeerEstimate(pose, covariance, status, 1.0, 0.0, reason)
        return Estimate(
            self.robot,
            now,
            peers,
            dict(history.rejected),
            lambda: optimized_graph(self.robot, own, state, relative),
        )

    def _peer(
        self,
        own: Track | None,
        track: Track,
        relative: Mapping[TrackKey, tuple[Array, Array]],
        possible: Sequence[tuple[float, Mapping[TrackKey, tuple[Array, Array]]]],
        suspects: frozenset[TrackKey],
        now: float,
    ) -> PeerEstimate:
        """METHOD §3, Status."""
        history, configuration = self.team.history, self.team.configuration
        age = max(now - (track.end - configuration.motion.lag), 0.0)
        if own is None:
            return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, "no odometry of our own", "drive")
        if age > configuration.status.age:
            reason = f"no odometry from {track.key.robot} for {age:.0f} s"
            return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, reason, "restore the link")
        if track.key in relative:
            pose, covariance = relative[track.key]
            status, reason = _status(pose, covariance, configuration)
            if track.key in suspects or own.key in suspects:
                who = track.key.robot if track.key in suspects else self.robot
                reason = (
                    f"inconsistent: {who}'s odometry and readings contradict the team's; carried, or a faulty sensor"
                )
                status = Status.UNOBSERVABLE
            return PeerEstimate(pose, covariance, status, 1.0, age, reason)
        places = places_of(track.key, possible)
        if places:
            best = places[0]
            count = f"{len(places)} places fit" if len(places) > 1 else "one place fits, not yet for long enough"
            reason = f"{count}, the best with probability {best.probability:.3f}"
            return PeerEstimate(best.pose, best.covariance, Status.AMBIGUOUS, best.probability, age, reason, "", places)
        if history.linked(own, track):
            reason = "measurements link us, but too few to tell where it is"
            return PeerEstimate(None, None, Status.AMBIGUOUS, 0.0, age, reason, "keep moving within range")
        reason = "no measurement links us"
        return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, reason, "come into range")


def _possible(team: TeamNow, own: Track | None) -> Sequence[tuple[float, Mapping[TrackKey, tuple[Array, Array]]]]:
    """The hypotheses of the cluster a track stands in, seen from it."""
    for cluster in team.clusters:
        if own is not None and any(own.key in state.members for _, state in cluster):
            return [(p, state.relative(own.key)) for p, state in cluster if own.key in state.members]
    return []


def _current(history: History, robot: str, now: float) -> Track | None:
    trail = history.trails.get(robot)
    track = trail.at(now) if trail else None
    return track if track is not None and track.core.known(now) > -np.inf else None


def _status(pose: Array, covariance: Array, configuration: Configuration) -> tuple[Status, str]:
    """Status of a joined peer, from its posterior alone. METHOD §3."""
    limits = configuration.status
    (x, y, _), ((a, b, _), (_, d, _), (_, _, t)) = pose.tolist(), covariance.tolist()
    sigma = sqrt(max((a + d) / 2 + sqrt(((a - d) / 2) ** 2 + b * b), 0.0))
    accuracy = max(limits.accuracy, limits.accuracy_per_metre * hypot(x, y))
    heading = degrees(sqrt(max(t, 0.0)))
    if not (isfinite(sigma) and isfinite(heading)) or sigma > accuracy:
        return Status.UNOBSERVABLE, f"position 1σ {sigma:.2f} m exceeds {accuracy:.2f} m"
    if heading > limits.heading:
        return Status.POSITION, f"heading 1σ {heading:.0f}° exceeds {limits.heading:.0f}°"
    return Status.TRACKED, ""
