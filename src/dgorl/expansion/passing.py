"""Two robots that met: on which side did they pass one another? METHOD §4.

Ranges at the moment of passing tell the distance, not the side, and the two answers are optima that differ by a bend of
both trajectories, too little to be different places of the robots.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dgorl.expansion.cluster_graph import ClusterGraph
from dgorl.se2 import Array
from dgorl.tracks import TrackKey

CLOSE = 3.0
"""Robots that come this near to one another [m] pass."""

BEND = 8.0
"""σ of the bend along the trajectory [keyframes]."""

PASSINGS = 3
"""The nearest passings that are tried."""


class Passing(NamedTuple):
    """Two tracks are nearest to one another [m] at a keyframe, where the second is ``apart`` (2,) from the first."""

    distance: float
    pair: tuple[TrackKey, TrackKey]
    keyframe: int
    apart: Array


Layout = Mapping[TrackKey, tuple[int, int, int]]
"""Of every track: index of its first pose, first keyframe, count."""


def passings(layout: Layout, poses: Array, since: int) -> list[Passing]:
    """The nearest passings of poses (N, 3) since a keyframe, at most PASSINGS, the nearest first.

    Who is still coming nearer to another, and is near, passes it now.
    """
    keys = tuple(layout)
    until = max(first + count for _, first, count in layout.values())
    way = np.full((len(keys), max(until - since, 0), 2), np.nan)
    for row, (offset, first, count) in zip(way, layout.values(), strict=True):
        begin = max(first, since)
        if begin < first + count:
            row[begin - since : first + count - since] = poses[offset + begin - first : offset + count, :2]
    apart = way[None] - way[:, None]
    near = (apart**2).sum(axis=-1) < CLOSE**2
    found: list[Passing] = []
    for a, b in np.argwhere(np.triu(near.any(axis=-1), 1)).tolist():
        distance = np.hypot(apart[a, b, :, 0], apart[a, b, :, 1])
        before, after = distance[:-1], np.append(distance[2:], np.inf)
        nearest = 1 + np.flatnonzero(near[a, b, 1:] & (distance[1:] <= before) & ~(after <= distance[1:]))
        found += [Passing(float(distance[k]), (keys[a], keys[b]), since + k, apart[a, b, k]) for k in nearest.tolist()]
    found.sort(key=lambda passing: passing.distance)
    return found[:PASSINGS]


def passed(graph: ClusterGraph, poses: Array, found: list[Passing]) -> Array:
    """Starts (B, N, 3), one for each passing, in which the two are on the other side than in ``poses`` (N, 3)."""
    starts = np.tile(poses, (len(found), 1, 1))
    for start, passing in zip(starts, found, strict=True):
        for key, sign in zip(passing.pair, (1.0, -1.0), strict=True):
            offset, first, count = graph.window.layout[key]
            weight = np.exp(-0.5 * ((first + np.arange(count) - passing.keyframe) / BEND) ** 2)
            start[offset : offset + count, :2] += sign * weight[:, None] * passing.apart
    return starts
