"""A window graph as flat arrays: what every solver takes. METHOD §2, §5.

Poses are indexed 0…N−1; a factor names the poses it joins. Offsets are poses (or points) in the frame of the pose
they belong to: odometry since the keyframe, and the antenna.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dgorl.configuration import Kernel
from dgorl.se2 import Array

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Loss:
    """Robust kernel and its width [σ]."""

    kernel: Kernel = "none"
    width: float = 1.0

    @property
    def convex(self) -> Loss:
        """The kernel of the same side whose pull never fades: far from an optimum it still tells the way."""
        if self.kernel == "cauchy":
            return Loss("huber", self.width)
        return Loss("huber_negative", self.width) if self.kernel == "cauchy_negative" else self


@dataclass(frozen=True)
class RelativePoses:
    """Measured poses between pose i ⊕ at_i and pose j ⊕ at_j: delta (M, 3), information (M, 3, 3)."""

    i: Indices
    j: Indices
    at_i: Array
    at_j: Array
    delta: Array
    information: Array


@dataclass(frozen=True)
class Scalars:
    """Readings of one kind: value, sigma (M,) between pose i and pose j, at_i, at_j (M, 3), height (M,) [m]."""

    kind: str
    i: Indices
    j: Indices
    at_i: Array
    at_j: Array
    height: Array
    value: Array
    sigma: Array
    loss: Loss


@dataclass(frozen=True)
class DensePrior:
    """What the marginalised past says of poses relative to pose ``reference``: METHOD §1.

    cost ½ δᵀHδ + gᵀδ, δ_j = vec(relative_j⁻¹ X_ref⁻¹ X_j); relative (m, 3), information (3m, 3m), gradient (3m,).
    """

    reference: int
    members: Indices
    relative: Array
    information: Array
    gradient: Array


@dataclass(frozen=True)
class Problem:
    """slots (N,): time slot of each pose, −1 for the world; fixed (N,) bool; initial (N, 3); the factors.

    odometry: (i, j, delta (M, 3), information (M, 3, 3)) between successive keyframes.
    """

    slots: Indices
    fixed: NDArray[np.bool_]
    initial: Array
    odometry: tuple[Indices, Indices, Array, Array]
    scalars: tuple[Scalars, ...] = ()
    relative_poses: RelativePoses | None = None
    priors: tuple[DensePrior, ...] = ()
    radio: tuple[float, float] = field(default=(-40.0, 3.0))
    """A [dBm] and η of the path-loss model"""


@dataclass(frozen=True)
class Solution:
    """poses (N, 3), cost, iterations, reason for stopping, covariance (3m, 3m) of the selected poses."""

    poses: Array
    cost: float
    iterations: int
    reason: str
    covariance: Array
