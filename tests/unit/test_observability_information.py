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
from dgorl.configuration import Motion
from dgorl.observability import bars
from dgorl.observability_information import Chains, Excitation, Heads, excited, measured, sharper
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


def test_blunting_odometry_is_sharpening_what_was_measured(benchmark: ModuleType) -> None:
    problem, poses, current, _ = team(benchmark, "random")
    (s,) = problem.scalars
    sharp = replace(problem, scalars=(replace(s, sigma=s.sigma / 5),))
    found, wanted = Heads(measured(problem), current, 25.0).information(poses), by_dense_schur(sharp, poses, current)
    wanted = np.linalg.inv(wanted)
    np.testing.assert_allclose(np.linalg.inv(found), wanted, rtol=0, atol=1e-3 * wanted.max())


def test_the_margin_asks_how_robots_moved_whatever_the_sensor(benchmark: ModuleType) -> None:
    """The same ranges 10 × as blunt: less is known, the motion was driven as much."""
    problem, poses, current, names = team(benchmark, "random")
    (s,) = problem.scalars
    blunt = replace(problem, scalars=(replace(s, sigma=10 * s.sigma),))
    one, other = excited(problem, poses, current, names), excited(blunt, poses, current, names)
    assert one.smallest > 3 * other.smallest > 0
    assert one.margin == pytest.approx(other.margin, abs=1e-3)


def test_readings_count_as_a_step_of_odometry_and_never_less_than_they_do(benchmark: ModuleType) -> None:
    problem, poses, current, _ = team(benchmark, "random")
    (s,) = problem.scalars
    position = np.linalg.inv(problem.odometry[3])[:, [0, 1], [0, 1]].mean(axis=1)
    assert sharper(problem, bars(problem, poses, current)) == pytest.approx(0.1**2 / np.median(position))
    for sharp in (replace(problem, scalars=(replace(s, sigma=s.sigma / 1000),)), replace(problem, scalars=())):
        assert sharper(sharp, bars(sharp, poses, current)) == 1.0


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
    units = np.tile([found.scale, found.scale, 1.0], 2)
    once = by_dense_schur(problem, poses, current) * np.outer(units, units)
    assert np.linalg.eigvalsh(once)[0] == pytest.approx(0.0, abs=1e-6)
    chains = Chains(measured(problem), poses, current, np.random.default_rng(9))
    drawn = [by_dense_schur(problem, chains.draw(), current) * np.outer(units, units) for _ in range(6)]
    assert np.linalg.eigvalsh(np.mean(drawn, axis=0))[0] > 1.0  # false information
    wanted = 2 * once - np.mean(drawn, axis=0)
    np.testing.assert_allclose(found.information, wanted, rtol=0, atol=5e-3 * np.abs(wanted).max())
    assert found.smallest < -1.0
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
    error = np.array([se2.log(se2.between(delta, se2.between(x[i], x[j]))) for x in drawn])
    white = np.einsum("kji,mkj->mki", np.linalg.cholesky(information), error).reshape(-1, 3)
    np.testing.assert_allclose(np.cov(white.T), np.eye(3), atol=0.06)


@pytest.mark.parametrize("noise", ["wheels", "paper"])
def test_odometry_of_the_benchmark_errs_as_much_as_it_claims(benchmark: ModuleType, noise: str) -> None:
    """Half of the robots stand. Wheels: METHOD §1 by the configuration's defaults; paper: as the simulator."""
    setting = benchmark.Setting("range", 20, 40, noise=noise)
    rng = np.random.default_rng(0)
    truth = benchmark.random_walk(setting, rng)
    truth[10:] = truth[10:, :1]
    problem, _ = benchmark.window(setting, truth, rng)
    i, j, delta, information = problem.odometry
    step = se2.between(truth.reshape(-1, 3)[i], truth.reshape(-1, 3)[j])
    white = np.einsum("kji,kj->ki", np.linalg.cholesky(information), se2.log(se2.between(step, delta)))
    for part in np.split(white, 2):
        np.testing.assert_allclose((part**2).mean(axis=0), 1.0, atol=0.2)
    variance = np.linalg.inv(information).diagonal(axis1=1, axis2=2)
    m = Motion()
    turn, way = np.abs(step[:, 2]), np.hypot(*step[:, :2].T)
    heading = m.heading_per_second**2 / 2 + m.heading_per_radian**2 * turn + m.heading_per_metre**2 * way
    paper = np.where(step.any(axis=1), np.radians(0.5), 1e-3) ** 2
    np.testing.assert_allclose(variance[:, 2], heading if noise == "wheels" else paper, rtol=1e-5)


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


VALUES = ("margin", "smallest")


def areas(benchmark: ModuleType, sensor: str, robots: int, steps: int, trials: int) -> tuple[float, float]:
    """Under the ROC curves of margin and λ_min(S_bc): a smaller version of ``benchmarks/observability.py``."""
    random, degenerate = benchmark.pairs(benchmark.Setting(sensor, robots, steps), trials)
    margin, smallest = ([np.array([getattr(e, of) for e in found]) for found in (random, degenerate)] for of in VALUES)
    return benchmark.area_under_roc(*margin), benchmark.area_under_roc(*smallest)


@pytest.mark.parametrize(("sensor", "robots"), [("rssi", 2), ("range", 5)])
def test_random_motion_is_told_from_degenerate(benchmark: ModuleType, sensor: str, robots: int) -> None:
    margin, _ = areas(benchmark, sensor, robots, 20, 24)
    assert margin >= 0.93


def test_what_ranges_excite_has_a_sign(benchmark: ModuleType) -> None:
    random, degenerate = benchmark.pairs(benchmark.Setting("range", 5, 20), 24)
    assert sum(e.excited for e in random) >= 22
    assert sum(e.excited for e in degenerate) <= 4


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["rssi", "range"])
@pytest.mark.parametrize("robots", [2, 5])
@pytest.mark.parametrize("steps", [20, 60])
def test_random_motion_is_told_from_degenerate_everywhere(
    benchmark: ModuleType, sensor: str, robots: int, steps: int
) -> None:
    """λ_min(S_bc) of two robots' RSSI falls short of it, or nearly: benchmarks/README.md says why."""
    margin, smallest = areas(benchmark, sensor, robots, steps, 200)
    assert margin >= 0.93
    assert smallest >= 0.93 or (sensor, robots) == ("rssi", 2)
