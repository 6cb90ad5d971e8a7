"""The team as one robot sees it: the ego frame is applied last. METHOD §1, §3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from types import MappingProxyType

import numpy as np

from dgorl.estimate import ClockState, Estimate, PeerEstimate, Status
from dgorl.expansion.hypotheses import Motion
from dgorl.expansion.ticks import Weighed
from dgorl.formation import contacts, rpmg
from dgorl.graph import optimized_graph
from dgorl.history import WORLD_KEY, History
from dgorl.measurements import WORLD
from dgorl.places import places_of
from dgorl.relative import Relative
from dgorl.status import (
    advice,
    after_gap,
    ambiguous_reason,
    inconsistent,
    joined_status,
    own_part,
    turned_since,
    without_own,
)
from dgorl.team_state import TeamState
from dgorl.tracks import Track, TrackKey

UNPLACED = ("its clock is not known yet", "exchange messages both ways")
"""Reason and way out while a robot's stamps cannot be told in team time."""

Peers = Mapping[TrackKey, Relative]
"""How a robot sees the others, by track."""


@dataclass(frozen=True)
class ClusterNow:
    """The hypotheses about components that are not joined, most probable first; motion: as in Cluster."""

    hypotheses: tuple[Weighed, ...]
    motion: Motion
    unfit: frozenset[TrackKey] = frozenset()
    """tracks that no hypothesis explains"""
    sure: Sequence[tuple[TrackKey, TrackKey]] = ()
    """pairs that are located though not joined"""
    passing: tuple[TrackKey, TrackKey] | None = None
    """who have passed one another, when the side they took is open"""


@dataclass(frozen=True)
class TeamNow:
    """The team at one time: joined components, clusters of others, and members that do not fit their component."""

    joined: tuple[TeamState, ...]
    clusters: tuple[ClusterNow, ...]
    suspects: frozenset[TrackKey] = frozenset()
    doubted: tuple[TeamState, ...] = ()
    """of the components with a suspect, what the others are without it"""
    clocks: Mapping[str, ClockState] = field(default_factory=lambda: MappingProxyType({}))
    """where clocks are estimated, those of all robots placed"""
    unplaced: frozenset[str] = frozenset()
    """robots heard of whose clock is not placed yet"""


APART = 60.0
"""A robot whose odometry and whose readings lie farther apart than this [s] stamps them with two clocks."""


