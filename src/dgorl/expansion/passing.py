"""Two robots that met: on which side did they pass one another? METHOD §4.

Ranges at the moment of passing tell the distance, not the side, and the two answers are optima that differ by a bend of
both trajectories, too little to be different places of the robots.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from dgorl.expansion.cluster_graph import ClusterGraph
from dgorl.se2 import Array

CLOSE = 2.0
"""Robots that come this near to one another [m] pass."""

BEND = 8.0
"""σ of the bend along the trajectory [keyframes]."""

PASSINGS = 3
"""The nearest passings that are tried."""


def passed(graph: ClusterGraph, poses: Array, since: int) -> Array:
    """Starts (B, N, 3) in which two robots pass one another on the other side than in ``poses`` (N, 3).

    since: keyframe from which on passings count.
    """
    found: list[tuple[float, Array]] = []
    for (at_a, first_a, count_a), (at_b, first_b, count_b) in combinations(graph.window.layout.values(), 2):
        first, last = max(first_a, first_b, since), min(first_a + count_a, first_b + count_b)
        if last - first < 3:
            continue
        a, b = (
            slice(at_a + first - first_a, at_a + last - first_a),
            slice(at_b + first - first_b, at_b + last - first_b),
        )
        apart = poses[b, :2] - poses[a, :2]
        distance = np.hypot(apart[:, 0], apart[:, 1])
        nearest = np.flatnonzero((distance[1:-1] <= distance[:-2]) & (distance[1:-1] < distance[2:])) + 1
        for k in nearest[distance[nearest] < CLOSE].tolist():
            weight = np.exp(-0.5 * ((np.arange(last - first) - k) / BEND) ** 2)[:, None]
            start = poses.copy()
            start[a, :2] += weight * apart[k]
            start[b, :2] -= weight * apart[k]
            found.append((float(distance[k]), start))
    found.sort(key=lambda item: item[0])
    return np.array([start for _, start in found[:PASSINGS]]).reshape(-1, *poses.shape)
