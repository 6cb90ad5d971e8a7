"""The public door: one robot's Localizer, and the Team behind it that every robot computes alike. Alg. 3."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import ceil

import numpy as np

from dgorl.configuration import Configuration
from dgorl.doubts import LONGEST
from dgorl.estimate import Estimate
from dgorl.expansion.hypotheses import Cluster
from dgorl.expansion.sides import just_passed, sides
from dgorl.expansion.step import SPACING, WHOLE, Step
from dgorl.expansion.ticks import hypotheses_now
from dgorl.history import LATE, History
from dgorl.marginal import stretches
from dgorl.measurements import LARGEST, ClockKey, ClockReading, Measurement
from dgorl.nodes import Memo, Node
from dgorl.stages import FORMATION, OPTIMISATION, stage
from dgorl.team_state import TeamState, team_state
from dgorl.tracks import TrackKey
from dgorl.view import ClusterNow, TeamNow, View
from dgorl.window import Component, grow

RETAINED = 10.0
"""Raw data is kept this much longer [s] than a node as old as the history looks back."""


class Team:
    """What the whole team knows: a pure function of the measurements admitted and of ``now``."""

    def __init__(self, configuration: Configuration | None = None) -> None:
        self.configuration = configuration or Configuration()
        self.history = History(self.configuration)
        self._memo = Memo(self.history)
        self._last_node = -np.inf

    def add(self, measurement: Measurement, clock: ClockKey | None = None) -> None:
        """Take a measurement, own or received, in any order, twice without harm.

        clock: whose clock its stamps are on; this team's is shared by all (see :mod:`dgorl.team_time`).
        """
        self.history.add(measurement)

    def add_reading(self, reading: ClockReading) -> None:
        """Take a clock reading; a shared clock needs none."""

    def add_birth(self, clock: ClockKey, stamp: float) -> None:
        """Say when a clock began, on that clock [s]; a shared one needs it not."""

    def team_now(self, robot: str, epoch: int, local_now: float) -> float | None:
        """Team time when that clock shows ``local_now`` [s], None while it is not placed."""
        return local_now

    def prepare(self, now: float) -> bool:
        """Compute one of the nodes that ``update(now)`` needs and that are not known yet; whether more are missing.

        After a restart, a partition or late data there are many: whoever has other things to do does them in between.
        """
        g, settled = self._memo.due(now), self._settled(now)
        if g > self._last_node and self._memo.towards(settled).stamp < settled:
            return True
        self._receive(now, g)
        return self._memo.towards(g).stamp < g

    def anticipate(self, now: float) -> None:
        """Compute the node that ``update(now)`` will need, if all robots that are there have told their way up to it.

        Nothing is admitted: should data for it come later it is computed again.
        """
        g = self._memo.due(now)
        ends = [trail.tracks[-1].end for trail in self.history.trails.values() if trail.tracks]
        if all(end >= g or end < g - LATE for end in ends):
            self._memo.node(g)

    def takes_late(self, now: float) -> bool:
        """Whether ``update(now)`` would admit data that is later than 10 s, or leave it for the next node."""
        return self.history.takes_late(self._memo.due(now) > self._last_node)

    def update(self, now: float) -> TeamNow:
        """Alg. 3 at ``now`` [s]. Formation, expansion and optimisation are the node's; it is carried on to now.

        Raises ValueError when ``now`` is not a time.
        """
        if not abs(now) <= LARGEST:
            raise ValueError(f"now must be a time in seconds, got {now}")
        g = self._memo.due(now)
        with stage(FORMATION):
            self._receive(now, g)  # motion and observability information of the connected robots
        node = self._memo.node(g)  # who is in contact, candidate graphs over the horizon, their optimisation
        with stage(OPTIMISATION):
            return self._carried_on(node, self._memo.low(g), now)

    def view(self, robot: str, state: TeamNow, now: float) -> Estimate:
        """The team as one robot sees it."""
        return View(self.history, state, robot, now).estimate()

    def _carried_on(self, node: Node, low: float, now: float) -> TeamNow:
        liars = node.inconsistent
        joined, reopened = self._joined(node.components, node, low, now)
        clusters = [self._cluster(c, now, liars) for c in [*node.clusters, *reopened]]
        return TeamNow(
            tuple(joined),
            tuple(cluster for cluster in clusters if cluster.hypotheses),
            liars,
            tuple(state for _, state in self._optimised(node.doubted.values(), node, low, now)) if node.doubted else (),
        )

    def _cluster(self, cluster: Cluster, now: float, liars: frozenset[TrackKey]) -> ClusterNow:
        return ClusterNow(
            tuple(hypotheses_now(self.history, cluster, now)),
            cluster.motion,
            cluster.named | (liars & cluster.tracks),
            [pair for pair in cluster.sure if not liars & set(pair)],
            cluster.passing,
        )

    def _rewind(self, since: float) -> None:
        """Forget what is stamped after ``since`` [s], a node's time; what comes anew is admitted at once."""
        self.history.rewind(since)
        self._memo.invalidate(since)
        self._last_node = -np.inf

    def _settled(self, now: float) -> float:
        """The last node that nothing admitted from ``now`` [s] on can change."""
        return (ceil((now - self.configuration.history) / SPACING) - 1) * SPACING

    def _receive(self, now: float, g: float) -> None:
        if g > self._last_node:
            self._memo.node(self._settled(now))  # after a pause: from data that is forgotten below
        self._memo.invalidate(self.history.admit(now, node_due=g > self._last_node))
        if g > self._last_node:
            self._last_node = g
            history = self.configuration.history
            self._memo.forget(now - history - RETAINED - SPACING)
            if self.configuration.window != "all":
                looked_back = max(history, float(self.configuration.window), LONGEST)
                self.history.forget(now - history - looked_back - RETAINED - 2 * SPACING)

    def _joined(
        self, components: Sequence[Component], node: Node, low: float, now: float
    ) -> tuple[list[TeamState], list[Cluster]]:
        """The components optimised once more, those in which a passing since the node leaves two sides as clusters."""
        states, reopened = [], []
        for component, state in self._optimised(components, node, low, now):
            cluster = self._reopened(component, state, node, now)
            if cluster is None:
                states.append(state)
            else:
                reopened.append(cluster)
        return states, reopened

    def _reopened(self, component: Component, state: TeamState, node: Node, now: float) -> Cluster | None:
        """The component as a cluster, if robots passed one another about the node or since and the side is open."""
        since, window, poses = node.stamp - SPACING, state.window, state.solution.poses
        large = len(window.layout) > WHOLE  # every tick has passings in one, and its nodes look at them
        if window.world is not None or large or not just_passed(window.layout, poses, since):
            return None
        step = Step(self.history, {t.key: t for t in self.history.tracks}, now, node.since)
        try:
            return sides(step, Component(stretches(window, poses, None), component.priors, component.links), since)[1]
        except ValueError:  # the graph leaves a pose undetermined
            return None

    def _optimised(
        self, components: Iterable[Component], node: Node, low: float, now: float
    ) -> Iterator[tuple[Component, TeamState]]:
        """The components of more than one member, and as they are optimised once more."""
        for component in grow(self.history, components, low, now, node.since):
            if len(component.stretches) > 1:
                try:
                    yield component, team_state(self.history, component, low, now)
                except ValueError:  # the graph leaves a pose undetermined: its members stay unjoined
                    continue


class Localizer:
    """Where are my peers? One robot's relative localization from its own and received measurements.

    robot: this robot's name. team: share one between the localizers of several robots that hear the same.
    """

    def __init__(self, robot: str, config: Configuration | None = None, *, team: Team | None = None) -> None:
        self.robot = robot
        self.team = team or Team(config)

    def add(self, measurement: Measurement, clock: ClockKey | None = None) -> None:
        """Take a measurement, own or received, in any order, twice without harm; nothing is computed yet."""
        self.team.add(measurement, clock)

    def prepare(self, now: float) -> bool:
        """Do a part of what ``update(now)`` would do all at once after a pause; whether more parts are left."""
        return self.team.prepare(now)

    def anticipate(self, now: float) -> None:
        """Do before ``now`` [s] what ``update(now)`` would have to do then, as far as that is certain; in idle time."""
        self.team.anticipate(now)

    def update(self, now: float) -> Estimate:
        """Every peer's relative pose at ``now`` [s] (Alg. 3: formation → expansion → optimisation)."""
        return self.view(self.team.update(now), now)

    def view(self, team: TeamNow, now: float) -> Estimate:
        """The team as this robot sees it."""
        return self.team.view(self.robot, team, now)
