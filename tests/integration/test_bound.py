"""The estimate stays close to the expected Cramér–Rao bound and honest about it; the benchmark runs 100 trials."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dgorl.evaluation.bounds import bound
from dgorl.measurements import Displacement
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


def test_the_bound_of_unknown_starts_is_that_of_starts_known_badly():
    """No start, the gauge one robot, and starts that say next to nothing, the gauge the world."""
    log = simulated(robots=4, steps=60)
    stamps = np.array([10.0, 30.0])
    unknown = bound(log, settings(log), [], stamps)
    nothing = (1e6, 0.0, 0.0, 1e6, 0.0, 1e3)
    vague = bound(log, settings(log), [replace(s, covariance=nothing) for s in known_starts(log)], stamps)
    known = bound(log, settings(log), list(known_starts(log)), stamps)
    assert set(unknown) == set(vague) == {(a, b) for a in log.robots for b in log.robots if a != b}
    for pair, covariance in unknown.items():
        assert covariance == pytest.approx(vague[pair], rel=2e-3, abs=1e-3)
        assert (np.linalg.eigvalsh(covariance - known[pair]) > 0).all()


def test_the_bound_is_infinite_while_the_data_leaves_a_pose_undetermined():
    log = simulated(robots=2, steps=60)
    (series,) = {
        pair: c for pair, c in bound(log, settings(log), [], np.array([0.5, 30.0])).items() if pair[0] == "r1"
    }.values()
    assert np.isnan(series[0]).all()
    assert np.isfinite(series[1]).all()


def test_a_heading_nothing_tells_of_leaves_the_bound_of_the_position():
    """A robot that stands still: ranges find its place, never its heading."""
    log = simulated(robots=3, steps=60, sensors=("range",))
    still = tuple(
        replace(m, dx=0.0, dtheta=0.0, covariance=(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6))
        if isinstance(m, Displacement) and m.robot == "r3"
        else m
        for m in log.measurements
    )
    stands = np.array(log.truth["r3"])
    stands[:, 1:] = stands[0, 1:]
    log = replace(log, measurements=still, truth={**log.truth, "r3": stands})
    found = bound(log, settings(log), [], np.array([30.0]))
    assert np.isfinite(found["r1", "r3"][0, :2, :2]).all()
    assert np.isnan(found["r1", "r3"][0, 2]).all()
    assert np.isfinite(found["r1", "r2"]).all()


def test_those_who_never_hear_one_another_have_no_bound():
    log = simulated(robots=3, steps=20, comm_range=1e-3)
    assert bound(log, settings(log), [], np.array([10.0])) == {}


def test_robust_kernels_do_not_move_the_bound():
    log = simulated(robots=3, steps=40, sensors=("range",))
    stamps = np.array([20.0])
    plain, robust = (bound(log, settings(log, ranging={"kernel": k}), [], stamps) for k in ("none", "cauchy"))
    for pair, covariance in plain.items():
        assert (covariance == robust[pair]).all()
