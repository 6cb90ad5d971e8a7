"""The simulated world: its motion model, its chance, its options."""

from __future__ import annotations

import dataclasses
from math import pi, radians
from typing import Any

import numpy as np
import pytest

from dgorl import se2
from dgorl.errors import ConfigurationError
from dgorl.logs import Log
from dgorl.measurements import Bearing, Displacement, Range, Rssi
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate

STANDING = (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
LONG = Scenario(steps=4000, seed=1)


def twists(log: Log, robot: str) -> Array:
    """Reported (dx, dtheta) of each step, (steps, 2)."""
    steps = [m for m in log.measurements if isinstance(m, Displacement) and m.robot == robot]
    return np.array([[m.dx, m.dtheta] for m in steps])


def motion_noise(log: Log) -> Array:
    """True motion less the paper's model of the reported one, (steps · N, 3)."""
    rows = []
    for robot, truth in log.truth.items():
        way, turn = twists(log, robot).T
        x, y, heading = truth[:-1, 1:].T
        model = np.stack([x + way * np.cos(heading), y + way * np.sin(heading), heading + turn], axis=-1)
        difference = truth[1:, 1:] - model
        difference[:, 2] = se2.wrap(difference[:, 2])
        rows.append(difference)
    return np.concatenate(rows)


def test_the_papers_experiment() -> None:
    log = simulate(Scenario())
    assert log.robots == ("r1", "r2", "r3", "r4", "r5")
    steps = [m for m in log.measurements if isinstance(m, Displacement)]
    assert len(steps) == 500
    assert {(m.dx, m.dy) for m in steps} == {(0.25, 0.0)}
    assert {m.covariance for m in steps} == {(0.1 * 0.1, 0.0, 0.0, 0.1 * 0.1, 0.0, radians(0.5) ** 2)}
    assert sorted({m.start for m in steps} | {m.end for m in steps}) == [k * 0.5 for k in range(101)]
    assert {type(m) for m in log.measurements} == {Displacement, Rssi}
    assert sorted({m.stamp for m in log.measurements if isinstance(m, Rssi)}) == [k * 0.5 for k in range(1, 101)]
    assert all(rows.shape == (101, 4) for rows in log.truth.values())
    assert log.configuration == {
        "radio": {"rssi_at_1m_dbm": -40.0, "path_loss_exponent": 3.0, "sigma_db": 2.0, "reciprocity": 0.0}
    }


def test_motion_noise_is_what_odometry_claims() -> None:
    noise = motion_noise(simulate(LONG))
    sigma = np.array([0.1, 0.1, radians(0.5)])
    np.testing.assert_allclose(noise.mean(axis=0) / sigma, 0.0, atol=4 / np.sqrt(len(noise)))
    np.testing.assert_allclose(noise.std(axis=0) / sigma, 1.0, atol=0.02)
    np.testing.assert_allclose(np.corrcoef(noise.T), np.eye(3), atol=0.03)


def test_turn_rates_are_uniform_but_at_the_border() -> None:
    log = simulate(LONG)
    rates = np.concatenate([twists(log, robot)[:, 1] for robot in log.robots]) / 0.5
    inner = np.sort(rates[np.abs(rates) <= 1.0])
    assert 0.8 < len(inner) / len(rates) < 1.0
    expected = np.linspace(-1.0, 1.0, len(inner))
    assert np.max(np.abs(inner - expected)) < 0.05


@pytest.mark.parametrize("motion", ["random-walk", "formation"])
@pytest.mark.parametrize("lag", [0.0, 0.8])
def test_the_team_stays_in_the_area(motion: Any, lag: float) -> None:
    area = 20.0
    for seed in range(3):
        log = simulate(Scenario(steps=2000, seed=seed, motion=motion, wheel_lag=lag, area=area))
        places = np.concatenate([rows[:, 1:3] for rows in log.truth.values()])
        assert places.min() >= 0.0
        assert places.max() <= area
        assert np.ptp(places, axis=0).min() > area / 3


def test_formations_keep_their_shape_as_commanded() -> None:
    log = simulate(Scenario(motion="formation", steps=50))
    assert all(np.array_equal(twists(log, "r1"), twists(log, robot)) for robot in log.robots)
    assert len({rows[0, 3] for rows in log.truth.values()}) == 1
    assert np.ptp(twists(log, "r1")[:, 1]) > 0.1


def test_straight_robots_never_turn() -> None:
    log = simulate(Scenario(motion="straight"))
    assert all(np.array_equal(twists(log, robot), np.tile([0.25, 0.0], (100, 1))) for robot in log.robots)
    noise = motion_noise(log)
    assert 0.08 < noise[:, 0].std() < 0.12


def test_static_robots_do_not_move() -> None:
    log = simulate(Scenario(motion="static"))
    for robot, rows in log.truth.items():
        assert np.ptp(rows[:, 1:], axis=0).max() == 0.0
        assert not twists(log, robot).any()
    assert {m.covariance for m in log.measurements if isinstance(m, Displacement)} == {STANDING}


def test_the_same_seed_gives_the_same_log_another_seed_another() -> None:
    scenario = Scenario(sensors=("rssi", "range", "bearing"), nlos=0.1, teleport="r1@3:5", steps=20)
    one, two = simulate(scenario), simulate(scenario)
    other = simulate(dataclasses.replace(scenario, seed=1))
    assert (one.measurements, one.starts) == (two.measurements, two.starts)
    assert all(np.array_equal(one.truth[robot], two.truth[robot]) for robot in one.robots)
    assert one.measurements != other.measurements
    assert one.starts != other.starts


def test_one_sensor_does_not_disturb_another() -> None:
    alone = simulate(Scenario(sensors=("range",), steps=20))
    beside = simulate(Scenario(sensors=("rssi", "range", "bearing"), steps=20))
    assert [m for m in alone.measurements if isinstance(m, Range)] == [
        m for m in beside.measurements if isinstance(m, Range)
    ]


def test_known_starts_are_off_by_their_prior() -> None:
    errors = []
    for seed in range(200):
        log = simulate(Scenario(steps=1, seed=seed))
        for robot, start in log.starts.items():
            assert start.stamp == 0.0
            errors.append(np.array(start.pose) - log.truth[robot][0, 1:])
    scaled = np.array(errors)
    scaled[:, 2] = se2.wrap(scaled[:, 2])
    np.testing.assert_allclose(scaled.std(axis=0), [0.05, 0.05, radians(1)], rtol=0.1)
    np.testing.assert_allclose(scaled.mean(axis=0) / [0.05, 0.05, radians(1)], 0.0, atol=0.15)


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_wheel_scale_is_true_motion_over_reported(scale: float) -> None:
    plain, scaled = (
        simulate(Scenario(motion="straight")),
        simulate(Scenario(motion="straight", wheel_scale=scale)),
    )
    assert twists(plain, "r1").tolist() == twists(scaled, "r1").tolist()
    assert plain.configuration == scaled.configuration
    way = [np.linalg.norm(log.truth["r1"][-1, 1:3] - log.truth["r1"][0, 1:3]) for log in (plain, scaled)]
    assert way[1] - way[0] == pytest.approx((scale - 1) * 25, abs=0.05)


@pytest.mark.parametrize("lag", [0.2, 0.5, 0.75, 1.0])
def test_wheel_lag_shifts_true_motion_in_time(lag: float) -> None:
    """The true turn by step k is the reported turn rate integrated up to k Δt − lag, but for noise."""
    log = simulate(Scenario(wheel_lag=lag, steps=200))
    assert "motion" not in log.configuration
    for robot, rows in log.truth.items():
        reported = np.concatenate([[0.0], np.cumsum(twists(log, robot)[:, 1])])
        expected = np.interp(rows[:, 0] - lag, rows[:, 0], reported, left=0.0)
        step = se2.wrap(np.diff(rows[:, 3]) - np.diff(expected))
        assert np.std(step) == pytest.approx(radians(0.5), rel=0.25)


def test_teleport_moves_one_robot_once_and_odometry_does_not_notice() -> None:
    plain = simulate(Scenario(seed=3))
    log = simulate(Scenario(seed=3, teleport="r2@20.2:7"))
    jump = motion_noise(log).reshape(5, 100, 3)
    assert np.linalg.norm(jump[1, 40, :2]) == pytest.approx(7.0, abs=0.6)
    jump[1, 40] = 0.0
    assert np.abs(jump[:, :, :2]).max() < 0.6
    assert {m.epoch for m in log.measurements if isinstance(m, Displacement)} == {0}
    assert np.array_equal(log.truth["r1"], plain.truth["r1"])
    assert np.array_equal(log.truth["r2"][:41], plain.truth["r2"][:41])
    assert not np.array_equal(log.truth["r2"][41, 3], plain.truth["r2"][41, 3])


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"robots": 1}, "robots must be at least 2, got 1"),
        ({"steps": 0}, "steps must be at least 1"),
        ({"period": 0.0}, "period must be positive"),
        ({"area": -1.0}, "area must be positive"),
        ({"area": 3.0}, "area must be at least 4 m"),
        ({"speed": -0.1}, "speed must be 0 or more"),
        ({"range_sigma": 0.0}, "range_sigma must be positive"),
        ({"bearing_sigma": -0.1}, "bearing_sigma must be positive"),
        ({"path_loss_exponent": 0.0}, "path_loss_exponent must be positive"),
        ({"shadowing_db": 0.0}, "shadowing_db must be positive"),
        ({"shadowing_db": float("nan")}, "shadowing_db must be a finite number"),
        ({"comm_range": float("inf")}, "comm_range must be a finite number"),
        ({"shadowing_correlation": -1.0}, "shadowing_correlation must be 0 or more"),
        ({"reciprocity": 1.1}, "reciprocity must be from 0 to 1"),
        ({"nlos": -0.1}, "nlos must be from 0 to 1"),
        ({"wheel_scale": 0.0}, "wheel_scale must be positive"),
        ({"wheel_lag": -0.1}, "wheel_lag must be 0 or more"),
        ({"seed": -1}, "seed must be 0 or more"),
        ({"sensors": ()}, "sensors must be at least one"),
        ({"sensors": ("rsi",)}, "sensors: unknown `rsi`; did you mean `rssi`"),
        ({"motion": "straigth"}, "motion: unknown `straigth`; did you mean `straight`"),
        ({"teleport": "r2"}, "teleport must be NAME@T:METRES, like r2@20:5, got 'r2'"),
        ({"teleport": "r2@soon:5"}, "teleport must be NAME@T:METRES"),
        ({"teleport": "r9@20:5"}, "teleport: no robot is called `r9`"),
        ({"teleport": "r2@99:5"}, "teleport must be at a time from 0 to 50 s"),
        ({"teleport": "r2@nan:5"}, "teleport must be at a time from 0 to 50 s"),
        ({"teleport": "r2@20:0"}, "teleport must be less than 60 m far"),
    ],
)
def test_options_out_of_range(changes: dict[str, Any], what: str) -> None:
    with pytest.raises(ConfigurationError, match=what.replace("(", r"\(")):
        Scenario(**changes)


def test_whole_numbers_do_for_lengths() -> None:
    assert simulate(Scenario(area=60, speed=1, steps=2)).robots


def test_bearings_are_seen_from_the_body() -> None:
    log = simulate(Scenario(sensors=("bearing",), robots=3, steps=2000, bearing_sigma=0.05))
    bearings = [m for m in log.measurements if isinstance(m, Bearing)]
    errors = []
    for m in bearings:
        a, b = (log.truth[robot][round(m.stamp / 0.5), 1:] for robot in (m.observer, m.target))
        seen = se2.transform(se2.inverse(a), b[:2])
        errors.append(m.bearing - np.arctan2(seen[1], seen[0]))
    assert {m.sigma for m in bearings} == {0.05}
    assert np.std(se2.wrap(errors)) == pytest.approx(0.05, rel=0.05)
    assert all(-pi < m.bearing <= pi for m in bearings)
