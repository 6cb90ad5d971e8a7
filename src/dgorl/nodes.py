"""Nodes: the memo of the estimate, one every 5 s of team time. METHOD §1.

node(g) = F(node(g − 5), measurements stamped ≤ g): extended by odometry, converged, then everything before the
window marginalised. A node is a pure function of the admitted measurements; late ones merely empty the memo from
their stamp on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, floor, inf

import numpy as np

from dgorl.history import WORLD_KEY, History
from dgorl.optimization import native
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import WORLD_STRETCH, Component, Prior, Stretch, Window, assemble, grow

SPACING = 5.0
"""Seconds between nodes."""

DELAY = 1.0
"""A node is first used this long after its time [s], when most of its data has arrived."""

TOLERANCE = 1e-9
"""Largest last step of a node's optimisation [m, rad]."""


@dataclass(frozen=True)
class Node:
    """What is known at ``stamp`` [s]: components of more than one member, their window solutions and priors."""

    stamp: float
    components: tuple[Component, ...] = ()


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
        known = [stamp for stamp in self._nodes if stamp <= g]
        if known:
            node = self._nodes[max(known)]
        elif self._earliest == inf or g < self._earliest:
            return Node(g)
        else:
            node = Node((ceil(self._earliest / SPACING) - 1) * SPACING)
        while node.stamp < g:
            quiet = self._quiet_until(node, g)
            node = self._advance(node) if quiet is None else Node(quiet, node.components)
            self._nodes[node.stamp] = node
        return node

    def _quiet_until(self, node: Node, g: float) -> float | None:
        """The last node time, at most ``g``, up to which nothing can change after ``node``; None if something may.

        After a long silence, or a jump of the clock, the nodes between need not be computed one by one.
        """
        following = self._history.next_odometry(node.stamp)
        if following <= node.stamp + SPACING or (node.components and self.low(g) > -inf):
            return None
        return g if following >= g else floor(following / SPACING) * SPACING

    def _advance(self, node: Node) -> Node:
        """F: node(g − 5) → node(g)."""
        g = node.stamp + SPACING
        low, boundary = self.low(node.stamp), self.low(g)
        grown = grow(self._history, node.components, low, g)
        settled = []
        for component in grown:
            if len(component.stretches) > 1:
                try:
                    settled.append(self._settled(component, low, g, boundary))
                except ValueError:  # the graph leaves a pose undetermined: its members are on their own again
                    continue
        return Node(g, tuple(c for c in settled if len(c.stretches) > 1))

    def _settled(self, component: Component, low: float, g: float, boundary: float) -> Component:
        """The component converged, with everything before ``boundary`` marginalised into a prior."""
        pin = None if boundary == -inf else int(boundary * KEYFRAMES_PER_SECOND)
        window = assemble(self._history, component, low, g, pin)
        solution = native.solve(window.problem, np.zeros(0, np.int64), TOLERANCE)
        priors = component.priors
        if pin is not None and pin > window.base:
            priors = marginalized(window, solution.poses, pin)
        return Component(stretches(window, solution.poses, pin), priors)


def stretches(window: Window, poses: Array, first: int | None) -> Mapping[TrackKey, Stretch]:
    """A solution's poses by track, from keyframe ``first`` on; tracks that ended before it are left out."""
    found: dict[TrackKey, Stretch] = {}
    for key, (offset, start, count) in window.layout.items():
        skip = 0 if first is None else max(first - start, 0)
        if skip < count:
            found[key] = Stretch(start + skip, poses[offset + skip : offset + count])
    if window.world is not None:
        found[WORLD_KEY] = WORLD_STRETCH
    return found


def marginalized(window: Window, poses: Array, boundary: int) -> tuple[Prior, ...]:
    """The prior at the boundary keyframe, relative to the first track by name that stands there."""
    standing = {
        window.index(key, boundary): key
        for key, (_, first, count) in window.layout.items()
        if first < boundary < first + count
    }
    if not standing:
        return ()
    reference = min(standing)
    found = native.marginalize(window.problem, poses, boundary - window.base, reference, window.world)
    members, relative, information, gradient = found
    if not len(members):
        return ()
    names = {
        window.index(key, boundary): key
        for key, (_, first, n) in window.layout.items()
        if first <= boundary < first + n
    }
    if window.world is not None:
        names[window.world] = WORLD_KEY
    keys = tuple(names[int(member)] for member in members)
    return (Prior(boundary, standing[reference], keys, relative, information, gradient),)
