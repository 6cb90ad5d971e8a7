"""All factors of a problem as whitened residuals with Jacobians, in NumPy: what g2o and GTSAM get. METHOD §2, §5.

Every factor is the row of a family: cost = ½ |r|² up to a constant, with kernels and the linear term of priors.
So a solver of plain least squares finds the native core's optimum, whatever kernels it has itself. Robust factors
become r·√(ρ(s)/s), s = |r|², with the exact Jacobian of that: the one-sided kernels fit as well. A prior's
½ δᵀHδ + gᵀδ becomes |Lδ + b|², LᵀL = H, Lᵀb = g, less a constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from dgorl import se2
from dgorl.optimization.problem import DensePrior, Indices, Loss, Problem, RelativePoses, Scalars
from dgorl.radio import MINIMUM_DISTANCE
from dgorl.se2 import Array

NEAREST = 1e-3
"""Gradients of ranges and bearings stay bounded where the two points are closer than this [m]."""


Pose = tuple[float, ...]


class Family(NamedTuple):
    """M factors of p poses and dimension d: residual (M, d), jacobian (M, d, 3p) by right perturbations."""

    poses: Indices
    residual: Array
    jacobian: Array


class Linearization:
    """The factors one by one, at poses that are read anew whenever those of a factor have moved.

    read: gives the solver's present poses (N, 3). Solvers ask factor by factor; all are evaluated in one go.
    """

    def __init__(self, problem: Problem, read: Callable[[], Array]) -> None:
        self._parts = parts(problem)
        self._read = read
        self._move(np.array(problem.initial))
        self.factors = [
            (k, row, tuple(ends), family.residual.shape[1])
            for k, family in enumerate(self._families)
            for row, ends in enumerate(family.poses.tolist())
        ]
        """(family, row, poses, dimension) of each"""

    def at(self, factor: int, poses: Sequence[Pose]) -> tuple[Array, Array]:
        """Residual (d,) and Jacobian (d, 3p) of one factor, its own p poses given."""
        family, row, ends, _ = self.factors[factor]
        if any(self._poses[k] != pose for k, pose in zip(ends, poses, strict=True)):
            self._move(self._read())
        found = self._families[family]
        return found.residual[row], found.jacobian[row]

    def _move(self, poses: Array) -> None:
        self._poses = [tuple(pose) for pose in poses.tolist()]
        self._families = [part(poses) for part in self._parts]


Part = Callable[[Array], Family]


def parts(problem: Problem) -> list[Part]:
    """Functions of the poses (N, 3), one per family of factors."""
    i, j, delta, information = problem.odometry
    still = np.zeros((len(i), 3))
    found = [_relative_poses(RelativePoses(i, j, still, still, delta, information))]
    if problem.relative_poses is not None:
        found.append(_relative_poses(problem.relative_poses))
    found += [_scalars(scalars, problem.radio) for scalars in problem.scalars]
    found += [_prior(prior) for prior in problem.priors]
    return found


def cost(problem: Problem, poses: Array) -> float:
    """½ Σ |r|²: the native cost, less the constants of the priors."""
    return sum(float((part(poses).residual ** 2).sum()) for part in parts(problem)) / 2


def _relative_poses(f: RelativePoses) -> Part:
    """e = vec(δ⁻¹ (X_i·B_i)⁻¹ (X_j·B_j)), whitened by U, UᵀU = Ω."""
    ends, root = np.stack([f.i, f.j], axis=1), roots(f.information)

    def part(poses: Array) -> Family:
        x_i, x_j = poses[f.i], poses[f.j]
        error = se2.between(f.delta, se2.between(se2.compose(x_i, f.at_i), se2.compose(x_j, f.at_j)))
        # With Z = B_i δ the error is blkdiag(R_Zᵀ, 1) (v − t_Z, …), v the point of j in the frame of i.
        arm_j = _rotated(x_j[:, 2], f.at_j[:, :2])
        v = _rotated(-x_i[:, 2], x_j[:, :2] + arm_j - x_i[:, :2])
        jacobian = np.zeros((len(error), 3, 6))
        jacobian[:, :2, :2] = -np.eye(2)
        jacobian[:, :2, 2] = -_quarter_turn(v)
        jacobian[:, :2, 3:5] = se2.rotation(x_j[:, 2] - x_i[:, 2])
        jacobian[:, :2, 5] = _rotated(-x_i[:, 2], _quarter_turn(arm_j))
        jacobian[:, 2, 2], jacobian[:, 2, 5] = -1.0, 1.0
        turned = se2.rotation(-(f.at_i[:, 2] + f.delta[:, 2]))
        jacobian[:, :2] = turned @ jacobian[:, :2]
        return Family(ends, np.einsum("mij,mj->mi", root, error), root @ jacobian)

    return part


def _scalars(s: Scalars, radio: tuple[float, float]) -> Part:
    """Readings as functions of the vector from a point on body j to one on body i."""
    ends = np.stack([s.i, s.j], axis=1)

    def part(poses: Array) -> Family:
        x_i, x_j = poses[s.i], poses[s.j]
        arm_i, arm_j = _rotated(x_i[:, 2], s.at_i[:, :2]), _rotated(x_j[:, 2], s.at_j[:, :2])
        ab = x_i[:, :2] - x_j[:, :2] + arm_i - arm_j
        error, slope = _scalar(s, radio, x_i[:, 2], ab)
        jacobian = np.zeros((len(error), 1, 6))
        jacobian[:, 0, :2] = _rotated(-x_i[:, 2], slope)
        jacobian[:, 0, 2] = np.sum(slope * _quarter_turn(arm_i), axis=1) - (s.kind == "bearing")
        jacobian[:, 0, 3:5] = -_rotated(-x_j[:, 2], slope)
        jacobian[:, 0, 5] = -np.sum(slope * _quarter_turn(arm_j), axis=1)
        return robust(Family(ends, (error / s.sigma)[:, None], jacobian / s.sigma[:, None, None]), s.loss)

    return part


def _scalar(s: Scalars, radio: tuple[float, float], heading: Array, ab: Array) -> tuple[Array, Array]:
    """Errors (M,) in the sensor's unit and their derivative by ab (M, 2)."""
    squared = (ab**2).sum(axis=1)
    if s.kind == "bearing":
        seen = np.arctan2(-ab[:, 1], -ab[:, 0]) - heading - s.at_i[:, 2]
        return se2.wrap(seen - s.value), _quarter_turn(ab) / np.maximum(squared, NEAREST**2)[:, None]
    if s.kind == "rssi":
        at_1m, exponent = radio
        squared = np.maximum(squared + s.height**2, MINIMUM_DISTANCE**2)
        decay = 10 * exponent / np.log(10)
        return s.value - at_1m + decay / 2 * np.log(squared), decay * ab / squared[:, None]
    distance = np.sqrt(squared + s.height**2)
    return distance - s.value, ab / np.maximum(distance, NEAREST)[:, None]


