"""Readings between robots as arrays, and their linearisation at the robots' poses. METHOD §2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from dgorl import se2
from dgorl.baselines.sightings import Sighting
from dgorl.configuration import Radio
from dgorl.graph import weights
from dgorl.optimization.problem import Loss
from dgorl.radio import MINIMUM_DISTANCE
from dgorl.se2 import Array

LEAST_TRUST = 1e-6


@dataclass(frozen=True, eq=False)
class Readings:
    """M readings between robots named by index. at_a, at_b (M, 3): in the frames of the robots' poses."""

    kinds: NDArray[np.str_]
    a: NDArray[np.int64]
    b: NDArray[np.int64]
    at_a: Array
    at_b: Array
    height: Array
    value: Array
    sigma: Array
    losses: tuple[Loss, ...]

    def of(self, robot: int) -> Readings:
        """Those that involve one robot."""
        use = (self.a == robot) | (self.b == robot)
        losses = tuple(loss for loss, used in zip(self.losses, use, strict=True) if used)
        at_a, at_b, height = self.at_a[use], self.at_b[use], self.height[use]
        kinds, a, b, value, sigma = self.kinds[use], self.a[use], self.b[use], self.value[use], self.sigma[use]
        return Readings(kinds, a, b, at_a, at_b, height, value, sigma, losses)


def gathered(sightings: Sequence[Sighting], names: Sequence[str]) -> Readings:
    """The arrays of some sightings between robots ``names``."""
    return Readings(
        kinds=np.array([s.kind for s in sightings]),
        a=np.array([names.index(s.a.key.robot) for s in sightings], dtype=np.int64),
        b=np.array([names.index(s.b.key.robot) for s in sightings], dtype=np.int64),
        at_a=np.array([s.at_a for s in sightings]),
        at_b=np.array([s.at_b for s in sightings]),
        height=np.array([s.height for s in sightings]),
        value=np.array([s.value for s in sightings]),
        sigma=np.array([s.sigma for s in sightings]),
        losses=tuple(s.loss for s in sightings),
    )


def linearized(readings: Readings, poses: Array, radio: Radio) -> tuple[Array, Array]:
    """Residuals (M,), reading − expected, and Jacobians (M, n, 3) of what is expected at the poses (n, 3).

    By right perturbations of the poses. Distances below 0.1 m are taken for 0.1 m: there neither direction nor path
    loss has a meaning.
    """
    pose_a, pose_b = poses[readings.a], poses[readings.b]
    end_a, end_b = se2.compose(pose_a, readings.at_a), se2.compose(pose_b, readings.at_b)
    apart = end_b[:, :2] - end_a[:, :2]
    bearing, rssi = readings.kinds == "bearing", readings.kinds == "rssi"
    distance = np.maximum(np.sqrt(np.sum(apart**2, axis=1) + readings.height**2), MINIMUM_DISTANCE)
    exponent = radio.path_loss_exponent
    expected = np.where(rssi, radio.rssi_at_1m_dbm - 10.0 * exponent * np.log10(distance), distance)
    slope = apart / (distance * np.where(rssi, distance * log(10.0) / (-10.0 * exponent), 1.0))[:, None]
    flat = np.maximum(np.sum(apart**2, axis=1), MINIMUM_DISTANCE**2)
    turn = np.stack([-apart[:, 1], apart[:, 0]], axis=1) / flat[:, None]
    expected = np.where(bearing, np.arctan2(apart[:, 1], apart[:, 0]) - end_a[:, 2], expected)
    slope = np.where(bearing[:, None], turn, slope)
    jacobian = np.zeros((len(apart), len(poses), 3))
    rows = np.arange(len(apart))
    jacobian[rows, readings.a] = -_by_pose(slope, pose_a, readings.at_a)
    jacobian[rows, readings.a, 2] -= bearing
    jacobian[rows, readings.b] = _by_pose(slope, pose_b, readings.at_b)
    residual = readings.value - expected
    return np.where(bearing, se2.wrap(residual), residual), jacobian


def trust(readings: Readings, residual: Array, variance: Array) -> Array:
    """Robust weights (M,) of innovations: the sensors' kernels on residuals in their own σ."""
    # The core's signs: of ranges it is expected less measured.
    signed = np.where(readings.kinds == "range", -residual, residual) / np.sqrt(variance)
    each = [float(weights(np.array([e]), loss)[0]) for e, loss in zip(signed, readings.losses, strict=True)]
    return np.maximum(each, LEAST_TRUST)


def _by_pose(slope: Array, T_w_k: Array, at: Array) -> Array:
    """slope (M, 2) · ∂p/∂ξ of points fixed to frames: p = t + R(ξ_xy + (I + ξ_θ J) at). (M, 3)."""
    c, s = np.cos(T_w_k[:, 2]), np.sin(T_w_k[:, 2])
    x, y = c * slope[:, 0] + s * slope[:, 1], c * slope[:, 1] - s * slope[:, 0]
    return np.stack([x, y, at[:, 0] * y - at[:, 1] * x], axis=1)
