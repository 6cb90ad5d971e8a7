"""Which bodies of a hypothesis the readings of a whole link speak against. METHOD §4.

Redescending kernels let a wrong place stand: what contradicts it counts for little. A lacking line of sight makes some
readings of a link too long, at random times; a place on the wrong side contradicts most readings of a link, at all
times, and on some links they are too short, which no obstacle explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dgorl.consistency import CLIP, TAIL
from dgorl.contradictions import OUTLIERS
from dgorl.graph import residuals
from dgorl.se2 import Array
from dgorl.tracks import TrackKey
from dgorl.window import Window

Pairs = NDArray[np.bool_]


def contradicted(window: Window, poses: Array, bodies: Sequence[tuple[TrackKey, ...]]) -> frozenset[TrackKey]:
    """Members of the bodies that links speak against, one body after another, without those before it.

    poses (N, 3): the hypothesis. All readings of its window between two bodies count. A link of which most are too
    short contradicts a body; links of which most are too long, where they are more than a third of its links.
    """
    short, long, linked = _links(window, poses, bodies)
    gone: frozenset[TrackKey] = frozenset()
    left = np.ones(len(bodies), bool)
    while True:
        among = left[:, None] & left[None]
        links = np.maximum((linked & among).sum(axis=1), 1)
        shorter, longer = (short & among).sum(axis=1), (long & among).sum(axis=1)
        excess = shorter + np.where(longer > OUTLIERS * links, longer, 0)
        worst = max(range(len(bodies)), key=lambda k: (excess[k] / links[k], -len(bodies[k]), bodies[k]))
        if not excess[worst]:
            return gone
        gone |= set(bodies[worst])
        left[worst] = False


def _links(window: Window, poses: Array, bodies: Sequence[tuple[TrackKey, ...]]) -> tuple[Pairs, Pairs, Pairs]:
    """Between which bodies (m, m) most readings are too short, or too long, and which are linked at all."""
    size = len(bodies)
    tables = np.zeros((3, size, size), np.int64)
    body = np.full(len(poses), -1)
    for key, (offset, _, count) in window.layout.items():
        body[offset : offset + count] = next(k for k, keys in enumerate(bodies) if key in keys)
    for scalars in window.problem.scalars:
        e = residuals(window.problem, scalars, poses)
        i, j = body[scalars.i], body[scalars.j]
        off = e**2 > CLIP
        over = off if scalars.kind == "bearing" else off & (e > 0)  # weak signals, long ranges: negative residuals
        for table, rows in zip(tables, (np.ones(len(e), bool), over, off & ~over), strict=True):
            rows = rows & (i != j) & (i >= 0) & (j >= 0)
            np.add.at(table, (i[rows], j[rows]), 1)
    count, short, long = tables + tables.swapaxes(1, 2)
    tail = TAIL / max(int((count > 0).sum()) // 2, 1)
    numbers, where = np.unique(count, return_inverse=True)
    least = np.array([_least(int(n), OUTLIERS, tail) for n in numbers])[where].reshape(count.shape)
    return (count > 0) & (short >= least), (count > 0) & (long >= least), count > 0


@cache
def _least(n: int, share: float, tail: float) -> int:
    """The least number out of n that chance reaches with probability ``tail`` at most; n + 1 if none."""
    k = np.arange(n + 1)
    factorial = np.concatenate([[0.0], np.cumsum(np.log(k[1:]))])
    chance = np.exp(factorial[n] - factorial - factorial[::-1] + k * np.log(share) + (n - k) * np.log(1 - share))
    return int(np.sum(np.cumsum(chance[::-1]) > tail))
