"""Bounds on poses, c(x) ≤ 0: distances of pairs, speeds, workspaces. METHOD §5.

c = |axes ∘ (p − centre)| − limit [m], p the position of pose j in the frame of pose i. What holds a pose to a bound,
½ ρ max(0, c + m)², is a range of limit − m with σ = 1/√ρ and a kernel that lets shorter distances be: any solver
takes it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from dgorl import se2
from dgorl.optimization.problem import Indices, Loss, Scalars
from dgorl.se2 import Array

NEAREST = 1e-3
"""Directions are bounded where a pose is this close to the centre [m]."""
FAR = 1e4
"""A side of a box is a circle of this radius [m] that touches it opposite the pose."""
ONE_SIDED = Loss("huber_negative", 1e-12)
"""Shorter distances than the bound weigh nothing: the force left on them is this width · √ρ."""


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
        """c (M,) at the poses (N, 3): ≤ 0 where the bound is kept, else the excess [m]."""
        return np.asarray(np.hypot(*self._offsets(poses).T) - self.limit)

    def gradients(self, poses: Array) -> Array:
        """∂c (M, 6) by the right perturbations of pose i and pose j."""
        seen, off = self._positions(poses), self._offsets(poses)
        pull = off / np.maximum(np.hypot(*off.T), NEAREST)[:, None]
        turned = np.einsum("mi,mij->mj", pull, se2.rotation(poses[self.j, 2] - poses[self.i, 2]))
        spin = pull[:, 0] * seen[:, 1] - pull[:, 1] * seen[:, 0]
        return np.concatenate([-pull, spin[:, None], turned, np.zeros((len(self), 1))], axis=1)

    def factors(self, poses: Array, margin: Array, weight: float) -> Scalars:
        """½ ρ max(0, c + m)² as ranges: margin m (M,) [m], weight ρ [1/m²].

        A side of a box is straight only opposite the poses (N, 3): value and slope are right there, and the curvature
        is 1/``FAR``.
        """
        seen, off = self._positions(poses), self._offsets(poses)
        flat = self.axes.sum(axis=1) < 2
        centre, limit = self.centre.copy(), self.limit.copy()
        # From the side the pose is on, FAR back through the box.
        back = np.where(off >= 0, 1.0, -1.0) * (self.limit - FAR)[:, None]
        centre[flat] = np.where(self.axes > 0, self.centre + back, seen)[flat]
        limit[flat] = FAR
        still = np.zeros((len(self), 3))
        at_i = np.concatenate([centre, still[:, :1]], axis=1)
        sigma = np.full(len(self), weight**-0.5)
        return Scalars("range", self.i, self.j, at_i, still, still[:, 0], limit - margin, sigma, ONE_SIDED)

    def __getitem__(self, rows: Indices) -> Constraints:
        return Constraints(self.i[rows], self.j[rows], self.centre[rows], self.axes[rows], self.limit[rows])

    def _positions(self, poses: Array) -> Array:
        return se2.between(poses[self.i], poses[self.j])[:, :2]

    def _offsets(self, poses: Array) -> Array:
        return np.asarray(self.axes * (self._positions(poses) - self.centre))


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
