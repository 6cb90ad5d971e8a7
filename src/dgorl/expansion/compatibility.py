"""How well candidates of two bodies go together: θ_jl(a, b) = log N(e; 0, s²I + J_a P_a J_aᵀ + J_b P_b J_bᵀ). METHOD §4."""

from __future__ import annotations

import numpy as np

from dgorl import se2
from dgorl.expansion.bodies import Sightings
from dgorl.expansion.candidates import Candidates
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
        for x in range(len(a)):
            for y in range(len(b)):
                e, jac_a, jac_b = _residual(s, rows, swap, a.poses[x], b.poses[y], on_a, on_b, radio)
                spread = jac_a @ a.covariance[x] @ jac_a.T + jac_b @ b.covariance[y] @ jac_b.T
                spread[np.diag_indices(len(rows))] += s.sigma[rows] ** 2
                root = np.linalg.cholesky(spread)
                white = np.linalg.solve(root, e)
                theta[x, y] -= white @ white / 2 + np.log(np.diagonal(root)).sum()
    return theta


def _residual(
    s: Sightings, rows: Array, swap: Array, T_a: Array, T_b: Array, on_a: Array, on_b: Array, radio: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """Residuals (M,) and their Jacobians (M, 3) by right perturbations of both places."""
    p_a, p_b = se2.compose(T_a, on_a), se2.compose(T_b, on_b)
    delta = p_a[:, :2] - p_b[:, :2]
    square = np.maximum(np.sum(delta**2, axis=1) + s.height[rows] ** 2, 1e-2)
    distance = np.sqrt(square)
    turn = np.zeros((2, len(rows)))
    if s.kind == "bearing":
        observer, sign = np.where(swap, p_b[:, 2], p_a[:, 2]), np.where(swap, 1.0, -1.0)
        e = se2.wrap(np.arctan2(sign * delta[:, 1], sign * delta[:, 0]) - observer - s.value[rows])
        slope = np.stack([-delta[:, 1], delta[:, 0]], axis=1) / square[:, None]
        turn[np.where(swap, 1, 0), np.arange(len(rows))] = -1.0
    elif s.kind == "rssi":
        at_1m, exponent = radio
        e = s.value[rows] - (at_1m - 10 * exponent * np.log10(distance))
        slope = (10 * exponent / np.log(10)) * delta / square[:, None]
    else:
        e, slope = distance - s.value[rows], delta / distance[:, None]
    jac = []
    for T, on, sign in ((T_a, on_a, 1.0), (T_b, on_b, -1.0)):
        rotation = se2.rotation(T[2])
        arm = on[:, :2] @ rotation.T
        quarter = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
        jac.append(sign * np.column_stack([slope @ rotation, np.sum(slope * quarter, axis=1)]))
    jac[0][:, 2] += turn[0]
    jac[1][:, 2] += turn[1]
    return e, jac[0], jac[1]
