"""A window graph cut into what each robot knows: its prior, its odometry, half of each of its readings. METHOD §5.

Linearised at poses that all share, f_i is a quadratic of the tangent increments of all free poses, and a position is
linear in them. So a disc is a convex bound, and Σ f_i has the gradient of the graph's cost there: where these poses
are the graph's optimum under the discs, no increment is that of Σ f_i.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dgorl import se2
from dgorl.optimization.linearization import parts
from dgorl.optimization.problem import Indices, Problem
from dgorl.se2 import Array


@dataclass(frozen=True)
class LocalCost:
    """f_i(z) = ½ zᵀHz + gᵀz + constant (k), known to one robot, and the team's bounds |p_m + T_m z| ≤ limit (M).

    positions (M, 2) and turns T (M, 2, k) are relative to the disc's centre [m]. scale S (k, k): increments are S z.
    """

    hessian: Array
    gradient_at_0: Array
    constant: float
    positions: Array
    turns: Array
    limit: float
    scale: Array

    def value(self, z: Array) -> float:
        return float(0.5 * z @ self.hessian @ z + self.gradient_at_0 @ z + self.constant)

    def gradient(self, z: Array) -> Array:
        return np.asarray(self.hessian @ z + self.gradient_at_0)

    def bounds(self, z: Array) -> Array:
        """c (M,) ≤ 0 [m]."""
        return np.asarray(np.hypot(*self._offsets(z).T) - self.limit)

    def slopes(self, z: Array) -> Array:
        """∂c/∂z (M, k)."""
        offsets = self._offsets(z)
        along = offsets / np.maximum(np.hypot(*offsets.T), 1e-12)[:, None]
        return np.asarray(np.einsum("md,mdk->mk", along, self.turns))

    def projected(self, z: Array) -> Array:
        """The nearest increments, each pose for itself, that keep every bound."""
        offsets, increments = self._offsets(z), self.scale @ z
        far = np.hypot(*offsets.T)
        back = offsets * np.minimum(self.limit / np.maximum(far, 1e-12), 1.0)[:, None] - offsets
        flat = self.turns @ np.linalg.inv(self.scale)
        return np.asarray(np.linalg.solve(self.scale, increments + np.einsum("mdk,md->k", flat, back)))

    def scaled(self, scale: Array) -> LocalCost:
        """The same in z with increments = scale · z."""
        return replace(
            self,
            hessian=scale.T @ self.hessian @ scale,
            gradient_at_0=scale.T @ self.gradient_at_0,
            turns=self.turns @ scale,
            scale=self.scale @ scale,
        )

    def _offsets(self, z: Array) -> Array:
        return np.asarray(self.positions + self.turns @ z)


def local_costs(
    problem: Problem, poses: Array, owner: Indices, centre: tuple[float, float] = (0.0, 0.0), limit: float = 1e3
) -> tuple[LocalCost, ...]:
    """What each robot knows of the graph, linearised at ``poses`` (N, 3).

    owner: (N,) robot of each pose from 0 on, −1 of the world. centre, limit: of the disc in the world [m]. A factor is
    split evenly among the robots whose poses it joins.
    """
    free = np.flatnonzero(~problem.fixed)
    column = np.full(len(poses), -1)
    column[free] = np.arange(len(free))
    robots, size = int(owner.max()) + 1, 3 * len(free)
    hessians, gradients, constants = np.zeros((robots, size, size)), np.zeros((robots, size)), np.zeros(robots)
    for family in (part(poses) for part in parts(problem)):
        for ends, residual, jacobian in zip(family.poses, family.residual, family.jacobian, strict=True):
            whole = np.zeros((len(residual), size))
            for place, pose in enumerate(ends):
                if column[pose] >= 0:
                    at = 3 * column[pose]
                    whole[:, at : at + 3] += jacobian[:, 3 * place : 3 * place + 3]
            concerned = sorted({int(owner[pose]) for pose in ends} - {-1})
            for robot in concerned:
                hessians[robot] += whole.T @ whole / len(concerned)
                gradients[robot] += whole.T @ residual / len(concerned)
                constants[robot] += 0.5 * float(residual @ residual) / len(concerned)
    turns = np.zeros((len(free), 2, size))
    for row, pose in enumerate(free):
        turns[row, :, 3 * row : 3 * row + 2] = se2.rotation(poses[pose, 2])
    positions, one = poses[free, :2] - np.array(centre), np.eye(size)
    return tuple(
        LocalCost(hessian, gradient, constant, positions, turns, limit, one)
        for hessian, gradient, constant in zip(hessians, gradients, constants.tolist(), strict=True)
    )


def preconditioned(costs: tuple[LocalCost, ...], owner: Indices) -> tuple[LocalCost, ...]:
    """The costs in coordinates in which every robot's own block is that of n identities.

    owner: (k / 3,) robot of each free pose. Each robot tells the others the block its own cost has for its own poses.
    """
    scale = np.zeros_like(costs[0].scale)
    rows = np.repeat(owner, 3)
    for robot, cost in enumerate(costs):
        own = np.flatnonzero(rows == robot)
        block = np.linalg.cholesky(cost.hessian[np.ix_(own, own)])
        scale[np.ix_(own, own)] = np.sqrt(len(costs)) * np.linalg.inv(block).T
    return tuple(cost.scaled(scale) for cost in costs)
