"""Covariance intersection: never surer than it may be, and the formulas of METHOD §7."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl.baselines.fusion import Objective, bound, fused, shares
from dgorl.baselines.views import tightest
from dgorl.se2 import Array

JOINTS = 2000
SURE = 1e-9
"""An eigenvalue of claimed less true covariance may be this far below zero, relative to the largest claimed one."""

NONE = np.zeros((3, 3))


def spread(rng: np.random.Generator, size: int = 3) -> Array:
    """A random covariance, its scales orders of magnitude apart."""
    a = rng.normal(size=(size, size)) * np.exp(rng.normal(0.0, 1.5, size))
    return a @ a.T + 1e-6 * np.eye(size)


def together(rng: np.random.Generator, parts: list[Array]) -> Array:
    """A joint covariance with these diagonal blocks and otherwise anything, often singular."""
    size = 3 * len(parts)
    factor = rng.normal(size=(size, rng.integers(1, size + 1)))
    any_joint = factor @ factor.T + 1e-9 * np.eye(size)
    whole = np.zeros((size, size))
    scale = []
    for k, part in enumerate(parts):
        block = any_joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        scale.append(np.linalg.cholesky(part) @ np.linalg.inv(np.linalg.cholesky(block)))
    for i, left in enumerate(scale):
        for j, right in enumerate(scale):
            block = any_joint[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
            whole[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = left @ block @ right.T
    return whole


def readings(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Ranges from robot 0 to each peer, one or two, some with a lever. Jacobian and noise."""
    rows, noise = [], []
    for peer in range(1, n):
        for _ in range(rng.integers(1, 3)):
            row = np.zeros((n, 3))
            angle, lever = rng.uniform(-np.pi, np.pi), rng.choice([0.0, 0.3])
            row[0, :2] = np.cos(angle), np.sin(angle)
            row[0, 2] = lever * rng.normal()
            row[peer, :2] = -row[0, :2]
            rows.append(row)
            noise.append(np.exp(rng.normal(0.0, 2.0)))
    return np.array(rows), np.array(noise)


def least_gap(claimed: Array, true: Array) -> float:
    """Smallest eigenvalue of claimed − true, relative to the largest of claimed: negative is too sure."""
    return float(np.linalg.eigvalsh(claimed - true)[0] / np.linalg.eigvalsh(claimed)[-1])


@pytest.mark.parametrize("objective", ["det", "trace"])
@pytest.mark.parametrize("split", [False, True])
def test_never_too_sure_whatever_is_shared(split: bool, objective: Objective) -> None:
    """2000 random joints that agree with the stated parts: fused covariance ≥ true error covariance (Loewner)."""
    rng = np.random.default_rng([1, split])
    worst = np.inf
    for _ in range(JOINTS // 4):
        n = int(rng.integers(2, 5))
        dependent = np.array([spread(rng) for _ in range(n)])
        independent = np.array([spread(rng) if split else NONE for _ in range(n)])
        true = together(rng, list(dependent))
        for k in range(n):
            true[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += independent[k]
        jacobian, noise = readings(rng, n)
        omega = shares(dependent, independent, jacobian, noise, 0, objective)
        joint = bound(dependent, independent, omega)
        size = 3 * n
        assert omega.sum() == pytest.approx(1.0, abs=1e-12)
        assert least_gap(joint.reshape(size, size), true) > -SURE

        # The gain, read off the corrections of unit residuals, on the true errors.
        gain = np.column_stack([fused(joint, jacobian, noise, e, 0)[0][0] for e in np.eye(len(noise))])
        left = -gain @ jacobian.reshape(-1, size)
        left[:, :3] += np.eye(3)
        error = left @ true @ left.T + (gain * noise) @ gain.T
        claimed = fused(joint, jacobian, noise, np.zeros(len(noise)), 0)[1]
        worst = min(worst, least_gap(claimed, error))
    assert worst > -SURE


def test_naive_fusion_is_too_sure() -> None:
    """The property above can fail: with every ω = 1 it does, on most joints."""
    rng = np.random.default_rng(2)
    failed = 0
    for _ in range(200):
        dependent = np.array([spread(rng) for _ in range(2)])
        true = together(rng, list(dependent))
        jacobian, noise = readings(rng, 2)
        joint = bound(dependent, np.zeros((2, 3, 3)), np.ones(2))
        gain = np.column_stack([fused(joint, jacobian, noise, e, 0)[0][0] for e in np.eye(len(noise))])
        left = -gain @ jacobian.reshape(-1, 6)
        left[:, :3] += np.eye(3)
        error = left @ true @ left.T + (gain * noise) @ gain.T
        failed += least_gap(fused(joint, jacobian, noise, np.zeros(len(noise)), 0)[1], error) < -SURE
    assert failed > 50


def test_one_range_is_method_7() -> None:
    """A = D_i/ω + I_i, B = D_j/(1 − ω) + I_j, S = uᵀAu + uᵀBu + σ², K = Au/S, P⁺ = A − KSKᵀ, ω = argmin det P⁺."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        dependent = np.array([spread(rng), spread(rng)])
        independent = np.array([spread(rng), spread(rng)])
        angle, sigma = rng.uniform(-np.pi, np.pi), np.exp(rng.normal())
        u = np.array([np.cos(angle), np.sin(angle), 0.0])
        jacobian = np.stack([-u, u])[None]

        def by_the_formula(
            omega: float, d: Array = dependent, i: Array = independent, u: Array = u, sigma: float = float(sigma)
        ) -> tuple[Array, Array]:
            a, b = d[0] / omega + i[0], d[1] / (1 - omega) + i[1]
            s = u @ a @ u + u @ b @ u + sigma**2
            k = a @ u / s
            return a - s * np.outer(k, k), k

        grid = np.linspace(1e-3, 1 - 1e-3, 500)
        best = min(np.linalg.det(by_the_formula(omega)[0]) for omega in grid)
        omega = shares(dependent, independent, jacobian, np.array([sigma**2]), 0)
        correction, covariance = fused(
            bound(dependent, independent, omega), jacobian, np.array([sigma**2]), np.array([2.0]), 0
        )
        expected, gain = by_the_formula(float(omega[0]))
        np.testing.assert_allclose(covariance, expected, rtol=1e-9, atol=1e-9 * np.trace(expected))
        np.testing.assert_allclose(correction[0], -2.0 * gain, rtol=1e-9, atol=1e-12)
        assert np.linalg.det(covariance) <= 1.02 * best


def test_independent_robots_are_fused_as_a_kalman_filter_does() -> None:
    rng = np.random.default_rng(4)
    independent = np.array([spread(rng) for _ in range(3)])
    jacobian, noise = readings(rng, 3)
    none = np.zeros((3, 3, 3))
    omega = shares(none, independent, jacobian, noise, 0)
    _, covariance = fused(bound(none, independent, omega), jacobian, noise, np.zeros(len(noise)), 0)
    information = np.zeros((9, 9))
    for k in range(3):
        information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.linalg.inv(independent[k])
    h = jacobian.reshape(-1, 9)
    whole = np.linalg.inv(information + h.T @ np.diag(1 / noise) @ h)
    np.testing.assert_allclose(covariance, whole[:3, :3], rtol=1e-6, atol=1e-9)


def test_relative_covariance_bounds_any_correlation() -> None:
    rng = np.random.default_rng(5)
    difference = np.hstack([-np.eye(3), np.eye(3)])
    for _ in range(500):
        parts = [spread(rng), spread(rng)]
        error = difference @ together(rng, parts) @ difference.T
        assert least_gap(tightest(*parts), error) > -SURE
