"""Bounds on the estimate: the optimum is SciPy's, and bounds that are kept anyway change nothing. METHOD §5."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize

from dgorl import Configuration, se2
from dgorl.configuration import Limits, merge
from dgorl.errors import ConfigurationError
from dgorl.history import WORLD_KEY, History
from dgorl.limits import constraints
from dgorl.optimization import native
from dgorl.optimization.constraints import Constraints, box, disc, distances, together
from dgorl.optimization.lagrangian import constrained
from dgorl.optimization.problem import Problem
from dgorl.optimization.solver import solve
from dgorl.replay import known_starts
from dgorl.simulation import Scenario, simulate
from dgorl.window import Window, assemble, grow
from tests.unit.reference import retract

NOBODY = np.zeros(0, np.int64)
BOUNDS = ["diameter", "speed", "disc", "box", "all"]


@cache
def window(seed: int = 0, steps: int = 6, robots: int = 3, area: float = 20.0) -> Window:
    """A team with known starts and ranges."""
    log = simulate(Scenario(robots=robots, steps=steps, area=area, sensors=("range",), seed=seed))
    history = History(merge(Configuration(), log.configuration, "log"))
    for measurement in [*known_starts(log), *log.measurements]:
        history.add(measurement)
    history.admit(steps / 2, node_due=True)
    (component,) = grow(history, (), 0.0, steps / 2)
    return assemble(history, component, 0.0, steps / 2, None)


def tight(name: str, poses: np.ndarray) -> Limits:
    """Limits that these poses of three robots and the world, last, do not keep."""
    p = poses[:-1, :2]
    robots = p.reshape(3, -1, 2)
    apart = np.linalg.norm(robots[:, None] - robots, axis=3).max()
    middle, low, high = p.mean(axis=0), p.min(axis=0), p.max(axis=0)
    every = {
        "diameter": Limits(diameter=0.93 * apart),
        "speed": Limits(speed=0.4),
        "disc": Limits(disc=(*middle, 0.9 * np.linalg.norm(p - middle, axis=1).max())),
        "box": Limits(box=(*(low + 0.3), *(high - 0.2))),
        "all": Limits(diameter=0.93 * apart, speed=0.45, box=(*(low + 0.1), *(high - 0.1))),
    }
    return every[name]


def by_scipy(problem: Problem, bounds: Constraints, start: np.ndarray) -> np.ndarray:
    """The constrained optimum by sequential quadratic programming over (x, y, θ) of the free poses.

    Distances are bounded by their squares, c + c² / (2 limit): with c itself it stops farther from the optimum.
    """
    graph, free = native.graph(problem), ~problem.fixed

    def poses(v: np.ndarray) -> np.ndarray:
        x = problem.initial.copy()
        x[free] = v.reshape(-1, 3)
        return x

    def in_the_world(x: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """Slopes (…, N, 3) by right perturbations as slopes by x, y, θ."""
        turned = np.einsum("nij,...nj->...ni", se2.rotation(x[:, 2]), slopes[..., :2])
        return np.concatenate([turned, slopes[..., 2:]], axis=-1)[..., free, :].reshape(*slopes.shape[:-2], -1)

    def cost(v: np.ndarray) -> tuple[float, np.ndarray]:
        x = poses(v)
        slope = np.zeros_like(x)
        slope[free] = graph.hessian(x)[1].reshape(-1, 3)
        return graph.cost(x), in_the_world(x, slope)

    def slopes(v: np.ndarray) -> np.ndarray:
        x, each = poses(v), np.arange(len(bounds))
        full = np.zeros((len(bounds), len(x), 3))
        full[each, bounds.i] += bounds.gradients(x)[:, :3]
        full[each, bounds.j] += bounds.gradients(x)[:, 3:]
        return -(1 + bounds.values(x) / bounds.limit)[:, None] * in_the_world(x, full)

    def kept(v: np.ndarray) -> np.ndarray:
        excess = bounds.values(poses(v))
        return -excess - excess**2 / (2 * bounds.limit)

    inequality = {"type": "ineq", "fun": kept, "jac": slopes}
    options = {"maxiter": 1000, "ftol": 1e-13}
    found = minimize(cost, start[free].ravel(), jac=True, method="SLSQP", constraints=[inequality], options=options)
    return poses(found.x)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", BOUNDS)
def test_the_optimum_is_that_of_scipy(name, seed):
    team = window(seed)
    plain = solve(team.problem, NOBODY, 1e-9)
    bounds = constraints(tight(name, plain.poses), team)
    assert bounds.values(plain.poses).max() > 1e-3
    found = constrained(team.problem, bounds, NOBODY, 1e-9)
    expected = by_scipy(team.problem, bounds, plain.poses)
    assert found.solution.reason == "converged"
    assert found.solution.cost > plain.cost * (1 + 1e-6)
    assert found.solution.cost == pytest.approx(native.graph(team.problem).cost(expected), rel=1e-6)
    np.testing.assert_allclose(se2.between(expected, found.solution.poses), 0, atol=1e-5)


@pytest.mark.parametrize("name", BOUNDS)
def test_bounds_are_kept_and_multipliers_balance_the_forces(name):
    team = window(5)
    plain = solve(team.problem, NOBODY, 1e-9)
    bounds = constraints(tight(name, plain.poses), team)
    found = constrained(team.problem, bounds, NOBODY, 3e-3)  # the tolerance of ticks
    excess = bounds.values(found.solution.poses)
    assert found.violation == max(excess.max(), 0)
    assert found.violation <= max(1e-6, found.gamma * found.multipliers.max())
    assert (found.multipliers >= 0).all()
    assert found.multipliers.any()
    assert np.abs(excess[found.multipliers > 0]).max() < 1e-6
    poses, team_slope = found.solution.poses, np.zeros_like(plain.poses)
    team_slope[~team.problem.fixed] = native.graph(team.problem).hessian(poses)[1].reshape(-1, 3)
    force = found.multipliers[:, None] * bounds.gradients(poses)
    np.add.at(team_slope, bounds.i, force[:, :3])
    np.add.at(team_slope, bounds.j, force[:, 3:])
    np.testing.assert_allclose(team_slope[~team.problem.fixed], 0, atol=1e-5 * np.abs(force).max())


def test_bounds_that_are_kept_anyway_change_no_bit():
    team = window(1)
    select = np.array([3, 8])
    plain = solve(team.problem, select, 1e-9)
    wide = constraints(Limits(diameter=90.0, speed=3.0, disc=(10.0, 10.0, 60.0), box=(-50.0, -50.0, 80.0, 80.0)), team)
    assert len(wide)
    for bounds in (wide, constraints(Limits(), team)):
        found = constrained(team.problem, bounds, select, 1e-9)
        assert found.solution.poses.tobytes() == plain.poses.tobytes()
        assert found.solution.covariance.tobytes() == plain.covariance.tobytes()
        assert (found.solution.cost, found.solution.iterations) == (plain.cost, plain.iterations)
        assert (found.rounds, found.violation, found.multipliers.any()) == (0, 0.0, False)


def test_the_covariance_is_that_of_the_measurements():
    team = window(1)
    select = np.array([3, 8])
    bounds = constraints(Limits(speed=0.4), team)
    found = constrained(team.problem, bounds, select, 1e-9).solution
    np.testing.assert_array_equal(found.covariance, native.covariance(team.problem, found.poses, select))
    assert found.cost == native.graph(team.problem).cost(found.poses)


@pytest.mark.parametrize("solver", ["g2o", "gtsam"])
def test_the_other_solvers_keep_bounds_too(solver):
    team = window(2)
    bounds = constraints(Limits(speed=0.45), team)
    ours, theirs = (constrained(team.problem, bounds, NOBODY, 1e-9, name) for name in ("native", solver))
    assert theirs.solution.reason == "converged"
    assert theirs.solution.cost == pytest.approx(ours.solution.cost, rel=1e-6)


def test_a_bound_said_thrice_is_one_bound():
    team = window(3)
    bounds = constraints(Limits(diameter=8.0, speed=0.4), team)
    once, thrice = (constrained(team.problem, b, NOBODY, 1e-9) for b in (bounds, together([bounds] * 3)))
    assert thrice.solution.reason == once.solution.reason == "converged"
    assert thrice.solution.cost == pytest.approx(once.solution.cost, rel=1e-7)
    assert thrice.multipliers.sum() == pytest.approx(once.multipliers.sum(), rel=1e-4)


def test_far_from_what_the_readings_say():
    """Where the Lagrangian has only a saddle: the bounds move the robots by metres, against ranges good to 0.1 m."""
    team = window(1, steps=60, robots=5, area=30.0)
    bounds = constraints(Limits(diameter=25.0, speed=0.45, box=(3.0, 3.0, 25.0, 25.0)), team)
    assert bounds.values(solve(team.problem, NOBODY, 1e-9).poses).max() > 3
    found = constrained(team.problem, bounds, NOBODY, 1e-9)
    assert found.solution.reason == "converged"
    assert found.violation < 1e-6
    assert found.rounds <= 15
    assert found.solution.iterations <= 500


def test_bounds_that_contradict_one_another_are_said_to():
    team = window(0)
    both = [constraints(Limits(box=box), team) for box in ((0.0, 0.0, 1.0, 1.0), (18.0, 18.0, 20.0, 20.0))]
    bounds = together(both)
    found = constrained(team.problem, bounds, NOBODY, 1e-9)
    assert found.solution.reason == "infeasible"
    assert found.violation > 1
    assert found.violation == bounds.values(found.solution.poses).max()
    assert np.isfinite(found.solution.poses).all()


def test_values_are_excess_and_gradients_match_differences():
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(-5, 5, (4, 2)), rng.uniform(-3, 3, 4)])
    i, j = np.array([0, 2]), np.array([1, 3])
    bounds = together(
        [
            distances(i, j, 2.0),
            disc(0, np.array([1, 3]), (1.0, -2.0), 3.0),
            box(0, np.array([2]), (0.0, 1.0), (2.0, 5.0)),
        ]
    )
    apart = np.linalg.norm(poses[i, :2] - poses[j, :2], axis=1)
    np.testing.assert_allclose(bounds.values(poses)[:2], apart - 2)
    x, y = se2.between(poses[0], poses[2])[:2]
    np.testing.assert_allclose(bounds.values(poses)[4:], [abs(x - 1) - 1, abs(y - 3) - 2])
    for k in range(6):
        ends, axis = (bounds.i, bounds.j)[k // 3], k % 3
        for row, end in enumerate(ends):
            difference = []
            for step in (1e-6, -1e-6):
                moved = poses.copy()
                moved[end] = retract(poses[end], step * np.eye(3)[axis])
                difference.append(bounds.values(moved)[row])
            assert bounds.gradients(poses)[row, k] == pytest.approx((difference[0] - difference[1]) / 2e-6, abs=1e-7)


def test_factors_are_the_penalty_of_what_exceeds_a_bound():
    """Their cost is ½ ρ Σ max(0, c + m)², also where a side of a box is a circle."""
    rng = np.random.default_rng(1)
    world = np.array([3.0, -1.0, 0.4])
    poses = np.vstack([world, np.column_stack([rng.uniform(-9, 9, (20, 2)), rng.uniform(-3, 3, 20)])])
    members = np.arange(1, 21)
    bounds = together(
        [
            distances(members[1:], members[:-1], 6.0),
            disc(0, members, (1.0, 2.0), 5.0),
            box(0, members, (-4, -2), (3, 5)),
        ]
    )
    margin, nothing = rng.uniform(-1, 1, len(bounds)), np.zeros(0, np.int64)
    none = (nothing, nothing, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    factors = bounds.factors(poses, margin, 50.0)
    fixed = np.arange(21) == 0
    problem = Problem(np.r_[-1, np.zeros(20, np.int64)], fixed, poses, none, scalars=(factors,))
    over = np.maximum(bounds.values(poses) + margin, 0)
    assert 10 < (over > 0).sum() < len(bounds) - 10
    graph, slope = native.graph(problem), np.zeros_like(poses)
    assert graph.cost(poses) == pytest.approx(25 * (over**2).sum(), rel=1e-8)
    force = 50 * over[:, None] * bounds.gradients(poses)
    np.add.at(slope, bounds.i, force[:, :3])
    np.add.at(slope, bounds.j, force[:, 3:])
    np.testing.assert_allclose(graph.hessian(poses)[1].reshape(-1, 3), slope[1:], atol=1e-6)


def test_limits_bind_every_keyframe_of_a_window():
    team = window(0)
    keyframes = {key: count for key, (_, _, count) in team.layout.items()}
    assert set(keyframes.values()) == {7}
    assert len(constraints(Limits(diameter=5.0), team)) == 3 * 7
    assert len(constraints(Limits(speed=1.0), team)) == 3 * 6
    np.testing.assert_allclose(constraints(Limits(speed=1.0), team).limit, 0.5)
    assert len(constraints(Limits(disc=(0, 0, 5.0)), team)) == 3 * 7
    assert len(constraints(Limits(box=(0, 0, 5.0, 6.0)), team)) == 2 * 3 * 7
    late = {key: (o, f + 2 * n, c - 2 * n) for n, (key, (o, f, c)) in enumerate(team.layout.items())}
    pairs = constraints(Limits(diameter=5.0), replace(team, layout=late))
    assert len(pairs) == 5 + 3 + 3
    np.testing.assert_array_equal(team.problem.slots[pairs.i[:5]] + 0, team.problem.slots[pairs.j[:5]] + 2)


def test_without_a_known_start_a_workspace_means_nothing():
    team = replace(window(0), world=None)
    assert WORLD_KEY not in team.layout
    assert not len(constraints(Limits(disc=(0, 0, 1.0), box=(0, 0, 1.0, 1.0)), team))


def test_limits_are_read_and_checked():
    found = merge(Configuration(), {"limits": {"disc": [1, 2, 3], "speed": 1}}, "file").limits
    assert found == Limits(disc=(1.0, 2.0, 3.0), speed=1.0)
    for changes, message in (
        ({"disc": [1, 2]}, "`limits.disc` must be a list of 3 numbers or null"),
        ({"disc": [1, 2, "x"]}, "`limits.disc` must be"),
        ({"disc": [1, 2, -1]}, "limits.disc must have a positive radius"),
        ({"box": [1, 1, 0, 2]}, "limits.box must have x_min < x_max"),
        ({"diameter": 0}, "limits.diameter must be positive"),
        ({"speed": -1}, "limits.speed must be positive"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            merge(Configuration(), {"limits": changes}, "file")
