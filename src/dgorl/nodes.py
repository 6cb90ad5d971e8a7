"""Nodes: the memo of the estimate, one every 5 s of team time. METHOD §1.

node(g) = F(node(g − 5), measurements stamped ≤ g): extended by odometry, converged, then everything before the
window marginalised. A node is a pure function of the admitted measurements; late ones merely empty the memo from
their stamp on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, floor, inf

from dgorl.consistency import Suspect, suspects
from dgorl.doubts import Doubt
from dgorl.expansion.decimated import smoothed
from dgorl.expansion.hypotheses import Cluster
from dgorl.expansion.sides import REMEMBERED, sides, sides_of_some
from dgorl.expansion.step import SPACING, WHOLE, Step, beside
from dgorl.history import History
from dgorl.marginal import excerpt, settled, without
from dgorl.outcasts import Expansion
from dgorl.stages import EXPANSION, OPTIMISATION, stage
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component, alone, extended, grow

BREAK = 2
"""Nodes in a row at which a member has not fitted when it is cut off."""

UNDECIDED = 1.0
"""−2 log of likelihoods so near are as good as one another: the others are the same then, with either of them gone."""

DELAY = 1.0
"""A node is first used this long after its time [s], when most of its data has arrived."""


@dataclass(frozen=True)
class Node:
    """What is known at ``stamp`` [s]: components of more than one member, their window solutions and priors."""

    stamp: float
    components: tuple[Component, ...] = ()
    clusters: tuple[Cluster, ...] = ()
    since: Mapping[TrackKey, float] = field(default_factory=dict)
    """from when on a track counts that was cut off its component [s]"""
    suspects: Mapping[TrackKey, Suspect] = field(default_factory=dict)
    """members that do not fit their component"""
    doubted: Mapping[TrackKey, Component] = field(default_factory=dict)
    """of each of them the component without it since it began not to fit"""
    doubts: tuple[Doubt, ...] = ()
    """sets of tracks, joined or not, that fit without one of them alone"""
    outcasts: Mapping[TrackKey, float] = field(default_factory=dict)
    """members that lied, and when they last did not fit [s]: the others are located as if there was none of them"""

    @property
    def inconsistent(self) -> frozenset[TrackKey]:
        """Who does not fit, joined or not."""
        liars = {doubt.liar for doubt in self.doubts if doubt.liar is not None}
        return frozenset(self.suspects) | liars | frozenset(self.outcasts)


class Memo:
    """node(g) for every multiple of 5 s, computed when asked for and forgotten when its data changes."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._nodes: dict[float, Node] = {}
        self._earliest = inf

    @staticmethod
    def due(now: float) -> float:
        """The node an update at ``now`` builds on: the last multiple of 5 s ≤ now − 1 s."""
        return floor((now - DELAY) / SPACING) * SPACING

    def invalidate(self, since: float) -> None:
        """Forget the nodes that know of something changed at or after ``since`` [s]."""
        self._earliest = min(self._earliest, since)
        self._nodes = {g: node for g, node in self._nodes.items() if g < since}

    def forget(self, before: float) -> None:
        """Forget nodes older than ``before`` [s]; the data admitted later never asks for them."""
        self._nodes = {g: node for g, node in self._nodes.items() if g >= before}
        self._earliest = max(self._earliest, before)

    def low(self, g: float) -> float:
        """Start of the window of node(g) [s]."""
        window = self._history.configuration.window
        return -inf if window == "all" else g - float(window)

    def node(self, g: float) -> Node:
        """node(g) [s], from the nearest one known before it."""
        while (node := self.towards(g)).stamp < g:
            continue
        return node

    def towards(self, g: float) -> Node:
        """The nearest node known before g [s] and brought one node nearer; node(g) in the end."""
        known = [stamp for stamp in self._nodes if stamp <= g]
        if known:
            node = self._nodes[max(known)]
        elif self._earliest == inf or g < self._earliest:
            return Node(g)
        else:
            node = Node((ceil(self._earliest / SPACING) - 1) * SPACING)
        if node.stamp < g:
            quiet = self._quiet_until(node, g)
            with stage(OPTIMISATION):
                node = self._advance(node) if quiet is None else replace(node, stamp=quiet)
            self._nodes[node.stamp] = node
        return node

    def _quiet_until(self, node: Node, g: float) -> float | None:
        """The last node time, at most ``g``, up to which nothing can change after ``node``; None if something may.

        After a long silence, or a jump of the clock, the nodes between need not be computed one by one.
        """
        following = self._history.next_odometry(node.stamp)
        known = node.components or node.clusters
        if following < node.stamp + SPACING or (known and self.low(g) > -inf):
            return None
        return g if following >= g else floor(following / SPACING) * SPACING

    def _advance(self, node: Node) -> Node:
        """F: node(g − 5) → node(g). Formation, expansion, optimisation: Alg. 3 for the nodes."""
        g = node.stamp + SPACING
        low, boundary = self.low(node.stamp), self.low(g)
        tracks = {track.key: track for track in self._history.tracks}
        since = {key: stamp for key, stamp in node.since.items() if key in tracks}
        found: list[Component] = []
        suspects: dict[TrackKey, Suspect] = {}
        doubted: dict[TrackKey, Component] = {}
        broken: set[TrackKey] = set()
        opened: list[Cluster] = []
        for component in grow(self._history, node.components, low, g, since):
            try:
                step = Step(self._history, tracks, g, since)
                if len(component.tracks) > WHOLE:
                    component = smoothed(step, sides_of_some(step, component, g - REMEMBERED))
                elif len(component.tracks) > 1 and not component.has_world:
                    component, cluster = sides(step, component, g - REMEMBERED)
                    if cluster is not None:
                        opened.append(cluster)
                        found += [alone(tracks[key], max(low, since.get(key, low)), g) for key in component.tracks]
                        continue
                whole, seen, rest = self._optimised(component, low, g, boundary, node.suspects)
            except ValueError:  # the graph leaves a pose undetermined: its members are on their own again
                found += [alone(tracks[key], low, g) for key in component.tracks]
                continue
            if seen and rest is not None and seen[0].nodes >= BREAK:
                start = seen[0].since / KEYFRAMES_PER_SECOND
                broken |= {each.key for each in seen}
                since |= {each.key: start for each in seen}
                left = [key for key in component.tracks if key not in rest.stretches]
                found += [rest, *(alone(tracks[key], start, g) for key in left)]
                continue
            found.append(whole)
            suspects |= {each.key: each for each in seen}
            doubted |= {seen[0].key: rest} if rest is not None and len(rest.tracks) > 1 else {}
        clusters = [*opened, *(cluster for cluster in node.clusters if not cluster.tracks & broken)]
        cast = {key: stamp for key, stamp in node.outcasts.items() if key in tracks}
        with stage(EXPANSION):
            expansion = Expansion(self._history, g, low, boundary)
            placed = expansion.placed(found, clusters, node.doubts, cast, since)
        for doubt in placed.doubts:
            if doubt.liar is not None and doubt.others is not None and not doubt.tracks & suspects.keys():
                doubted[doubt.liar] = doubt.others
        components = tuple(c for c in placed.components if len(c.stretches) > 1)
        joined = {key for component in components for key in component.tracks}
        return Node(
            g,
            components,
            placed.clusters,
            placed.since,
            {key: seen for key, seen in suspects.items() if key in joined},
            {key: rest for key, rest in doubted.items() if key in joined},
            placed.doubts,
            placed.outcasts,
        )

    def _optimised(
        self,
        component: Component,
        low: float,
        g: float,
        boundary: float,
        before: Mapping[TrackKey, Suspect],
    ) -> tuple[Component, Sequence[Suspect], Component | None]:
        """A component settled at g; who does not fit it, if anybody, and the component without them."""
        if len(component.stretches) < 2:
            return component, (), None
        done = settled(self._history, component, low, g, boundary)
        found = suspects(done.window, done.poses, g, before)
        if not found:
            return done.component, (), None
        seen = [
            each.after(before.get(each.key))
            for each in self._blamed(component, found, done.window.base, low, g, boundary)
        ]
        since = max(min(each.since for each in seen), done.window.base + 1)  # the others need a pose before it
        seen = sorted((replace(each, since=since) for each in seen), key=lambda each: -each.nodes)
        try:
            rest, _ = self._without(component, [each.key for each in seen], since, low, g, boundary)
        except ValueError:  # without it the others are not determined
            return done.component, seen, None
        return done.component, seen, rest

    def _blamed(
        self, component: Component, found: Sequence[Suspect], base: int, low: float, g: float, boundary: float
    ) -> Sequence[Suspect]:
        """Whose removal lowers the team's sum most: those a robot lies to fit badly too. Of a large team, of a part.

        More than one where it cannot be known: of two that hear nobody else by now, either may have been carried.
        """
        component = excerpt(component, beside(component, [seen.key for seen in found]))
        since = max(min(seen.since for seen in found), base + 1)
        known = {seen.key: seen for seen in found}
        left = {}
        for key in component.tracks:
            try:
                left[key] = self._without(component, [key], since, low, g, boundary)[1]
            except ValueError:
                continue
        least = min(left.values(), default=inf)
        if len(component.stretches) < 3 or least == inf:
            return found[:1]
        worst = min((key for key in left if left[key] <= least), key=lambda key: key not in known)
        named = known.get(worst, Suspect(worst, since, found[0].excess, False))
        return [named, *(s for s in found if s.key != worst and left.get(s.key, inf) <= least + UNDECIDED)]

    def _without(
        self, component: Component, gone: Sequence[TrackKey], since: int, low: float, g: float, boundary: float
    ) -> tuple[Component, float]:
        """The component's other members at g as they are without some since a keyframe; how badly they fit one another.

        That is −2 log of the likelihood of their readings since then, beyond one for each.
        """
        tracks = {track.key: track for track in self._history.tracks}
        first, *more = gone
        rest = without(self._history, component, first, low, since)
        rest = extended(excerpt(rest, [key for key in rest.tracks if key not in more]), tracks, g)
        if len(rest.stretches) < 2:
            return rest, 0.0
        if len(rest.tracks) > WHOLE:
            rest = smoothed(Step(self._history, tracks, g), rest)
        done = settled(self._history, rest, since / KEYFRAMES_PER_SECOND, g, boundary)
        return done.component, 2 * done.cost - sum(len(scalars.value) for scalars in done.window.problem.scalars)
