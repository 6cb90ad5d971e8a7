"""Who is a suspect, and for how long: two nodes in a row mean the same story, or they do not count together."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from scipy.stats import chi2

from dgorl import se2
from dgorl.configuration import Kernel
from dgorl.consistency import Suspect, bend, chi2_limit, drop
from dgorl.graph import losses, residuals
from dgorl.optimization import native
from dgorl.optimization.problem import Loss, Problem, Scalars
from dgorl.tracks import TrackKey

R1 = TrackKey("r1", 0, 0.0)


def carried(since: int, nodes: int = 1) -> Suspect:
    return Suspect(R1, since, 2.0, True, nodes)


def rejected(since: int, nodes: int = 1) -> Suspect:
    return Suspect(R1, since, 2.0, False, nodes)


@pytest.mark.parametrize("tail", [1e-4, 1e-6])
@pytest.mark.parametrize("dof", [3, 10, 100])
def test_the_limit_is_the_quantile_of_the_tail(dof: int, tail: float) -> None:
    assert chi2_limit(dof, tail) == pytest.approx(chi2.isf(tail, dof), rel=0.07)


def test_a_new_suspect_counts_once() -> None:
    assert carried(99).after(None) == carried(99)


def test_the_same_step_counts_on_where_more_is_known_of_it() -> None:
    assert carried(100).after(carried(99)) == carried(100, nodes=2)


def test_another_step_begins_anew() -> None:
    assert carried(109).after(carried(99)) == carried(109)


def test_readings_that_lie_have_lied_since_they_were_first_found() -> None:
    assert rejected(110).after(rejected(100)) == rejected(100, nodes=2)
    assert rejected(120).after(rejected(100, nodes=2)) == rejected(100, nodes=3)


def test_a_step_first_and_readings_next_are_one_story() -> None:
    assert rejected(110).after(carried(99)) == rejected(99, nodes=2)
    assert carried(101).after(rejected(100)) == carried(101, nodes=2)


# ---- by how much the cost falls without a step ----

STEP_SIGMA = np.array([0.05, 0.004, 0.05])
"""Forward, sideways, heading of a step [m, m, rad]: wheels slip forwards, hardly ever sideways."""


def anchored(seed: int, count: int = 12, sigma: float = 0.1, step_sigma: np.ndarray = STEP_SIGMA) -> Problem:
    """A robot that drives among three fixed ones and measures its distance from them, at the optimum."""
    rng = np.random.default_rng(seed)
    anchors = np.array([[0.0, 0, 0], [6, 1, 0], [2, 7, 0]])
    told = np.column_stack([np.full(count - 1, 0.4), np.zeros(count - 1), rng.uniform(-0.5, 0.5, count - 1)])
    true = [np.array([3.0, 2.0, rng.uniform(-3, 3)])]
    for step in told:
        true.append(se2.compose(se2.compose(true[-1], se2.exp(step)), step_sigma * rng.normal(size=3)))
    poses = np.concatenate([anchors, true])
    i = 3 + np.arange(count - 1)
    a, b = np.repeat(np.arange(3), count), np.tile(3 + np.arange(count), 3)
    apart = np.hypot(*(poses[a] - poses[b])[:, :2].T)
    still = np.zeros((len(a), 3))
    value, sigmas = apart + sigma * rng.normal(size=len(a)), np.full(len(a), sigma)
    ranges = Scalars("range", a, b, still, still, np.zeros(len(a)), value, sigmas, Loss("none", 2.0))
    information = np.tile(np.diag(step_sigma**-2.0), (count - 1, 1, 1))
    slots = np.array([0, 0, 0, *range(count)])
    fixed = np.arange(count + 3) < 3
    problem = Problem(slots, fixed, poses, (i, i + 1, se2.exp(told), information), (ranges,))
    return replace(problem, initial=native.solve(problem, np.zeros(0, np.int64), 1e-9).poses)


def linear(problem: Problem, k: int) -> tuple[float, int]:
    """T of step k and its degrees of freedom, from covariances."""
    t, dof = drop(problem, problem.initial, problem.odometry[0][[k]])
    return float(t[0]), int(dof[0])


def exact(problem: Problem, k: int) -> float:
    """Twice by how much the cost falls when the step is given up."""
    i, j, delta, information = problem.odometry
    weak = information.copy()
    weak[k] *= 1e-9
    found = [
        native.solve(replace(problem, odometry=(i, j, delta, w)), np.zeros(0, np.int64), 1e-10).cost
        for w in (information, weak)
    ]
    return 2 * (found[0] - found[1])


@pytest.mark.parametrize("seed", range(8))
def test_t_is_what_the_cost_falls_by(seed: int) -> None:
    """Also where the rest of the window hardly determines a step: there 1 % of the frame's turn was all of T."""
    problem = anchored(seed)
    for k in range(3, 9):
        t, dof = linear(problem, k)
        assert dof == 3
        assert t == pytest.approx(exact(problem, k), rel=0.25, abs=0.6)


