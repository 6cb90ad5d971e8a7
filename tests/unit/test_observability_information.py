"""T2: the window's information against dense linear algebra, debiasing, and what it tells apart. METHOD §3."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from dgorl import se2
from dgorl.observability import bars
from dgorl.observability_information import Chains, Excitation, Heads, excited, measured
from dgorl.optimization import native
from dgorl.optimization.problem import DensePrior, Problem, RelativePoses

Array = np.ndarray
BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_observability", BENCHMARKS / "observability.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def by_dense_schur(problem: Problem, poses: Array, current: Array) -> Array:
    """S of the current poses but the first, which is held still: the others eliminated from the whole Hessian."""
    free = replace(problem, priors=(), fixed=np.zeros(len(poses), bool))
    hessian = native.graph(free).hessian(poses)[0]
    others = (3 * current[1:, None] + np.arange(3)).ravel()
    hidden = np.setdiff1d(np.arange(len(hessian)), [*others, *(3 * current[0] + np.arange(3))])
    cross = hessian[np.ix_(hidden, others)]
    return hessian[np.ix_(others, others)] - cross.T @ np.linalg.solve(hessian[np.ix_(hidden, hidden)], cross)


def test_information_is_what_the_dense_hessian_gives(benchmark: ModuleType) -> None:
    problem, poses, current, _ = team(benchmark, "random")
    found, wanted = Heads(measured(problem), current).information(poses), by_dense_schur(problem, poses, current)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3 * np.abs(wanted).max())


def test_a_robot_whose_data_is_late_is_carried_on(benchmark: ModuleType) -> None:
    """Without r3's last four keyframes: the Schur complement onto its last known one."""
    problem, poses, current, _ = team(benchmark, "random")
    gone = current[2] - np.arange(4)
    keep = np.setdiff1d(np.arange(len(poses)), gone)  # r3 comes last, so nobody is renumbered
    i, j, delta, information = problem.odometry
    on = ~np.isin(j, gone)
    (s,) = problem.scalars
    heard = ~(np.isin(s.i, gone) | np.isin(s.j, gone))
    rows = (s.i, s.j, s.at_i, s.at_j, s.height, s.value, s.sigma)
    late = replace(
        problem,
        slots=problem.slots[keep],
        fixed=problem.fixed[keep],
        initial=problem.initial[keep],
        odometry=(i[on], j[on], delta[on], information[on]),
        scalars=(type(s)(s.kind, *(row[heard] for row in rows), s.loss),),
    )
    newest = np.array([*current[:2], current[2] - 4])
    found = Heads(measured(late), newest).information(poses[keep])
    wanted = by_dense_schur(late, poses[keep], newest)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3 * np.abs(wanted).max())


def test_debiasing_takes_off_what_resampled_odometry_adds(benchmark: ModuleType) -> None:
    """One formula, recomputed: S_bc = 2 S(X̂) − mean S(X̂^(m)); sure odometry adds nothing, noisy odometry does."""
    problem, poses, current, names = team(benchmark, "parallel")
    found = excited(problem, poses, current, names, seed=9)
    units = np.tile([1.0, 1.0, 1.0 / found.scale], 2)
    once = by_dense_schur(problem, poses, current) * np.outer(units, units)
    assert np.linalg.eigvalsh(once)[0] == pytest.approx(0.0, abs=1e-6)
    chains = Chains(measured(problem), poses, current, np.random.default_rng(9))
    drawn = [by_dense_schur(problem, chains.draw(), current) * np.outer(units, units) for _ in range(6)]
    assert np.linalg.eigvalsh(np.mean(drawn, axis=0))[0] > 1e-3  # false information
    wanted = 2 * once - np.mean(drawn, axis=0)
    np.testing.assert_allclose(found.information, wanted, rtol=0, atol=5e-3 * np.abs(wanted).max())
    assert found.smallest < -1e-4
    assert not found.excited
    i, j, delta, information = problem.odometry
    sure = replace(problem, odometry=(i, j, delta, 1e6 * information))
    assert excited(sure, poses, current, names).smallest == pytest.approx(0.0, abs=1e-3)


def test_drawn_trajectories_have_the_odometrys_noise_and_end_where_they_did(benchmark: ModuleType) -> None:
    problem, poses, current, _ = team(benchmark, "random")
    chains = Chains(problem, poses, current, np.random.default_rng(0))
    i, j, delta, information = problem.odometry
    drawn = [chains.draw() for _ in range(200)]
    for trajectory in drawn:
        np.testing.assert_array_equal(trajectory[current], poses[current])
    error = np.array([se2.log(se2.between(delta, se2.between(x[i], x[j]))) for x in drawn]).reshape(-1, 3)
    np.testing.assert_allclose(np.cov(error.T), np.linalg.inv(information[0]), atol=5e-4)


def team(benchmark: ModuleType, kind: str, robots: int = 3) -> tuple[Problem, Array, Array, list[str]]:
    """A noisy window whose odometry is linearised at the truth."""
    setting = benchmark.Setting("range", robots, 12, 20.0, 1.0)
    rng = np.random.default_rng(4)
    truth = benchmark.random_walk(setting, rng) if kind == "random" else benchmark.degenerate(setting, kind, rng)
    problem, current = benchmark.window(setting, truth, rng)
    flat = truth.reshape(-1, 3)
    i, j, _, information = problem.odometry
    problem = replace(problem, odometry=(i, j, se2.between(flat[i], flat[j]), information))
    return problem, flat, current, [f"r{k + 1}" for k in range(robots)]


