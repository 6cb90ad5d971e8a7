"""Linearised readings against differences, altimeters against a brute-force posterior, beliefs against odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dgorl import se2
from dgorl.baselines.beliefs import Belief, advanced, begun
from dgorl.baselines.navigation import above
from dgorl.baselines.readings import Readings, linearized
from dgorl.configuration import Configuration, Radio
from dgorl.history import History
from dgorl.measurements import Displacement
from dgorl.optimization.problem import Loss
from dgorl.se2 import Array
from dgorl.terrain import Altitude, Terrain
from dgorl.tracks import Track

RADIO = Radio()
STEP = 1e-6


def made(kinds: list[str], rng: np.random.Generator) -> Readings:
    count = len(kinds)
    return Readings(
        np.array(kinds), np.zeros(count, np.int64), np.ones(count, np.int64),
        rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), rng.normal(size=count),
        rng.normal(size=count), np.ones(count), (Loss("none", 1.0),) * count,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["rssi", "range", "bearing"])
def test_jacobians_are_differences(kind: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        readings, poses = made([kind] * 3, rng), rng.normal(size=(2, 3)) * (5.0, 5.0, 2.0)
        _, jacobian = linearized(readings, poses, RADIO)
        for robot in range(2):
            for axis in range(3):
                ends = []
                for sign in (1, -1):
                    moved = poses.copy()
                    moved[robot] = se2.compose(poses[robot], se2.exp(sign * STEP * np.eye(3)[axis]))
                    ends.append(linearized(readings, moved, RADIO)[0])
                slope = -se2.wrap(ends[0] - ends[1]) / (2 * STEP)
                np.testing.assert_allclose(jacobian[:, robot, axis], slope, rtol=1e-5, atol=1e-5)


def test_what_is_expected() -> None:
    """Antennas 3 m above one another and 4 m apart; a target to the left."""
    poses = np.array([[1.0, 1.0, np.pi / 2], [1.0, 5.0, 0.0]])
    readings = made(["rssi", "range", "bearing"], np.random.default_rng(0))
    still = np.zeros((3, 3))
    readings = replace(readings, at_a=still, at_b=still, height=np.full(3, 3.0), value=np.array([-61.0, 5.5, 0.1]))
    residual, _ = linearized(readings, poses, RADIO)
    np.testing.assert_allclose(residual, [-61.0 - (-40.0 - 30.0 * np.log10(5.0)), 0.5, 0.1])


def one_track() -> Track:
    history = History(Configuration())
    for k in range(8):
        noise = (0.01, 0.001, 0.0, 0.02, 0.0, 0.0004)
        history.add(Displacement("r1", 0.5 * k, 0.5 * k + 0.5, 0.4, 0.01, 0.2, noise))
    history.admit(4.0, node_due=True)
    return history.trails["r1"].tracks[0]


def test_odometry_noise_is_independent() -> None:
    """Moments of many noisy drives; the dependent part only turns with the body."""
    start, p = np.array([1.0, 2.0, 0.5]), np.diag([0.04, 0.09, 0.01])
    belief = advanced(begun(one_track(), 0.0, start, p), 6)
    rng = np.random.default_rng(1)
    q = np.array([[0.01, 0.001, 0.0], [0.001, 0.02, 0.0], [0.0, 0.0, 0.0004]])
    poses = se2.compose(start, se2.exp(rng.multivariate_normal(np.zeros(3), p, 40_000)))
    for _ in range(6):
        # A displacement's covariance is of (dx, dy, dθ) in the frame at its start.
        poses = se2.compose(poses, np.array([0.4, 0.01, 0.2]) + rng.multivariate_normal(np.zeros(3), q, 40_000))
    error = se2.log(se2.between(belief.pose, poses))
    np.testing.assert_allclose(np.cov(error.T), belief.covariance, atol=0.02 * np.trace(belief.covariance))
    ahead = np.zeros(3)
    for _ in range(6):
        ahead = se2.compose(ahead, (0.4, 0.01, 0.2))
    back = se2.adjoint(se2.inverse(ahead))
    np.testing.assert_allclose(belief.dependent, back @ p @ back.T, rtol=1e-9, atol=1e-12)


def slope_map(rise: float) -> Terrain:
    line = np.linspace(-50.0, 50.0, 201)
    return Terrain(line, line, np.tile(rise * line, (201, 1)))


def test_on_a_slope_an_altimeter_is_a_kalman_filter() -> None:
    a = np.array([[1.0, 0.2, 0.1], [0.2, 2.0, -0.3], [0.1, -0.3, 0.2]])
    belief = Belief(one_track(), 0, np.array([3.0, -1.0, 0.7]), 0.7 * a, 0.3 * a)
    seen = above(belief, np.zeros(3), Altitude("r1", 0.0, 0.5 * 3.8, 0.4), slope_map(0.5))
    h = np.array([0.5 * np.cos(0.7), -0.5 * np.sin(0.7), 0.0])
    gain = a @ h / (h @ a @ h + 0.16)
    left = np.eye(3) - np.outer(gain, h)
    correction = se2.log(se2.between(belief.pose, seen.pose))
    np.testing.assert_allclose(correction, gain * 0.4, atol=2e-3)
    np.testing.assert_allclose(seen.covariance, left @ a, atol=5e-3)
    np.testing.assert_allclose(seen.dependent, left @ (0.7 * a) @ left.T, atol=5e-3)


def test_a_reading_off_the_map_says_nothing_there() -> None:
    a = np.eye(3)
    flat = Terrain(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.zeros((2, 2)))
    belief = Belief(one_track(), 0, np.array([30.0, 30.0, 0.0]), a, np.zeros((3, 3)))
    seen = above(belief, np.zeros(3), Altitude("r1", 0.0, 0.0, 0.1), flat)
    np.testing.assert_allclose(seen.pose, belief.pose, atol=1e-9)
    np.testing.assert_allclose(seen.covariance, a, atol=2e-3)


def test_moments_on_rough_ground() -> None:
    """Against weighted samples of the whole pose."""
    rng = np.random.default_rng(2)
    line = np.linspace(-20.0, 20.0, 161)
    x, y = np.meshgrid(line, line)
    rough = Terrain(line, line, np.sin(0.7 * x) + 0.5 * np.cos(0.9 * y + 0.3 * x))
    p: Array = np.array([[1.0, 0.3, 0.1], [0.3, 0.8, -0.05], [0.1, -0.05, 0.04]])
    belief = Belief(one_track(), 0, np.array([2.0, 1.0, -0.4]), p, np.zeros((3, 3)))
    reading = Altitude("r1", 0.0, 1.1, 0.3)
    seen = above(belief, np.array([0.2, 0.0, 0.0]), reading, rough)
    xi = rng.multivariate_normal(np.zeros(3), p, 400_000)
    # The filter's own model: points move linearly with ξ, which at this heading's σ is nearly exact.
    turn = se2.rotation(-0.4)
    points = np.array([2.0, 1.0]) + (xi[:, :2] + np.outer(xi[:, 2], [0.0, 0.2]) + [0.2, 0.0]) @ turn.T
    mass = np.exp(-0.5 * ((reading.height - rough.at(points)) / reading.sigma) ** 2)
    mean = np.average(xi, axis=0, weights=mass)
    np.testing.assert_allclose(se2.log(se2.between(belief.pose, seen.pose)), mean, atol=0.05)
    np.testing.assert_allclose(seen.covariance, np.cov(xi.T, aweights=mass), atol=0.02)
