"""θ of two bodies' candidates is the log density of METHOD §4, its Jacobians by differences."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import se2
from dgorl.expansion.bodies import Sightings
from dgorl.expansion.candidates import Candidates
from dgorl.expansion.compatibility import READINGS, compatibility
from dgorl.optimization.problem import Loss
from tests.unit.reference import random_information

Array = np.ndarray
RADIO = (-38.0, 2.7)
BODIES = (2, 5)


def places(rng: np.random.Generator, count: int, spread: float) -> Candidates:
    poses = np.column_stack([rng.uniform(-6, 6, (count, 2)), rng.uniform(-3, 3, count)])
    return Candidates(poses, np.zeros(count), spread * np.linalg.inv(random_information(rng, count)))


def sightings(rng: np.random.Generator, kind: str, count: int) -> Sightings:
    """Readings of about the right size, in both directions; two rows are of other bodies."""
    i = np.where(rng.random(count) < 0.5, *BODIES)
    j = np.where(i == BODIES[0], BODIES[1], BODIES[0])
    i[[0, -1]], j[[0, -1]] = [0, BODIES[0]], [BODIES[1], 1]
    low, high = {"range": (3, 9), "rssi": (-65, -50), "bearing": (-3, 3)}[kind]
    value = rng.uniform(low, high, count)
    points = rng.normal(size=(2, count, 3)) * 2
    height = rng.normal(size=count) if kind != "bearing" else np.zeros(count)
    nothing = np.full(count, np.nan)
    return Sightings(kind, i, j, *points, height, value, rng.uniform(0.2, 0.5, count), nothing, nothing, Loss())


def residuals(s: Sightings, rows: Array, T_a: Array, T_b: Array) -> Array:
    """Expected − measured (M,), of readings between the bodies at T_a and T_b."""
    found = []
    for m in rows:
        T_i, T_j = (T_a, T_b) if s.i[m] == BODIES[0] else (T_b, T_a)
        end_i, end_j = se2.compose(T_i, s.point_i[m]), se2.compose(T_j, s.point_j[m])
        d = np.hypot(np.hypot(*(end_i - end_j)[:2]), s.height[m])
        match s.kind:
            case "range":
                found.append(d - s.value[m])
            case "rssi":
                found.append(RADIO[0] - 10 * RADIO[1] * np.log10(d) - s.value[m])
            case _:
                x, y, _ = se2.between(end_i, end_j)
                found.append(se2.wrap(np.arctan2(y, x) - s.value[m]))
    return np.array(found)


def log_density(s: Sightings, rows: Array, a: tuple[Array, Array], b: tuple[Array, Array]) -> float:
    """log N(e; 0, s²I + J_a P_a J_aᵀ + J_b P_b J_bᵀ), without the constant that all candidates share."""
    (T_a, P_a), (T_b, P_b) = a, b
    steps = 1e-6 * np.eye(3)

    def moved(da: Array, db: Array) -> Array:
        return residuals(s, rows, se2.compose(T_a, da), se2.compose(T_b, db))

    zero = np.zeros(3)
    jac_a = np.transpose([moved(d, zero) - moved(-d, zero) for d in steps]) / 2e-6
    jac_b = np.transpose([moved(zero, d) - moved(zero, -d) for d in steps]) / 2e-6
    e = residuals(s, rows, T_a, T_b)
    spread = np.diag(s.sigma[rows] ** 2) + jac_a @ P_a @ jac_a.T + jac_b @ P_b @ jac_b.T
    return float(-e @ np.linalg.solve(spread, e) / 2 - np.linalg.slogdet(spread)[1] / 2)


@pytest.mark.parametrize("spread", [1e-3, 0.3])
@pytest.mark.parametrize("kind", ["range", "rssi", "bearing"])
@pytest.mark.parametrize("seed", range(3))
def test_theta_is_the_log_density(kind, spread, seed):
    rng = np.random.default_rng(seed)
    s = sightings(rng, kind, READINGS)
    a, b = places(rng, 3, spread), places(rng, 4, spread)
    rows = np.flatnonzero(np.isin(s.i, BODIES) & np.isin(s.j, BODIES))
    assert len(rows) == READINGS - 2
    expected = [
        [log_density(s, rows, here, there) for there in zip(b.poses, b.covariance, strict=True)]
        for here in zip(a.poses, a.covariance, strict=True)
    ]
    np.testing.assert_allclose(compatibility([s], BODIES, a, b, RADIO), expected, rtol=1e-5, atol=1e-5)


def test_kinds_add_up_and_bodies_change_places():
    rng = np.random.default_rng(7)
    found = [sightings(rng, kind, READINGS) for kind in ("range", "rssi", "bearing")]
    a, b = places(rng, 3, 0.1), places(rng, 4, 0.1)
    whole = compatibility(found, BODIES, a, b, RADIO)
    np.testing.assert_allclose(whole, sum(compatibility([s], BODIES, a, b, RADIO) for s in found), rtol=1e-12)
    np.testing.assert_allclose(whole, compatibility(found, BODIES[::-1], b, a, RADIO).T, rtol=1e-9)


def test_without_readings_everything_goes_together():
    rng = np.random.default_rng(0)
    a, b = places(rng, 2, 0.1), places(rng, 3, 0.1)
    np.testing.assert_array_equal(compatibility([sightings(rng, "range", 6)], (7, 8), a, b, RADIO), np.zeros((2, 3)))


def test_the_true_places_go_together_best():
    """Of candidates on a ring, the pair from which exact ranges follow scores highest."""
    rng = np.random.default_rng(3)
    a, b = places(rng, 6, 1e-4), places(rng, 6, 1e-4)
    s = sightings(rng, "range", 40)
    fits = s.value + residuals(s, np.arange(40), a.poses[2], b.poses[4])
    s = Sightings(s.kind, s.i, s.j, s.point_i, s.point_j, s.height, fits, s.sigma, s.distance, s.slope, s.loss)
    theta = compatibility([s], BODIES, a, b, RADIO)
    assert np.unravel_index(np.argmax(theta), theta.shape) == (2, 4)
