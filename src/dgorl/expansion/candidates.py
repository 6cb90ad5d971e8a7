"""Where a body may stand relative to another: particles, the region where the ranges meet, local fits. METHOD §4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dgorl import _core
from dgorl.expansion.bodies import Sightings, body_graph
from dgorl.optimization.problem import Indices
from dgorl.se2 import Array

ANNULI, ANNULUS = 8, 3.0
"""The region of interest is where this many annuli d̂·e^(∓cs) meet, c."""

CELL = 0.15
"""Relative width that the grid of particles adds to an annulus."""

WIDEST = 10.0
"""log of the ratio between an annulus' radii and its middle, at most."""

NEAREST = 0.05
"""Distances are at least this [m]."""


@dataclass(frozen=True)
class Candidates:
    """Distinct places T_a_b (k, 3) of a body, best first; log mass (k,), covariance (k, 3, 3), right perturbations."""

    poses: Array
    mass: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.poses)


def candidates(
    found: list[Sightings], radio: tuple[float, float], pi: Array, k: int, rng: np.random.Generator, warm: Array
) -> Candidates:
    """At most k places T_a_b of body b (1) relative to body a (0) that the sightings between them allow.

    pi (3,): information of the weak prior on them. warm (W, 3): places known before, fitted anew besides.
    """
    anchors = _anchors(found, rng)
    graph = body_graph(found, 2, radio)
    spread = body_graph(found, 2, radio, _inflation(found, anchors[-1])) if len(anchors) else graph
    return Candidates(*_core.find_places(graph, spread, anchors, _annuli(found), warm, pi, k))


def _ends(s: Sightings, m: Indices) -> tuple[Array, Array]:
    """Points (M, 2) on body a and on body b of some sightings."""
    forward = (s.i[m] == 0)[:, None]
    a, b = s.point_i[m, :2], s.point_j[m, :2]
    return np.where(forward, a, b), np.where(forward, b, a)


def _anchors(found: list[Sightings], rng: np.random.Generator) -> Array:
    """Readings of distances that particles are drawn round: one in the middle and the newest; bearings have none."""
    ranged = [s for s in found if s.kind != "bearing"]
    rows = [(s, m) for s in ranged for m in range(len(s.value))]
    chosen = [rows[len(rows) // 2], rows[-1]] if len(rows) > 3 else rows[-1:]
    anchors = np.zeros((len(chosen), 8))
    for row, (s, m) in zip(anchors, chosen, strict=True):
        (row[0:2],), (row[2:4],) = _ends(s, np.array([m]))
        row[4] = max(float(s.distance[m]), NEAREST)
        row[5] = min(float(s.sigma[m] / (s.slope[m] * row[4])), 1.0)
        row[6:] = rng.uniform(size=2)
    return anchors


def _annuli(found: list[Sightings]) -> Array:
    """Rings (R, 7) that a few sightings spread over time and robots say a place has to lie in."""
    ranged = [s for s in found if s.kind != "bearing"]
    step = max(sum(len(s.value) for s in ranged) // ANNULI, 1)
    rings = [np.zeros((0, 7))]
    for s in ranged:
        m = np.arange(step // 2, len(s.value), step)
        distance = np.maximum(s.distance[m], NEAREST)
        width = np.exp(np.minimum(ANNULUS * (s.sigma[m] / (s.slope[m] * distance) + CELL), WIDEST))
        rings.append(np.column_stack([*_ends(s, m), s.height[m], distance / width, distance * width]))
    return np.concatenate(rings)


def _inflation(found: list[Sightings], anchor: Array) -> Array:
    """Half a cell of the grid of particles as a variance of each reading's range [m²]."""
    parts = []
    for s in found:
        _, on_b = _ends(s, np.arange(len(s.value)))
        lever = np.sum((on_b - anchor[2:4]) ** 2, axis=1)
        parts.append((0.06 * anchor[4]) ** 2 + 0.08**2 * lever)
    return np.concatenate(parts)
