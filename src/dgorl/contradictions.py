"""Readings that contradict what they are of: who is contradicted since when, a change-point scan. METHOD §4, break.

A robot that was carried is contradicted by its readings since then and by none before. A robust kernel rejects them,
so that nothing of it need show in the odometry. Walls lengthen readings at any time, and less than most of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dgorl.graph import residuals, weights
from dgorl.optimization.problem import Indices
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Window

BACK = 10.0
"""So long before the node [s] a contradiction may have begun."""

BEGINS = int(BACK * KEYFRAMES_PER_SECOND)
"""Beginnings looked at, a member."""

OUTLIERS = 1 / 3
"""This share of a robot's readings, the worst, is no reason: they had no line of sight."""

FEWEST = 2
"""Sightings since then below which nothing is said: one alone may be anything, another robot for example."""

COMPARED = 30
"""Other readings of the team below which it is not known how often readings of it are off."""

USUAL = 3.0
"""Normalised residuals up to here are always expected once in a while."""

LARGEST = 1e4
"""Larger ones count as this much: their tail is then still exact."""


class Readings(NamedTuple):
    """Readings of one kind: stamps, normalised residuals, robust weights (M,), numbers of both members."""

    stamp: Array
    residual: Array
    weight: Array
    ends: tuple[Indices, Indices]


class Contradiction(NamedTuple):
    """A member's readings after keyframe ``since``: ``total`` is at most χ² with ``dof`` degrees of freedom."""

    key: TrackKey
    since: int
    total: float
    dof: int


def readings(window: Window, poses: Array) -> Iterator[Readings]:
    """The window's readings at poses (N, 3), kind by kind."""
    owner = np.repeat(np.arange(len(window.layout)), [count for _, _, count in window.layout.values()])
    for scalars, stamps in zip(window.problem.scalars, window.stamps, strict=True):
        residual = residuals(window.problem, scalars, poses)
        yield Readings(stamps, residual, weights(residual, scalars.loss), (owner[scalars.i], owner[scalars.j]))


def contradictions(window: Window, poses: Array, g: float) -> Iterator[Contradiction]:
    """Of each member and each beginning in the last 10 s before node g [s] how unlikely its readings since then are.

    Fisher's −2 Σ log p ~ χ²(2n), without the worst third of them: where a third of the team's other readings is off
    as much, one that is off says little.
    """
    found = list(readings(window, poses))
    if not found:
        return
    stamp, size = (np.concatenate(column) for column in ([r.stamp for r in found], [np.abs(r.residual) for r in found]))
    i, j = (np.concatenate([r.ends[end] for r in found]) for end in (0, 1))
    keyframe = np.ceil(stamp * KEYFRAMES_PER_SECOND).astype(np.int64) - 1  # the last one before a reading
    sighting = np.unique(np.column_stack([stamp, np.minimum(i, j), np.maximum(i, j)]), axis=0, return_inverse=True)[1]
    now = int(np.floor(g * KEYFRAMES_PER_SECOND))
    recent = keyframe >= max(now - BEGINS, window.base + 1)
    for k, key in enumerate(window.layout):
        mine = ((i == k) | (j == k)) & recent
        others = np.sort(size[~mine])
        if mine.sum() < FEWEST or len(others) < COMPARED:
            continue
        seen, at, which = np.unique(sighting[mine], return_index=True, return_inverse=True)
        surprise = np.full(len(seen), np.inf)  # of a sighting's range and bearing the one that surprises less
        np.minimum.at(surprise, which, -2 * np.log(chance(size[mine], others)))
        begin = keyframe[mine][at]
        for since in np.unique(begin):
            total, kept = without_worst(surprise[begin >= since])
            if kept >= FEWEST:
                yield Contradiction(key, int(since), total, 2 * kept)


def chance(size: Array, others: Array) -> Array:
    """How often a normalised residual of the team is as large as ``size`` (M,): as the others (N,), in order, say.

    And as noise with tails: those of the Cauchy kernel, whatever the kernel is, so that nobody is accused for them.
    Beyond the largest of the others, which one in N reaches, it falls as these tails do.
    """
    larger = len(others) - np.searchsorted(others, size)
    beyond = np.minimum(tail(size) / tail(np.maximum(others[-1:], USUAL)), 1.0)
    return np.asarray(np.minimum(tail(size) + (larger + beyond) / len(others), 1.0))


def tail(size: Array) -> Array:
    """How often chance exceeds normalised residuals by the law that a Cauchy kernel of width 2σ assumes, t of 3."""
    x = np.clip(size, 1 / LARGEST, LARGEST) / 2
    return np.asarray(2 / np.pi * (np.arctan(1 / x) - x / (1 + x**2)))


def without_worst(values: Array) -> tuple[float, int]:
    """The sum without the worst third, and of how many it is."""
    kept = len(values) - int(len(values) * OUTLIERS)
    return float(np.sort(values)[:kept].sum()), kept
