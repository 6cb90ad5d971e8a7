"""The coarse team: each component a rigid body, its readings thinned, odometry noise folded into their σ. METHOD §4.

Where could the others be? is asked of a few dozen readings between bodies of three unknowns each, thousands of
times; the answers are starts for the window graph, which knows every reading and bends every trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dgorl import _core, se2
from dgorl.optimization.problem import Indices, Loss, Problem
from dgorl.radio import distances
from dgorl.se2 import Array

BINS = 24
"""Readings of one pair and kind are thinned to about this many."""

SHORTEST_BIN = 1.0
"""... but not finer than this [s]."""


CORRELATED = 5.0
"""Odometry noise, which neighbouring readings share, counts as that much independent variance in each."""


@dataclass(frozen=True)
class Sightings:
    """Thinned readings of one kind between bodies i and j (M,), of points (M, 3) in the frames of their bodies.

    value and sigma in the units of the kind, odometry noise included; distance: the range they mean [m], NaN for
    bearings; slope: |d value / d distance| there, per metre.
    """

    kind: str
    i: Indices
    j: Indices
    point_i: Array
    point_j: Array
    height: Array
    value: Array
    sigma: Array
    distance: Array
    slope: Array
    loss: Loss


@dataclass(frozen=True)
class Drift:
    """How odometry noise grows along every track, per pose of a problem: Σ of position and heading variances."""

    position: Array
    heading: Array
    middle: Indices
    """the pose in the middle of the same track"""


def drift(problem: Problem, tracks: list[tuple[int, int]]) -> Drift:
    """tracks: (first pose, count) of each."""
    i, _, _, information = problem.odometry
    size = len(problem.initial)
    position, heading, middle = np.zeros(size), np.zeros(size), np.zeros(size, np.int64)
    if len(i):
        diagonal = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
        position[i + 1], heading[i + 1] = diagonal[:, :2].mean(axis=1), diagonal[:, 2]
    for first, count in tracks:
        part = slice(first, first + count)
        position[part], heading[part] = np.cumsum(position[part]), np.cumsum(heading[part])
        middle[part] = first + count // 2
    return Drift(position, heading, middle)


def sightings(
    problem: Problem, stamps: tuple[Array, ...], body: Indices, poses: Array, noise: Drift
) -> list[Sightings]:
    """What the readings of a problem say of its bodies; body (N,) of each pose, poses (N, 3) in their body's frame."""
    span = max((float(np.ptp(t)) for t in stamps if len(t)), default=0.0)
    width = max(span / BINS, SHORTEST_BIN)
    lever = np.sum((poses[:, :2] - poses[noise.middle, :2]) ** 2, axis=1)
    variance = np.abs(noise.position - noise.position[noise.middle])
    variance += np.abs(noise.heading - noise.heading[noise.middle]) * lever / 2
    variance *= CORRELATED
    found = []
    for s, stamp in zip(problem.scalars, stamps, strict=True):
        rows = np.flatnonzero((body[s.i] != body[s.j]) & (body[s.i] >= 0) & (body[s.j] >= 0))
        if not len(rows):
            continue
        bearing = s.kind == "bearing"
        i, j = s.i[rows], s.j[rows]
        swap = np.zeros(len(rows), bool) if bearing else body[i] > body[j]
        a, b = np.where(swap, j, i), np.where(swap, i, j)
        at_i, at_j = s.at_i[rows], s.at_j[rows]
        at_a, at_b = np.where(swap[:, None], at_j, at_i), np.where(swap[:, None], at_i, at_j)
        points = np.concatenate(
            [
                se2.compose(poses[a], at_a), se2.compose(poses[b], at_b),
                s.height[rows, None], s.value[rows, None], variance[a, None] + variance[b, None],
            ],
            axis=1,
        )  # fmt: skip
        track = noise.middle  # one number a track
        code = (track[a] * len(poses) + track[b]) * 100000 + np.floor(stamp[rows] / width).astype(np.int64) % 100000
        order = np.argsort(code, kind="stable")
        starts = np.flatnonzero(np.diff(code[order], prepend=-1))
        count = np.diff(starts, append=len(order))
        head = order[starts + count // 2]
        if bearing:
            mean, sigma = points[head], s.sigma[rows][head]
        else:
            mean = np.add.reduceat(points[order], starts) / count[:, None]
            sigma = np.sqrt(np.add.reduceat(s.sigma[rows][order] ** 2, starts)) / count
        found.append(_thinned(problem, s.kind, body[a[head]], body[b[head]], mean, sigma, s.loss.convex))
    return found


def _thinned(problem: Problem, kind: str, i: Indices, j: Indices, mean: Array, sigma: Array, loss: Loss) -> Sightings:
    value, variance = mean[:, 7], mean[:, 8]
    distance = np.full_like(value, np.nan)
    if kind != "bearing":
        distance = value if kind == "range" else distances(value, *problem.radio)
    slope = slopes(kind, distance, problem.radio)
    whole = np.sqrt(sigma**2 + slope**2 * variance)
    return Sightings(kind, i, j, mean[:, :3], mean[:, 3:6], mean[:, 6], value, whole, distance, slope, loss)


def slopes(kind: str, distance: Array, radio: tuple[float, float]) -> Array:
    """|d value / d distance| (M,) of readings that mean these distances [m]; of bearings, at 5 m."""
    if kind == "rssi":
        return np.asarray(10.0 * radio[1] / np.log(10.0) / np.maximum(distance, 0.1))
    return np.full_like(distance, 1.0 if kind == "range" else 0.2)


def body_graph(
    found: list[Sightings], bodies: int, radio: tuple[float, float], inflate: Array | None = None
) -> _core.Graph:
    """The core's graph of the bodies, body 0 fixed. inflate: added to the variance of ranges [m²], one per reading."""
    fixed = np.zeros(bodies, bool)
    fixed[0] = True
    graph = _core.Graph(np.zeros(bodies, np.int64), fixed)
    at = 0
    for s in found:
        count = len(s.value)
        more = 0.0 if inflate is None else inflate[at : at + count]
        at += count
        sigma = np.sqrt(s.sigma**2 + s.slope**2 * more)
        kernel, width = getattr(_core, s.loss.kernel.upper()), s.loss.width
        ends = (s.i, s.j, np.ascontiguousarray(s.point_i[:, :2]), np.ascontiguousarray(s.point_j[:, :2]), s.height)
        if s.kind == "rssi":
            at_1m, exponent = (np.full(count, value) for value in radio)
            graph.add_rssi(*ends, s.value, at_1m, exponent, sigma, kernel, width)
        elif s.kind == "range":
            graph.add_ranges(*ends, s.value, sigma, kernel, width)
        else:
            graph.add_bearings(s.i, s.j, s.point_i, ends[3], s.value, sigma, kernel, width)
    return graph
