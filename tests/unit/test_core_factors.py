"""Every factor of the core: residual, gradient, Gauss–Newton and exact Hessian. METHOD §1, §2."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dgorl import _core, se2
from tests.unit.reference import (
    CAUCHY,
    CAUCHY_NEGATIVE,
    HUBER,
    HUBER_NEGATIVE,
    NONE,
    Twin,
    random_information,
)

Array = np.ndarray
SCALAR_KERNELS = [NONE, HUBER, CAUCHY, HUBER_NEGATIVE, CAUCHY_NEGATIVE]


def relative_poses(twin: Twin, rng: np.random.Generator, i: Array, j: Array, kernel: int) -> None:
    at_i, at_j = 0.5 * rng.normal(size=(2, len(i), 3))
    delta = rng.uniform(-3, 3, (len(i), 3))
    twin.add_relative_poses(i, j, at_i, at_j, delta, random_information(rng, len(i)), kernel, 1.5)


def odometry(twin: Twin, rng: np.random.Generator, i: Array, j: Array, kernel: int) -> None:
    twin.add_odometry(i, j, rng.uniform(-3, 3, (len(i), 3)), random_information(rng, len(i)))


def ranges(twin: Twin, rng: np.random.Generator, i: Array, j: Array, kernel: int) -> None:
    at_i, at_j = 0.5 * rng.normal(size=(2, len(i), 2))
    twin.add_ranges(
        i,
        j,
        at_i,
        at_j,
        rng.normal(size=len(i)),
        rng.uniform(1, 5, len(i)),
        np.full(len(i), 0.7),
        kernel,
        1.5,
    )


def rssi(twin: Twin, rng: np.random.Generator, i: Array, j: Array, kernel: int) -> None:
    at_i, at_j = 0.5 * rng.normal(size=(2, len(i), 2))
    measured, at_1m = rng.uniform(-70, -40, len(i)), rng.uniform(-50, -30, len(i))
    height, exponent = rng.normal(size=len(i)), rng.uniform(2, 6, len(i))
    twin.add_rssi(i, j, at_i, at_j, height, measured, at_1m, exponent, np.full(len(i), 3.0), kernel, 1.5)


def bearings(twin: Twin, rng: np.random.Generator, i: Array, j: Array, kernel: int) -> None:
    at_i, at_j = 0.5 * rng.normal(size=(len(i), 3)), 0.5 * rng.normal(size=(len(i), 2))
    twin.add_bearings(i, j, at_i, at_j, rng.uniform(-7, 7, len(i)), np.full(len(i), 0.6), kernel, 1.5)


def prior(twin: Twin, rng: np.random.Generator, i: Array, j: Array, kernel: int) -> None:
    members = np.array([1, 2, 3])
    twin.add_prior(0, members, rng.normal(size=(3, 3)), random_information(rng, 1, 9)[0], rng.normal(size=9))


def absolute_prior(twin: Twin, rng: np.random.Generator, i: Array, j: Array, kernel: int) -> None:
    members = np.array([2, 0])
    relative = twin.poses[members] + rng.uniform(-1, 1, (2, 3))  # away from the seam of the angle
    twin.add_prior(-1, members, relative, random_information(rng, 1, 6)[0], rng.normal(size=6))


Adder = Callable[[Twin, np.random.Generator, Array, Array, int], None]
CASES = [
    *((add, kernel) for add in (ranges, rssi, bearings) for kernel in SCALAR_KERNELS),
    *((relative_poses, kernel) for kernel in (NONE, HUBER, CAUCHY)),
    *((add, NONE) for add in (odometry, prior, absolute_prior)),
]
every_factor = pytest.mark.parametrize(("add", "kernel"), CASES, ids=lambda v: getattr(v, "__name__", str(v)))
every_gauge = pytest.mark.parametrize("fixed", [(), (1,), (0, 2)], ids=["free", "one fixed", "two fixed"])


def make(add: Adder, kernel: int, fixed: tuple[int, ...], seed: int) -> Twin:
    """Four poses on two slots, factors in both directions, within a slot and across."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-4, 4, (4, 2)), rng.uniform(-3, 3, 4)])
    twin = Twin.of(poses, np.array([4, 2, 2, 4]), np.isin(np.arange(4), fixed))
    add(twin, rng, np.array([0, 1, 2, 3, 1, 2]), np.array([1, 0, 1, 0, 3, 3]), kernel)
    return twin


@every_gauge
@every_factor
def test_matches_reference(add: Adder, kernel: int, fixed: tuple[int, ...]) -> None:
    for seed in range(5):
        twin = make(add, kernel, fixed, seed)
        assert twin.core.cost(twin.poses) == pytest.approx(twin.reference.cost(twin.poses), rel=1e-12)
        for mine, theirs in zip(
            twin.core.hessian(twin.poses), twin.reference.normal_equations(twin.poses), strict=True
        ):
            np.testing.assert_allclose(mine, theirs, atol=1e-9 * np.abs(theirs).max())


def body_step(poses: Array, xi: Array) -> Array:
    """x += R ξ_xy, θ += ξ_θ: the line along which ``exact`` differentiates."""
    moved = se2.compose(poses, np.concatenate([xi[:, :2], 0 * xi[:, 2:]], axis=1))
    return moved + np.concatenate([0 * xi[:, :2], xi[:, 2:]], axis=1)