class View:
    """What ``robot`` knows of its peers at ``now`` [s]."""

    def __init__(self, history: History, team: TeamNow, robot: str, now: float) -> None:
        self._history, self._team, self._robot, self._now = history, team, robot, now
        self._own = _current(history, robot, now)
        own = self._own.key if self._own is not None else None
        self._ahead = own_part(history, self._own, now) if self._own is not None else None
        self._state = next((s for s in team.joined if own in s.members), None)
        self._relative: Peers = self._state.relative(own) if self._state is not None and own is not None else {}
        for state in team.doubted:
            if own is not None and own in state.members:
                self._relative = {**self._relative, **state.relative(own)}
        self._cluster = next((c for c in team.clusters if any(own in state.members for _, state in c.hypotheses)), None)
        self._possible: Sequence[tuple[float, Peers]] = []
        if self._cluster is not None and own is not None:
            self._possible = [(p, s.relative(own)) for p, s in self._cluster.hypotheses if own in s.members]

    def estimate(self) -> Estimate:
        """Every peer that was ever heard of, and the optimised graph."""
        history = self._history
        peers = {}
        for name in sorted(self._team.unplaced - {self._robot}):
            peers[name] = PeerEstimate(None, None, Status.ISOLATED, 0.0, 0.0, *UNPLACED)
        for name in sorted(history.trails):
            track = _current(history, name, self._now)
            if name != self._robot and track is not None:
                peers[name] = self._peer(track)
        for name in sorted(history.named.keys() - peers.keys() - {self._robot}):
            why = f"no odometry from {name}", f"send the odometry of {name}"
            peers[name] = PeerEstimate(None, None, Status.ISOLATED, 0.0, inf, *why)
        if WORLD_KEY in self._relative:
            seen = self._relative[WORLD_KEY]
            status, reason = self._judged(seen)
            peers[WORLD] = _known(seen, status, 0.0, reason)
        graph = (self._robot, self._own, self._state, self._relative)
        rejected = dict(history.rejected)
        return Estimate(
            self._robot, self._now, peers, rejected, lambda: optimized_graph(*graph), clocks=self._team.clocks
        )

    def _peer(self, track: Track) -> PeerEstimate:
        """METHOD §3, Status."""
        configuration = self._history.configuration
        age = max(self._now - (track.end - configuration.motion.lag), 0.0)
        if self._own is None:
            if self._robot in self._team.unplaced:
                return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, "our clock is not known yet", UNPLACED[1])
            return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, "no odometry of our own", "drive")
        if age > configuration.status.age:
            why = f"no odometry from {track.key.robot} for {age:.0f} s", "restore the link"
            return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, *(self._apart_in_time(track.key.robot) or why))
        if track.key in self._relative:
            return self._joined(self._own, track, age)
        places = places_of(track.key, self._possible)
        if places:
            best, motion = places[0], self._cluster.motion if self._cluster is not None else ""
            if self._cluster is not None and any({self._own.key, track.key} == set(p) for p in self._cluster.sure):
                assert best.tangent_covariance is not None
                seen = Relative(best.pose, best.covariance, best.tangent_covariance)
                return self._located(self._own, track, seen, age)
            unfit = self._named(track, self._cluster.unfit if self._cluster is not None else frozenset())
            if unfit is not None:
                reason, help_ = inconsistent(unfit)
            else:
                met = self._cluster.passing if self._cluster is not None else None
                robots = (met[0].robot, met[1].robot) if met is not None else None
                reason = ambiguous_reason(places, motion, robots)
                help_ = "check the units and covariances of the odometry"
                if motion != "uncertain":
                    mirror = motion == "straight"
                    reason = after_gap(self._history, (track, self._own), reason)
                    help_ = advice(self._history, self._own, track, best.pose, best.covariance, self._now, mirror)
            return PeerEstimate(
                best.pose,
                best.covariance,
                Status.AMBIGUOUS,
                best.probability,
                age,
                reason,
                help_,
                places,
                best.tangent_covariance,
            )
        if any({self._own.key, track.key} <= set(part) for part in self._in_contact):
            suspect = self._named(track, self._team.suspects)
            if suspect is not None:
                return PeerEstimate(None, None, Status.AMBIGUOUS, 0.0, age, *inconsistent(suspect))
            reason = "measurements link us, but too few to tell where it is"
            reason = after_gap(self._history, (track, self._own), reason)
            return PeerEstimate(None, None, Status.AMBIGUOUS, 0.0, age, reason, "keep moving within range")
        why = self._apart_in_time(track.key.robot) or ("no measurement links us", "come into range")
        return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, *why)

    def _apart_in_time(self, peer: str) -> tuple[str, str] | None:
        """Reason and way out if one of the two has odometry at no time at which readings name it."""
        if self._history.configuration.clock != "shared":
            return None
        driven = self._history.driven
        for name in (self._robot, peer):
            (first, last), (begin, end) = driven[name], self._history.named.get(name, driven[name])
            if begin - last > APART or first - end > APART:
                differ = abs(driven[peer][0] - driven[self._robot][0])
                if differ <= APART:  # all odometry is at another time than the readings
                    differ = abs(first - begin)
                reason = f"the clocks differ by {differ:.0f} s: readings name {name} when it has no odometry"
                return reason, f"put the stamps of {name} on the team's clock"
        return None

    def _joined(self, own: Track, track: Track, age: float) -> PeerEstimate:
        seen = self._relative[track.key]
        suspect = self._named(track, self._team.suspects)
        if suspect is not None:
            reason, help_ = inconsistent(suspect)
            return _known(seen, Status.UNOBSERVABLE, age, reason, help_)
        return self._located(own, track, seen, age)

    def _located(self, own: Track, track: Track, seen: Relative, age: float) -> PeerEstimate:
        status, reason = self._judged(seen)
        if status is Status.TRACKED:
            return _known(seen, status, age)
        if status is Status.POSITION and turned_since(self._history, track, seen.covariance, self._now):
            return _known(seen, status, age, f"{reason}: it may have turned since", "wait for its odometry")
        help_ = advice(self._history, own, track, seen.pose, seen.covariance, self._now, False)
        return _known(seen, status, age, reason, help_)

    def _judged(self, seen: Relative) -> tuple[Status, str]:
        """Status of a joined peer and why it is not tracked: by what is not the robot's own lateness."""
        known = seen.covariance if self._ahead is None else without_own(seen, self._ahead)
        return joined_status(self._robot, seen.pose, known, self._history.configuration)

    def _named(self, track: Track, keys: frozenset[TrackKey]) -> str | None:
        """Which of a peer and the robot itself is among these."""
        return next((t.key.robot for t in (track, self._own) if t is not None and t.key in keys), None)

    @cached_property
    def _in_contact(self) -> tuple[tuple[TrackKey, ...], ...]:
        """Tracks that measurements of the last ``history`` seconds link, over others if need be."""
        return rpmg(contacts(self._history, self._history.horizon(self._now), self._now)).components


def _known(seen: Relative, status: Status, age: float, reason: str = "", help_: str = "") -> PeerEstimate:
    """A peer of whose place there is one opinion."""
    return PeerEstimate(seen.pose, seen.covariance, status, 1.0, age, reason, help_, tangent_covariance=seen.tangent)


def _current(history: History, robot: str, now: float) -> Track | None:
    trail = history.trails.get(robot)
    track = trail.at(now) if trail else None
    return track if track is not None and track.core.known(now) > -np.inf else None
