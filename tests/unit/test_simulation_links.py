"""Statistics of simulated ranges and signals: noise, reach, reciprocity, correlation, no line of sight."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
import pytest

from dgorl.logs import Log
from dgorl.measurements import Range, Rssi
from dgorl.simulation import Scenario, simulate
from dgorl.simulation.links import shadowing


def distance(log: Log, a: str, b: str, stamp: float) -> float:
    k = round(stamp / 0.5)
    return float(np.linalg.norm(log.truth[a][k, 1:3] - log.truth[b][k, 1:3]))


def signal_errors(log: Log, exponent: float = 3.0) -> dict[tuple[str, str], dict[float, float]]:
    """RSSI less the model, by direction and stamp [dB]."""
    errors: dict[tuple[str, str], dict[float, float]] = defaultdict(dict)
    for m in log.measurements:
        if isinstance(m, Rssi):
            d = max(distance(log, m.transmitter, m.receiver, m.stamp), 0.1)
            errors[m.transmitter, m.receiver][m.stamp] = m.dbm + 40.0 + 10 * exponent * np.log10(d)
    return errors


def all_of(errors: dict[tuple[str, str], dict[float, float]]) -> list[float]:
    return [error for link in errors.values() for error in link.values()]


def range_errors(log: Log) -> list[float]:
    ranges = [m for m in log.measurements if isinstance(m, Range)]
    return [m.range - distance(log, m.robot, m.peer, m.stamp) for m in ranges]


@pytest.mark.parametrize(("exponent", "sigma"), [(3.0, 2.0), (2.0, 5.0)])
def test_signals_follow_the_path_loss_model(exponent: float, sigma: float) -> None:
    log = simulate(Scenario(steps=600, path_loss_exponent=exponent, shadowing_db=sigma))
    errors = all_of(signal_errors(log, exponent))
    assert len(errors) > 5000
    assert np.mean(errors) == pytest.approx(0.0, abs=4 * sigma / len(errors) ** 0.5)
    assert np.std(errors) == pytest.approx(sigma, rel=0.03)


def test_one_signal_a_direction_and_step_within_the_radios_range() -> None:
    log = simulate(Scenario(comm_range=25.0))
    heard = {(m.transmitter, m.receiver, m.stamp) for m in log.measurements if isinstance(m, Rssi)}
    assert len(heard) == sum(isinstance(m, Rssi) for m in log.measurements)
    expected = {
        (a, b, k * 0.5)
        for a in log.robots
        for b in log.robots
        for k in range(1, 101)
        if a != b and distance(log, a, b, k * 0.5) <= 25.0
    }
    assert heard == expected
    assert 0 < len(expected) < 5 * 4 * 100


def test_one_range_a_pair_and_step_measured_in_turn() -> None:
    log = simulate(Scenario(sensors=("range",), steps=1000, range_sigma=0.3, comm_range=100.0))
    ranges = [m for m in log.measurements if isinstance(m, Range)]
    assert len({(m.stamp, frozenset((m.robot, m.peer))) for m in ranges}) == len(ranges) == 10 * 1000
    assert sum(m.robot == "r1" for m in ranges) == sum(m.peer == "r1" for m in ranges) == 4 * 500
    assert {m.sigma for m in ranges} == {0.3}
    errors = range_errors(log)
    assert np.mean(errors) == pytest.approx(0.0, abs=4 * 0.3 / 100)
    assert np.std(errors) == pytest.approx(0.3, rel=0.03)
    assert log.configuration == {}


@pytest.mark.parametrize("reciprocity", [0.0, 0.6, 1.0])
def test_reciprocity_is_the_correlation_of_the_two_directions(reciprocity: float) -> None:
    log = simulate(Scenario(steps=1000, reciprocity=reciprocity, comm_range=100.0))
    errors = signal_errors(log)
    there, back = [], []
    for (a, b), link in errors.items():
        if a < b:
            there += list(link.values())
            back += list(errors[b, a].values())
    assert np.corrcoef(there, back)[0, 1] == pytest.approx(reciprocity, abs=0.04)
    assert np.std(there) == pytest.approx(2.0, rel=0.05)
    assert log.configuration["radio"]["reciprocity"] == reciprocity


def test_signals_are_independent_in_time_by_default() -> None:
    errors = signal_errors(simulate(Scenario(steps=1000, comm_range=100.0)))
    lagged = [np.corrcoef(list(link.values())[:-1], list(link.values())[1:])[0, 1] for link in errors.values()]
    assert abs(np.mean(lagged)) < 0.03


@pytest.mark.parametrize(("correlation", "way"), [(5.0, 1.0), (5.0, 5.0), (2.0, 1.0)])
def test_shadowing_is_forgotten_with_the_way(correlation: float, way: float) -> None:
    """Gudmundson: exp(−Δ/D) after Δ metres, here each end going half of them."""
    scenario = Scenario(shadowing_correlation=correlation, reciprocity=0.3)
    x = np.arange(40_000) * way / 2
    ends = np.stack([np.stack([x, 0 * x], -1), np.stack([-x, 0 * x], -1)], axis=1)
    series = shadowing(scenario, "r1 r2", ends)
    expected = np.exp(-way / correlation)
    for direction in series.T:
        assert np.std(direction) == pytest.approx(2.0, rel=0.05)
        assert np.corrcoef(direction[:-1], direction[1:])[0, 1] == pytest.approx(expected, abs=0.03)
    assert np.corrcoef(series.T)[0, 1] == pytest.approx(0.3, abs=0.06)


def test_shadowing_of_standing_ends_does_not_change() -> None:
    series = shadowing(Scenario(shadowing_correlation=5.0), "r1 r2", np.ones((50, 2, 2)))
    assert np.ptp(series, axis=0).max() < 1e-12
    assert np.ptp(shadowing(Scenario(), "r1 r2", np.ones((50, 2, 2))), axis=0).min() > 1.0


def test_shadowing_in_a_whole_log_is_correlated() -> None:
    errors = signal_errors(simulate(Scenario(steps=2000, shadowing_correlation=10.0, comm_range=100.0)))
    lagged = [np.corrcoef(list(link.values())[:-1], list(link.values())[1:])[0, 1] for link in errors.values()]
    assert 0.85 < np.mean(lagged) < 0.97


def test_without_line_of_sight_ranges_are_long_and_signals_weak() -> None:
    scenario = Scenario(sensors=("rssi", "range"), steps=1000, comm_range=100.0)
    clear, some = simulate(scenario), simulate(dataclasses.replace(scenario, nlos=0.2))
    excess = np.subtract(range_errors(some), range_errors(clear))
    loss = np.subtract(all_of(signal_errors(some)), all_of(signal_errors(clear)))
    for blocked, mean in ((excess, 1.5), (-loss, 6.0)):
        assert blocked.min() > -1e-9
        hit = blocked > 1e-9
        assert hit.mean() == pytest.approx(0.2, abs=0.015)
        assert blocked[hit].mean() == pytest.approx(mean, rel=0.08)


def test_ranges_are_never_negative() -> None:
    log = simulate(Scenario(sensors=("range",), area=10.0, speed=1.0, range_sigma=5.0, steps=300, robots=3))
    ranges = [m.range for m in log.measurements if isinstance(m, Range)]
    assert min(ranges) == 0.0