@every_gauge
@every_factor
def test_gradient_and_exact_hessian_are_derivatives_of_the_cost(
    add: Adder, kernel: int, fixed: tuple[int, ...]
) -> None:
    for seed in range(5):
        twin = make(add, kernel, fixed, seed)
        free = twin.reference.free
        hessian, gradient = twin.core.hessian(twin.poses, exact=True)
        np.testing.assert_array_equal(gradient, twin.core.hessian(twin.poses)[1])

        def cost(xi: Array, twin: Twin = twin, free: Array = free) -> float:
            full = np.zeros(twin.poses.size)
            full[free] = xi
            return twin.core.cost(body_step(twin.poses, full.reshape(-1, 3)))

        step, unit = 1e-4, np.eye(len(free))
        numeric = np.array([(cost(step * u) - cost(-step * u)) / (2 * step) for u in unit])
        np.testing.assert_allclose(gradient, numeric, atol=1e-5 * max(1.0, np.abs(gradient).max()))
        second = np.array(
            [
                [
                    (cost(step * (u + v)) - cost(step * (u - v)) - cost(step * (v - u)) + cost(-step * (u + v)))
                    / (4 * step**2)
                    for v in unit
                ]
                for u in unit
            ]
        )
        np.testing.assert_allclose(hessian, second, atol=1e-5 * max(1.0, np.abs(hessian).max()))


@every_factor
def test_residuals_are_normalised(add: Adder, kernel: int) -> None:
    twin = make(add, kernel, (), 3)
    [(kind, values)] = twin.core.residuals(twin.poses)
    names = {ranges: "range", rssi: "rssi", bearings: "bearing", relative_poses: "relative_pose"}
    assert kind == names.get(add, "relative_pose" if add is odometry else "prior")
    factors = twin.reference.factors
    if kind == "prior":
        np.testing.assert_allclose(values.ravel(), factors[0].residual(twin.poses), atol=1e-12)
        return
    for row, factor in zip(values, factors, strict=True):
        e = factor.residual(twin.poses)
        np.testing.assert_allclose(row, np.linalg.cholesky(factor.information).T @ e, rtol=1e-10, atol=1e-12)


def test_odometry_is_a_relative_pose_without_offsets() -> None:
    rng = np.random.default_rng(1)
    i, j, delta, information = (
        np.array([0]),
        np.array([1]),
        rng.normal(size=(1, 3)),
        random_information(rng, 1),
    )
    poses = rng.normal(size=(2, 3))
    short, long = (_core.Graph(np.array([0, 1]), np.array([True, False])) for _ in range(2))
    short.add_odometry(i, j, delta, information)
    long.add_relative_poses(i, j, np.zeros((1, 3)), np.zeros((1, 3)), delta, information)
    for a, b in zip(short.hessian(poses), long.hessian(poses), strict=True):
        np.testing.assert_array_equal(a, b)


def test_semidefinite_information_measures_what_it_can() -> None:
    graph = _core.Graph(np.array([0, 0]), np.array([True, False]))
    zero = np.zeros((1, 3))
    graph.add_relative_poses([0], [1], zero, zero, zero, np.diag([4.0, 1.0, 0.0])[None])
    assert graph.cost(np.array([[0, 0, 0], [1.0, 2.0, 2.5]])) == pytest.approx(0.5 * (4 + 4))
    with pytest.raises(ValueError, match="pose 1 undetermined"):
        graph.covariance(np.zeros((2, 3)), [1])


@pytest.mark.parametrize("robust", [HUBER_NEGATIVE, CAUCHY_NEGATIVE])
def test_one_sided_kernels_are_quadratic_on_the_other_side(robust: int) -> None:
    def cost(kernel: int, measured: float) -> float:
        graph = _core.Graph(np.array([0, 0]), np.array([True, False]))
        zero2, zero, one = np.zeros((1, 2)), np.zeros(1), np.ones(1)
        graph.add_ranges([0], [1], zero2, zero2, zero, np.array([measured]), one, kernel, 1.0)
        return graph.cost(np.array([[0, 0, 0], [10.0, 0, 0]]))

    both = {HUBER_NEGATIVE: HUBER, CAUCHY_NEGATIVE: CAUCHY}[robust]
    assert cost(robust, 5.0) == cost(NONE, 5.0) == 12.5  # short range: e = +5
    assert cost(robust, 15.0) == cost(both, 15.0) < 12.5  # long range: e = −5


def test_coincident_antennas_stay_finite() -> None:
    graph = _core.Graph(np.array([0, 0]), np.array([True, False]))
    zero2, zero, one = np.zeros((1, 2)), np.zeros(1), np.ones(1)
    graph.add_ranges([0], [1], zero2, zero2, zero, one, one)
    graph.add_rssi([0], [1], zero2, zero2, zero, -40 * one, -40 * one, 3 * one, 2 * one)
    graph.add_bearings([0], [1], np.zeros((1, 3)), zero2, zero, one)
    for exact in (False, True):
        hessian, gradient = graph.hessian(np.zeros((2, 3)), exact=exact)
        assert np.isfinite(hessian).all()
        assert np.isfinite(gradient).all()