def test_t_is_chi_squared() -> None:
    found = np.array([linear(anchored(seed), 6)[0] for seed in range(300)])
    assert np.mean(found) == pytest.approx(3.0, rel=0.2)
    assert np.mean(found > chi2.isf(0.1, 3)) == pytest.approx(0.1, abs=0.05)
    assert np.mean(found > chi2.isf(0.01, 3)) < 0.03


def test_how_far_readings_bend_a_track_is_foreseen() -> None:
    found = np.array([bend(p, p.initial, p.odometry[0]) for p in map(anchored, range(300))])
    assert found[:, 0].mean() == pytest.approx(found[:, 1].mean(), rel=0.1)
    assert np.mean([s > chi2_limit(d, 1e-2) for s, d in found]) < 0.02


def test_odometry_of_another_time_is_bent_beyond_its_noise() -> None:
    """Five steps late, where it fits best."""
    for seed in range(10):
        p = anchored(seed, 60)
        i, j, delta, information = p.odometry
        late = replace(p, odometry=(i, j, np.roll(delta, 5, axis=0), information))
        poses = native.solve(late, np.zeros(0, np.int64), 1e-9).poses
        s, d = bend(late, poses, i)
        assert s > chi2_limit(d, 1e-4)


def test_what_is_rounding_counts_in_no_direction() -> None:
    """Nothing measures the last heading; and wheels good to a micrometre leave the rest nothing to say."""
    t, dof = linear(anchored(1), 10)
    assert dof == 2
    assert t < chi2.isf(1e-6, 2)
    for seed in range(5):
        t, dof = linear(anchored(seed, step_sigma=np.full(3, 2e-6)), 6)
        assert dof < 3
        assert t < chi2.isf(1e-6, 3)


def test_a_step_that_newton_refuses_shortens_no_later_one() -> None:
    """From bent starts Newton's Hessian is often indefinite; the damping of its tries stayed, and rose for ever."""
    taken = []
    for seed in range(60):
        problem = anchored(seed, 30)
        start = problem.initial.copy()
        bend = np.random.default_rng(seed).normal(size=(30, 3)) * (0.3, 0.3, 0.15)
        start[3:] += np.cumsum(bend, axis=0)
        taken.append(native.solve(replace(problem, initial=start), np.zeros(0, np.int64), 1e-9))
    assert {found.reason for found in taken} == {"converged"}
    assert max(found.iterations for found in taken) < 40


@pytest.mark.parametrize("kernel", get_args(Kernel))
@pytest.mark.parametrize("off", [-7.0, -0.2, 0.1, 5.0])
def test_losses_are_what_the_core_minimises(kernel: Kernel, off: float) -> None:
    still = np.zeros((1, 3))
    ranges = Scalars(
        "range",
        np.array([0]),
        np.array([1]),
        still,
        still,
        np.zeros(1),
        np.array([10.0 - off]),
        np.ones(1),
        Loss(kernel, 1.7),
    )
    none = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    poses = np.array([[0.0, 0, 0], [10, 0, 0]])
    problem = Problem(np.array([0, 0]), np.array([True, True]), poses, none, (ranges,))
    cost = native.graph(problem).cost(poses)
    assert losses(residuals(problem, ranges, poses), ranges.loss)[0] == pytest.approx(2 * cost)
