"""Does a robot still fit its team? Two tests of a settled window, for robots that were carried or whose readings lie.

METHOD §4, break. A robot that was carried shows as an odometry step the rest of the window contradicts: the cost falls
by T ~ χ²(3) when the step is left out, and T follows from the step's residual u, its covariance Q and its posterior
covariance C as uᵀ(Q − C)⁻¹u. Where robust kernels reject all its readings instead, these no longer sum up as χ² does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dgorl import se2
from dgorl.graph import residuals
from dgorl.history import History
from dgorl.optimization import native
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Window

INTERVALS = (5.0, 10.0)
"""Between these ages of theirs [s] at the node, the odometry steps bent most are tested."""

CLIP = 9.0
"""A reading's squared normalised residual counts at most this much: a few outliers are no reason."""

FEWEST = 3
"""Readings below which a robot's sum says nothing."""

QUANTILE = 3.719
"""Standard normal quantile of a tail of 1e-4."""

NEAR_RANK = 1e-6
"""Directions in which Q − C is this small beside Q are not determined by the rest of the window."""


@dataclass(frozen=True)
class Suspect:
    """A member that fits badly since keyframe ``since``; excess: of its statistic over the tail's, 1 at the limit."""

    key: TrackKey
    since: int
    excess: float
    nodes: int = 1
    """for how many nodes in a row"""


def chi2_limit(dof: float) -> float:
    """What χ² with ``dof`` degrees of freedom exceeds with probability 1e-4 (Wilson–Hilferty)."""
    spread = 2.0 / (9.0 * dof)
    return float(dof * (1.0 - spread + QUANTILE * np.sqrt(spread)) ** 3)


def suspect(history: History, window: Window, poses: Array, g: float) -> Suspect | None:
    """The member that fits worst at node g [s], if it fits badly; poses (N, 3) are the window's optimum."""
    found = [*_carried(window, poses, g), *_rejected(history, window, poses, g)]
    worst = max(found, key=lambda s: (s.excess, s.key), default=None)
    return worst if worst is not None and worst.excess > 1.0 else None


def _carried(window: Window, poses: Array, g: float) -> list[Suspect]:
    """Odometry steps against the rest of the window."""
    rows = _strained(window, poses, int(np.floor(g * KEYFRAMES_PER_SECOND)))
    if len(window.layout) < 2 or not rows:
        return []
    begin, _, delta, information = window.problem.odometry
    at = np.array([index for _, _, index in rows])
    step = np.searchsorted(begin, at)  # every pose but a track's last begins one step, in order
    count = len(rows)
    joint = native.covariance(window.problem, poses, np.concatenate([at, at + 1])).reshape(2 * count, 3, 2 * count, 3)
    k = np.arange(count)
    first, second, cross = joint[k, :, k], joint[k + count, :, k + count], joint[k + count, :, k]
    motion = se2.between(poses[at], poses[at + 1])
    back = se2.adjoint(se2.inverse(motion))
    cross = cross @ back.swapaxes(1, 2)
    posterior = second - cross - cross.swapaxes(1, 2) + back @ first @ back.swapaxes(1, 2)
    claimed = np.asarray(np.linalg.inv(information[step]))
    drop = _drop(se2.between(delta[step], motion), claimed, posterior) / chi2_limit(3)
    return [Suspect(key, keyframe, float(t)) for (key, keyframe, _), t in zip(rows, drop, strict=True)]


def _strained(window: Window, poses: Array, now: int) -> list[tuple[TrackKey, int, int]]:
    """Each track's odometry step that the window bends most, in each interval: track, keyframe, index of its pose."""
    i, j, delta, information = window.problem.odometry
    u = se2.between(delta, se2.between(poses[i], poses[j]))
    strain = np.full(len(poses), -np.inf)
    strain[i] = np.einsum("ka,kab,kb->k", u, information, u)
    rows = []
    for key, (offset, first, count) in window.layout.items():
        until = now
        for back in INTERVALS:
            since, begin = now - int(back * KEYFRAMES_PER_SECOND), max(first, window.base + 1)
            oldest, end = max(since, begin), min(until, first + count - 1)
            if oldest < end:
                keyframe = oldest + int(np.argmax(strain[offset + oldest - first : offset + end - first]))
                rows.append((key, keyframe, offset + keyframe - first))
            until = since
    return rows


def _drop(u: Array, q: Array, c: Array) -> Array:
    """uᵀ(Q − C)⁻¹u (K,) over the directions that the rest of the window determines; u (K, 3), q and c (K, 3, 3)."""
    root = np.linalg.cholesky(q)
    white = np.linalg.solve(root, u[..., None])
    left = np.eye(3) - np.linalg.solve(root, np.linalg.solve(root, c).swapaxes(1, 2))
    values, vectors = np.linalg.eigh((left + left.swapaxes(1, 2)) / 2)
    part = (vectors.swapaxes(1, 2) @ white)[..., 0]
    return np.asarray(np.sum(np.where(values > NEAR_RANK, part**2 / np.maximum(values, NEAR_RANK), 0.0), axis=1))


def _rejected(history: History, window: Window, poses: Array, g: float) -> list[Suspect]:
    """Sums of every member's clipped squared residuals of the last 5 s."""
    since = g - INTERVALS[0]
    keys = list(window.layout)
    owner = np.repeat(np.arange(len(keys)), [count for _, _, count in window.layout.values()])
    total, number = np.zeros(len(keys)), np.zeros(len(keys))
    for scalars, stamps in zip(window.problem.scalars, window.stamps, strict=True):
        first = int(np.searchsorted(stamps, since, "right"))
        i, j = owner[scalars.i[first:]], owner[scalars.j[first:]]
        square = np.minimum(residuals(window.problem, scalars, poses)[first:] ** 2, CLIP)
        for end in (i, j):
            total += np.bincount(end, square, len(keys))
            number += np.bincount(end, minlength=len(keys))
    keyframe = int(np.floor(since * KEYFRAMES_PER_SECOND))
    return [
        Suspect(key, keyframe, total[k] / chi2_limit(number[k])) for k, key in enumerate(keys) if number[k] >= FEWEST
    ]
