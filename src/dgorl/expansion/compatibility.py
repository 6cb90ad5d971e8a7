"""How well candidates of two bodies go together. METHOD §4.

θ_jl(a, b) = log N(e; 0, s²I + J_a P_a J_aᵀ + J_b P_b J_bᵀ), e the residuals of what the two measured of one another.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dgorl import se2
from dgorl.expansion.bodies import Sightings
from dgorl.expansion.candidates import Candidates
from dgorl.optimization.problem import Indices
from dgorl.se2 import Array

READINGS = 12
"""Readings of one pair and kind that are compared."""


def compatibility(
    found: list[Sightings], bodies: tuple[int, int], a: Candidates, b: Candidates, radio: tuple[float, float]
) -> Array:
    """θ (k_a, k_b) of the candidates of two bodies, from the sightings between them; zero without any."""
    theta = np.zeros((len(a), len(b)))
    for s in found:
        forward = (s.i == bodies[0]) & (s.j == bodies[1])
        rows = np.flatnonzero(forward | ((s.i == bodies[1]) & (s.j == bodies[0])))
        if not len(rows):
            continue
        rows = rows[np.linspace(0, len(rows) - 1, min(READINGS, len(rows))).astype(np.int64)]
        swap = ~forward[rows]
        on_a = np.where(swap[:, None], s.point_j[rows], s.point_i[rows])
        on_b = np.where(swap[:, None], s.point_i[rows], s.point_j[rows])
        e, jac_a, jac_b = _residual(s, rows, swap, a.poses[:, None], b.poses[None], on_a, on_b, radio)
        spread = jac_a @ a.covariance[:, None] @ jac_a.swapaxes(-1, -2)
        spread += jac_b @ b.covariance[None] @ jac_b.swapaxes(-1, -2)
        spread[..., np.arange(len(rows)), np.arange(len(rows))] += s.sigma[rows] ** 2
        root = np.linalg.cholesky(spread)
        white = np.linalg.solve(root, e[..., None])[..., 0]
        theta -= np.sum(white**2, axis=-1) / 2 + np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
    return theta


def _residual(
    s: Sightings,
    rows: Indices,
    swap: NDArray[np.bool_],
    T_a: Array,
    T_b: Array,
    on_a: Array,
    on_b: Array,
    radio: tuple[float, float],
) -> tuple[Array, Array, Array]:
    """Residuals (k_a, k_b, M), and Jacobians (..., M, 3) by right perturbations of T_a (k_a, 1, 3), T_b (1, k_b, 3)."""
    p_a, p_b = se2.compose(T_a[..., None, :], on_a), se2.compose(T_b[..., None, :], on_b)
    delta = p_a[..., :2] - p_b[..., :2]
    square = np.maximum(np.sum(delta**2, axis=-1) + s.height[rows] ** 2, 1e-2)
    distance = np.sqrt(square)
    value = s.value[rows]
    if s.kind == "bearing":
        sign = np.where(swap, 1.0, -1.0)
        observer = np.where(swap, p_b[..., 2], p_a[..., 2])
        e = se2.wrap(np.arctan2(sign * delta[..., 1], sign * delta[..., 0]) - observer - value)
        slope = np.stack([-delta[..., 1], delta[..., 0]], axis=-1) / square[..., None]
    elif s.kind == "rssi":
        at_1m, exponent = radio
        e = value - (at_1m - 10 * exponent * np.log10(distance))
        slope = (10 * exponent / np.log(10)) * delta / square[..., None]
    else:
        e, slope = distance - value, delta / distance[..., None]
    jac_a, jac_b = _turned(slope, T_a, on_a), -_turned(slope, T_b, on_b)
    if s.kind == "bearing":
        jac_a[..., ~swap, 2] -= 1.0
        jac_b[..., swap, 2] -= 1.0
    return e, jac_a, jac_b


def _turned(slope: Array, T: Array, on: Array) -> Array:
    """The slope (..., M, 2) by a point as one by the pose T (..., 3) it is carried by."""
    rotation = se2.rotation(T[..., 2])
    arm = on[:, :2] @ rotation.swapaxes(-1, -2)
    turn = slope[..., 1] * arm[..., 0] - slope[..., 0] * arm[..., 1]
    return np.concatenate([slope @ rotation, turn[..., None]], axis=-1)