def _prior(prior: DensePrior) -> Part:
    """δ_j = vec(Z_j⁻¹ X_ref⁻¹ X_j), one factor for all members."""
    values, vectors = np.linalg.eigh(prior.information)
    # Marginalisation leaves directions it says nothing of, with eigenvalues that are rounding.
    told = values > 1e-14 * values.max(initial=0.0)
    root = np.sqrt(values[told])[:, None] * vectors[:, told].T
    shift = vectors[:, told].T @ prior.gradient / np.sqrt(values[told])
    ends, turned = np.array([[*prior.members, prior.reference]]), se2.rotation(-prior.relative[:, 2])

    def part(poses: Array) -> Family:
        x_ref, x = poses[prior.reference], poses[prior.members]
        seen = se2.between(x_ref, x)
        jacobian = np.zeros((len(x), 3, len(x) + 1, 3))
        each = np.arange(len(x))
        jacobian[each, :2, each, :2] = turned @ se2.rotation(seen[:, 2])
        jacobian[:, :2, -1, :2] = -turned
        jacobian[:, :2, -1, 2] = -np.einsum("mij,mj->mi", turned, _quarter_turn(seen[:, :2]))
        jacobian[each, 2, each, 2], jacobian[:, 2, -1, 2] = 1.0, -1.0
        delta = se2.between(prior.relative, seen).ravel()
        whole = root @ jacobian.reshape(delta.size, -1)
        return Family(ends, (root @ delta + shift)[None], whole[None])

    return part


def robust(family: Family, loss: Loss) -> Family:
    """Residuals r·φ, φ² = ρ(s)/s, whose squares are ρ(s); d(rφ) = (φ + (ρ' − ρ/s)/(s φ) r rᵀ) dr."""
    if loss.kernel == "none":
        return family
    e, c = family.residual, loss.width
    s = np.maximum((e**2).sum(axis=1), 1e-30)
    if loss.kernel.startswith("huber"):
        ratio = np.where(s > c * c, (2 * c * np.sqrt(s) - c * c) / s, 1.0)
        weight = np.where(s > c * c, c / np.sqrt(s), 1.0)
    else:
        ratio, weight = c * c * np.log1p(s / c**2) / s, 1 / (1 + s / c**2)
    if loss.kernel.endswith("negative"):
        ratio, weight = np.where(e[:, 0] < 0, ratio, 1.0), np.where(e[:, 0] < 0, weight, 1.0)
    phi = np.sqrt(ratio)
    along = ((weight - ratio) / (s * phi))[:, None, None]
    change = phi[:, None, None] * np.eye(e.shape[1]) + along * e[:, :, None] * e[:, None, :]
    return Family(family.poses, phi[:, None] * e, change @ family.jacobian)


def roots(information: Array) -> Array:
    """U (M, d, d) with UᵀU = information, which may be singular."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[..., None] * np.swapaxes(vectors, -1, -2))


def _rotated(theta: Array, v: Array) -> Array:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], axis=1)


def _quarter_turn(v: Array) -> Array:
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)
