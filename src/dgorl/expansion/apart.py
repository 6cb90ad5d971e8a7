"""Which optima are different ones: Mahalanobis distance under the better one's H + Π. METHOD §4."""

from __future__ import annotations

import numpy as np

from dgorl import se2
from dgorl.optimization.problem import Indices
from dgorl.se2 import Array

SAME = 3.0
"""Optima nearer than this Mahalanobis distance are one."""


def apart(poses: Array, covariance: Array, order: Indices, limit: int) -> list[int]:
    """At most ``limit`` of ``order`` (best first) of which none is in the place of one before it.

    poses: (B, m, 3). covariance: (B, 3m, 3m) of right perturbations.
    """
    taken = np.zeros(len(order), bool)
    keep: list[int] = []
    for row, b in enumerate(order.tolist()):
        if taken[row]:
            continue
        if len(keep) == limit:
            break
        keep.append(b)
        difference = se2.between(poses[b], poses[order[row:]]).reshape(len(order) - row, -1)
        information = np.linalg.inv(covariance[b])
        taken[row:] |= np.einsum("bi,ij,bj->b", difference, information, difference) <= SAME**2
    return keep
