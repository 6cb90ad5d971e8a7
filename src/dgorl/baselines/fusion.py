"""Fusing one robot's belief with what it hears of several peers at once. METHOD §7.

Of n robots' errors the dependent parts D may have anything in common, the independent parts I have nothing. With ω on
the simplex, the blocks D_k/ω_k + I_k bound their joint covariance, and readings update that as a Kalman filter does:
for two robots the split covariance intersection of METHOD §7, with I = 0 the plain one, with every ω = 1, which is no
bound, naive fusion. Peers fused one after another would have independent parts and readings inflated as well.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from dgorl.se2 import Array

Objective = Literal["det", "trace"]

ROUNDS = 30
"""Rounds in which the shares are improved at most."""

TOLERANCE = 1e-3
"""Largest change of a share at which they are good enough."""

LEAST = 1e-6
"""No share is smaller."""


def bound(dependent: Array, independent: Array, omega: Array) -> Array:
    """D_k/ω_k + I_k of n robots (n, 3, 3): blocks of a joint covariance (n, 3, n, 3)."""
    n = len(omega)
    joint = np.zeros((n, 3, n, 3))
    k = np.arange(n)
    joint[k, :, k] = dependent / omega[:, None, None] + independent
    return joint


def shares(
    dependent: Array, independent: Array, jacobian: Array, noise: Array, own: int, objective: Objective = "det"
) -> Array:
    """ω (n,), Σω = 1, that makes the determinant (or the position's trace) of the own fused covariance P smallest.

    With a gain K, P = Σ_k L_k (D_k/ω_k + I_k) L_kᵀ + KRKᵀ, L = (1 − KH) in the own rows, and the best shares for
    tr(W P) are ω_k ∝ √tr(W L_k D_k L_kᵀ). By turns with Kalman's gain, and W = P⁻¹ as log det is concave, no round
    makes the objective larger.
    """
    n = len(dependent)
    omega = np.full(n, 1.0 / n)
    weight = np.diag([1.0, 1.0, 0.0])
    for _ in range(ROUNDS):
        joint = bound(dependent, independent, omega)
        gain, covariance = _gain(joint, jacobian, noise, own)
        left = -np.tensordot(jacobian, gain, (0, 1)).transpose(0, 2, 1)
        left[own] += np.eye(3)
        if objective == "det":
            weight = np.linalg.inv(covariance)
        part = np.sum((left @ dependent @ left.transpose(0, 2, 1)) * weight, axis=(1, 2))
        following = np.sqrt(np.maximum(part, 0.0))
        following = np.maximum(following / max(following.sum(), LEAST), LEAST)
        following /= following.sum()
        done = np.abs(following - omega).max() < TOLERANCE
        omega = following
        if done:
            break
    return omega


def fused(joint: Array, jacobian: Array, noise: Array, residual: Array, own: int) -> tuple[Array, Array]:
    """Kalman update: corrections (n, 3) of all poses and the own covariance (3, 3).

    joint: (n, 3, n, 3). jacobian: (M, n, 3). noise: (M,) variances. residual: (M,).
    """
    through, s = _innovation(joint, jacobian, noise)
    _, covariance = _gain(joint, jacobian, noise, own)
    correction: Array = through.T @ np.linalg.solve(s, residual)
    return correction.reshape(-1, 3), covariance


def _gain(joint: Array, jacobian: Array, noise: Array, own: int) -> tuple[Array, Array]:
    """The own rows (3, M) of Kalman's gain, and the own covariance (3, 3) after it."""
    through, s = _innovation(joint, jacobian, noise)
    mine = through[:, 3 * own : 3 * own + 3]
    gain = np.linalg.solve(s, mine).T
    covariance = joint[own, :, own] - gain @ mine
    return np.asarray(gain), np.asarray((covariance + covariance.T) / 2)


def _innovation(joint: Array, jacobian: Array, noise: Array) -> tuple[Array, Array]:
    """HP (M, 3n) and the innovations' covariance (M, M)."""
    size = 3 * len(joint)
    h = jacobian.reshape(-1, size)
    through = h @ joint.reshape(size, size)
    return through, through @ h.T + np.diag(noise)
