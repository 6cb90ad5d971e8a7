"""The estimate stays close to the expected Cramér–Rao bound and honest about it; the benchmark runs 100 trials."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from dgorl.evaluation.bounds import bound
from dgorl.replay import known_starts
from dgorl.simulation import Scenario
from tests.integration.teams import settings, simulated

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize(
    ("trials", "ratio", "inside"), [(6, 1.4, 0.85), pytest.param(100, 1.05, 0.92, marks=pytest.mark.slow)]
)
def test_error_over_bound(trials, ratio, inside):
    trial = runpy.run_path(str(BENCHMARKS / "bound.py"))["trial"]
    found = [trial(seed, Scenario()) for seed in range(1000, 1000 + trials)]
    least = np.mean([t["bound"]["square"] for t in found])
    for window in ("all", "20.0"):
        square = np.mean([t[window]["square"] for t in found])
        assert np.sqrt(square / least) <= ratio
        assert np.mean([t[window]["inside"] for t in found]) >= inside
    short, whole = (np.mean([t[w]["square"] for t in found]) for w in ("20.0", "all"))
    assert np.sqrt(short / whole) == pytest.approx(1.0, abs=0.01)


def test_the_bound_of_a_known_start_is_its_prior():
    """Two robots, nothing measured yet: the bound of their relative pose is that of the two starts."""
    log = simulated(robots=2, steps=20)
    first = bound(log, settings(log), list(known_starts(log)), np.array([0.5]))
    (covariance,) = first["r1", "r2"]
    distance = np.hypot(*(log.truth["r1"][1, 1:3] - log.truth["r2"][1, 1:3]))
    sigma, turn = 2 * 0.05**2 + 2 * 0.1**2, np.radians(1) ** 2 + np.radians(0.5) ** 2
    # At most the starts and one step of odometry; the first RSSI reading says little more.
    assert np.trace(covariance[:2, :2]) <= 2 * sigma + turn * distance**2 + 1e-9
    assert np.trace(covariance[:2, :2]) >= 0.5 * sigma
    assert covariance[2, 2] <= 2 * turn + 1e-12


def test_more_data_lowers_the_bound():
    log = simulated(robots=3, steps=40)
    less = simulated(robots=3, steps=40, comm_range=1e-3)
    stamps = np.array([5.0, 20.0])
    with_links = bound(log, settings(log), list(known_starts(log)), stamps)
    without = bound(less, settings(less), list(known_starts(less)), stamps)
    for pair, covariance in with_links.items():
        assert (
            np.trace(covariance[:, :2, :2], axis1=1, axis2=2) < np.trace(without[pair][:, :2, :2], axis1=1, axis2=2)
        ).all()
