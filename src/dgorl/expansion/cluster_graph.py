"""One graph for all hypotheses about a cluster: the same readings, other starts. METHOD §4.

A cluster is a set of components that measurements link but whose relative poses are not accepted yet. Its graph holds
every reading since ``base``; a hypothesis is one of its optima.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np

from dgorl import _core, se2
from dgorl.expansion.bodies import Drift, Sightings, drift, sightings
from dgorl.history import History
from dgorl.optimization import native
from dgorl.optimization.problem import Indices
from dgorl.radio import rssi_to_range
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component, Window, assemble

LEAST_RANGE = 5.0
"""The weak prior on positions is at least this wide [m]."""

TOLERANCE = 1e-4
"""Largest last step of a hypothesis' optimisation at a node [m, rad]."""

ITERATIONS = 30
"""Most linear systems solved for one optimum."""


@dataclass(frozen=True)
class Optima:
    """B optima: poses (B, N, 3), cost (B,), log mass (B,) = −cost − ½ log det(H + Π), and how the tracks stand.

    relative (B, n, 3): the newest pose of every track, seen from that of the first; covariance (B, 3n, 3n) of it,
    right perturbations, zero for the first.
    """

    poses: Array
    cost: Array
    mass: Array
    relative: Array
    covariance: Array

    @property
    def fields(self) -> tuple[Array, ...]:
        """All arrays."""
        return self.poses, self.cost, self.mass, self.relative, self.covariance

    def __getitem__(self, rows: Sequence[int]) -> Optima:
        pick = np.array(rows, dtype=np.int64)
        return Optima(*(field[pick] for field in self.fields))


@dataclass(frozen=True)
class ClusterGraph:
    """``window`` as the core's ``graph``; body (N,): which of the ``bodies`` (each component's tracks) a pose is of."""

    window: Window
    graph: _core.Graph
    bodies: tuple[tuple[TrackKey, ...], ...]
    body: Indices
    newest: Indices
    """index of the newest pose of every track"""
    soft: Indices
    """the poses that carry the weak prior Π: the newest of each body, but the first body's"""
    pi: Array
    """(3,) diagonal of Π"""

    @property
    def keys(self) -> tuple[TrackKey, ...]:
        return tuple(self.window.layout)

    def start(self, component: Component) -> Array:
        """A component's poses (N, 3) as this graph orders them."""
        parts = [component.stretches[key].poses for key in self.window.layout]
        if self.window.world is not None:
            parts.append(np.zeros((1, 3)))
        return np.concatenate(parts)

    def optimize(self, starts: Array, tolerance: float = TOLERANCE, iterations: int = ITERATIONS) -> Optima:
        """Optimise from each of the starts (B, N, 3)."""
        found = self.graph.optimize(starts, max_iterations=iterations, step_tolerance=tolerance)
        return self.weigh(np.asarray(found.poses), np.asarray(found.cost))

    def weigh(self, poses: Array, cost: Array) -> Optima:
        """Log mass and covariance round poses (B, N, 3) of that cost (B,)."""
        information = np.tile(self.pi, (len(self.soft), 1))
        logdet, covariance = self.graph.evidence(poses, self.newest, self.soft, information)
        newest = poses[:, self.newest]
        return Optima(poses, cost, -cost - logdet / 2, se2.between(newest[:, :1], newest), covariance)

    def drift(self) -> Drift:
        return drift(self.window.problem, [(first, count) for first, _, count in self.window.layout.values()])

    def sightings(self, body: Indices, poses: Array, noise: Drift) -> list[Sightings]:
        """Thinned readings between bodies numbered as ``body`` (N,) says, −1 for none; poses (N, 3) in their frames."""
        return sightings(self.window.problem, self.window.stamps, body, poses, noise)


def cluster_graph(
    history: History, component: Component, groups: Sequence[tuple[TrackKey, ...]], base: int, limit: float
) -> ClusterGraph:
    """The graph of a cluster from keyframe ``base`` to ``limit`` [s]; groups: the tracks of each of its components."""
    first = component.tracks[0]
    stretch = component.stretches[first]
    pin = stretch.first + len(stretch.poses) - 1
    window = assemble(history, component, base / KEYFRAMES_PER_SECOND, limit, pin)
    body = np.zeros(len(window.problem.initial), np.int64)
    newest: list[int] = []
    soft: dict[int, tuple[int, int]] = {}
    for key, (offset, begin, count) in window.layout.items():
        b = next(k for k, group in enumerate(groups) if key in group)
        body[offset : offset + count] = b
        newest.append(offset + count - 1)
        soft[b] = max(soft.get(b, (0, 0)), (begin + count, -newest[-1]))  # of equals, the first by name
    world = window.world is not None
    if world:
        body[window.world] = next((k for k, g in enumerate(groups) if any(key.robot == "world" for key in g)), 0)
    reference = int(body[window.world]) if world else int(body[newest[0]])
    weak = [-index for b, (_, index) in soft.items() if b != reference]
    sigma = _farthest(history, window)
    return ClusterGraph(
        window,
        native.graph(window.problem),
        tuple(groups),
        body,
        np.array(newest, np.int64),
        np.array(weak, np.int64),
        np.array([sigma**-2, sigma**-2, pi**-2]),
    )


def _farthest(history: History, window: Window) -> float:
    """The largest range heard [m]: σ of Π in position."""
    radio, farthest = history.configuration.radio, LEAST_RANGE
    for s in window.problem.scalars:
        if s.kind != "bearing" and len(s.value):
            distance = s.value if s.kind == "range" else rssi_to_range(s.value, radio)
            farthest = max(farthest, float(distance.max()))
    return farthest