def same(a: Excitation, b: Excitation, rtol: float = 1e-9) -> None:
    np.testing.assert_allclose(a.information, b.information, rtol=rtol, atol=rtol * np.abs(a.information).max())


def test_the_same_seed_gives_the_same_bits(benchmark: ModuleType) -> None:
    arguments = team(benchmark, "random")
    one, two, other = (excited(*arguments, seed=seed) for seed in ((1, 2), (1, 2), (1, 3)))
    assert one.information.tobytes() == two.information.tobytes()
    assert one.smallest != other.smallest


def test_priors_the_world_and_kernels_do_not_count(benchmark: ModuleType) -> None:
    problem, poses, current, names = team(benchmark, "random")
    plain = excited(problem, poses, current, names)
    assert plain.excited
    size = len(poses)
    start = RelativePoses(
        np.array([size]), np.array([0]), np.zeros((1, 3)), np.zeros((1, 3)), poses[:1], 1e4 * np.eye(3)[None]
    )
    prior = DensePrior(0, current[1:2], se2.between(poses[0], poses[current[1:2]]), 1e4 * np.eye(3), np.zeros(3))
    scalars = tuple(replace(s, loss=replace(s.loss, kernel="cauchy", width=0.1)) for s in problem.scalars)
    known = replace(
        problem,
        slots=np.append(problem.slots, -1),
        fixed=np.append(problem.fixed, True),
        initial=np.vstack([problem.initial, np.zeros(3)]),
        relative_poses=start,
        priors=(*problem.priors, prior),
        scalars=scalars,
    )
    same(plain, excited(known, np.vstack([poses, np.zeros(3)]), current, names))


def test_measured_relative_poses_count(benchmark: ModuleType) -> None:
    problem, poses, current, names = team(benchmark, "all stand", 2)
    assert not excited(problem, poses, current, names).excited
    i, j = current[:1], current[1:]
    zero = np.zeros((1, 3))
    seen = RelativePoses(i, j, zero, zero, se2.between(poses[i], poses[j]), np.eye(3)[None])
    found = excited(replace(problem, relative_poses=seen), poses, current, names)
    assert found.excited
    assert found.smallest > 0.001


def test_null_motions_name_who_turns_where(benchmark: ModuleType) -> None:
    problem, poses, current, names = team(benchmark, "one stands")  # r1
    order = [1, 0, 2]  # seen from r2
    found = excited(problem, poses, current[order], [names[k] for k in order])
    assert not found.excited
    weakest = found.weak[0]
    assert weakest.robots == ("r1",)
    assert abs(weakest.motion["r1"][2]) > 0.95  # its heading
    assert np.linalg.norm(np.concatenate(list(weakest.motion.values()))) == pytest.approx(1.0)


def test_a_robot_alone_is_known(benchmark: ModuleType) -> None:
    problem, poses, current, names = team(benchmark, "random")
    assert excited(problem, poses, current[:1], names[:1]).excited


def test_a_robot_nobody_measures_is_not_excited(benchmark: ModuleType) -> None:
    problem, poses, current, names = team(benchmark, "random")
    found = excited(replace(problem, scalars=()), poses, current, names)
    assert not found.excited
    assert len(found.weak) == 6
    assert abs(found.margin) < 1e-3


def test_bars_of_a_window_are_its_ranges(benchmark: ModuleType) -> None:
    problem, poses, current, _ = team(benchmark, "random")
    (s,) = problem.scalars
    arms = replace(s, at_i=np.tile([0.3, -0.2, 0.0], (len(s.i), 1)), height=np.full(len(s.i), 2.0))
    rssi = replace(s, kind="rssi", sigma=np.full(len(s.i), 2.0))
    b = bars(replace(problem, scalars=(arms, rssi, replace(s, kind="bearing"))), poses, current)
    place = se2.transform(poses[s.i], [0.3, -0.2]) - poses[s.j, :2]
    np.testing.assert_allclose(b.distance[: len(s.i)], np.sqrt((place**2).sum(1) + 4))
    np.testing.assert_allclose(b.weight[: len(s.i)], 100.0)
    d = b.distance[len(s.i) :]
    np.testing.assert_allclose(b.weight[len(s.i) :], (30 / np.log(10) / 2 / d) ** 2)
    assert len(b.i) == 2 * len(s.i)
    count = len(poses) // 3
    np.testing.assert_array_equal(b.i[: len(s.i)], s.i // count)


def test_random_motion_is_told_from_degenerate(benchmark: ModuleType) -> None:
    """A small version of ``benchmarks/observability.py``, where teams of five have to be told apart."""
    setting = benchmark.Setting("range", 5, 20, 20.0, 1.0)
    random, degenerate = benchmark.pairs(setting, 24)
    area = benchmark.area_under_roc(np.array([e.smallest for e in random]), np.array([e.smallest for e in degenerate]))
    assert area >= 0.93
    assert sum(e.excited for e in random) >= 22
    assert sum(e.excited for e in degenerate) <= 4


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["rssi", "range"])
@pytest.mark.parametrize(("robots", "steps"), [(2, 60), (5, 20), (5, 60)])
def test_margins_tell_random_from_degenerate(benchmark: ModuleType, sensor: str, robots: int, steps: int) -> None:
    """The paper's speed. Two robots and 20 steps are left out: benchmarks/README.md says why."""
    random, degenerate = benchmark.pairs(benchmark.Setting(sensor, robots, steps), 200)
    area = benchmark.area_under_roc(np.array([e.margin for e in random]), np.array([e.margin for e in degenerate]))
    assert area >= 0.93
