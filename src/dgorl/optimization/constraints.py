"""Bounds on poses, c(x) ≤ 0: distances of pairs, speeds, workspaces. METHOD §5.

c = (|axes ∘ (p − centre)|² − limit²) / (2 limit), p the position of pose j in the frame of pose i: near the bound it
is the excess in metres. It is quadratic in p, so μ c is a relative-pose factor.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from dgorl import se2
from dgorl.optimization.problem import Indices, RelativePoses
from dgorl.se2 import Array


@dataclass(frozen=True)
class Constraints:
    """M bounds on the position of pose j in the frame of pose i: i, j (M,), centre, axes (M, 2), limit (M,) > 0 [m].

    axes are 1 for a coordinate that counts, 0 for one that does not. One of the poses may be fixed.
    """

    i: Indices
    j: Indices
    centre: Array
    axes: Array
    limit: Array

    def __len__(self) -> int:
        return len(self.limit)

    def values(self, poses: Array) -> Array:
        """c (M,) at the poses (N, 3): ≤ 0 where the bound is kept, else about the excess [m]."""
        off = self.axes * (self._positions(poses) - self.centre)
        return np.asarray(((off**2).sum(axis=1) - self.limit**2) / (2 * self.limit))

    def gradients(self, poses: Array) -> Array:
        """∂c (M, 6) by the right perturbations of pose i and pose j."""
        seen = self._positions(poses)
        pull = self.axes**2 * (seen - self.centre) / self.limit[:, None]
        turned = np.einsum("mi,mij->mj", pull, se2.rotation(poses[self.j, 2] - poses[self.i, 2]))
        spin = pull[:, 0] * seen[:, 1] - pull[:, 1] * seen[:, 0]
        return np.concatenate([-pull, spin[:, None], turned, np.zeros((len(self), 1))], axis=1)

    def factors(self, multipliers: Array) -> RelativePoses:
        """μᵀc as factors, up to the constant −½ Σ μ limit."""
        information = np.zeros((len(self), 3, 3))
        information[:, [0, 1], [0, 1]] = self.axes**2 * (multipliers / self.limit)[:, None]
        still = np.zeros((len(self), 3))
        delta = np.concatenate([self.centre, still[:, :1]], axis=1)
        return RelativePoses(self.i, self.j, still, still, delta, information)

    def __getitem__(self, rows: Indices) -> Constraints:
        return Constraints(self.i[rows], self.j[rows], self.centre[rows], self.axes[rows], self.limit[rows])

    def _positions(self, poses: Array) -> Array:
        return se2.between(poses[self.i], poses[self.j])[:, :2]


def distances(i: Indices, j: Indices, maximum: float | Array) -> Constraints:
    """Pose i and pose j (M,) are at most ``maximum`` [m] apart."""
    flat = np.zeros((len(i), 2))
    return Constraints(i, j, flat, flat + 1, np.broadcast_to(np.asarray(maximum, dtype=float), len(i)))


def disc(world: int, poses: Indices, centre: tuple[float, float], radius: float) -> Constraints:
    """Poses (M,) are in a disc of the frame of pose ``world``."""
    flat = np.zeros((len(poses), 2))
    return Constraints(np.full(len(poses), world), poses, flat + centre, flat + 1, np.full(len(poses), float(radius)))


def box(world: int, poses: Indices, low: tuple[float, float], high: tuple[float, float]) -> Constraints:
    """Poses (M,) are in a box of the frame of pose ``world``: one bound per axis."""
    middle, half = (np.array(low) + high) / 2, (np.array(high) - low) / 2
    sides = [
        replace(disc(world, poses, (middle[0], middle[1]), half[k]), axes=np.tile(np.eye(2)[k], (len(poses), 1)))
        for k in range(2)
    ]
    return together(sides)


def together(parts: Iterable[Constraints]) -> Constraints:
    """All of them as one."""
    none = np.zeros(0, np.int64)
    found = [distances(none, none, 1.0), *parts]
    return Constraints(
        i=np.concatenate([c.i for c in found]),
        j=np.concatenate([c.j for c in found]),
        centre=np.concatenate([c.centre for c in found]),
        axes=np.concatenate([c.axes for c in found]),
        limit=np.concatenate([c.limit for c in found]),
    )
