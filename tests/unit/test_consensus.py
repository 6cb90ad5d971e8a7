"""Consensus, its assumptions, and the paper's primal–dual method on a window graph. METHOD §6."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl.team.consensus import Averager, PushSum, deviation_bound
from dgorl.team.mixing import AssumptionsMonitor, metropolis_weights, strongly_connected

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
Array = np.ndarray
Robots = list[Averager] | list[PushSum]


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_convergence", BENCHMARKS / "convergence.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@st.composite
def hearing(draw: st.DrawFn) -> Array:
    """Who hears whom, in one direction or both, lonely robots among them."""
    n = draw(st.integers(1, 9))
    return np.array(draw(st.lists(st.lists(st.booleans(), min_size=n, max_size=n), min_size=n, max_size=n)))


def ring(n: int) -> Array:
    return np.roll(np.eye(n, dtype=bool), 1, axis=1) | np.roll(np.eye(n, dtype=bool), -1, axis=1)


def failing(links: Array, loss: float, rng: np.random.Generator, one_way: bool) -> Array:
    """The links that work in a round."""
    up = rng.random(links.shape) >= loss
    return links & (up if one_way else np.triu(up) | np.triu(up).T)


def exchange(robots: Robots, hears: Array, round: int) -> None:
    """A round: everybody sends, those who hear take, everybody steps."""
    sent = [robot.send(round) for robot in robots]
    for i, robot in enumerate(robots):
        for j in np.flatnonzero(hears[i]):
            robot.receive(sent[j], round)  # type: ignore[arg-type]
    for robot in robots:
        if isinstance(robot, Averager):
            robot.step()


def averagers(values: Array) -> list[Averager]:
    return [Averager(f"r{k}", value) for k, value in enumerate(values)]


def row_by_row(robots: list[Averager]) -> Array:
    """A(t) of the last step."""
    return np.array([[robot.weights.get(peer.robot, 0.0) for peer in robots] for robot in robots])


@settings(max_examples=50, deadline=None)
@given(hearing())
def test_weights_are_doubly_stochastic_whoever_hears_whom(hears: Array) -> None:
    weights, n = metropolis_weights(hears), len(hears)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-12)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    links = hears & hears.T & ~np.eye(n, dtype=bool)
    assert (weights[links] >= 1 / n - 1e-12).all()
    assert (np.diag(weights) >= 1 / n - 1e-12).all()
    assert not weights[~links & ~np.eye(n, dtype=bool)].any()


@settings(max_examples=30, deadline=None)
@given(hearing())
def test_robots_find_these_weights_by_themselves(hears: Array) -> None:
    links = hears & hears.T
    np.fill_diagonal(links, False)
    values = np.random.default_rng(0).normal(size=(len(links), 2))
    robots = averagers(values)
    for round in range(2):  # the first one tells who hears whom
        exchange(robots, links, round)
    weights = metropolis_weights(links)
    np.testing.assert_allclose(row_by_row(robots), weights, atol=1e-15)
    np.testing.assert_allclose([robot.value for robot in robots], weights @ values, atol=1e-14)


@settings(max_examples=10, deadline=None)
@given(st.integers(2, 6), st.floats(0.0, 0.5), st.integers(0, 2**32 - 1))
def test_the_average_is_found_while_links_drop_in_both_directions(n: int, loss: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(n, 3)) * 100
    robots, monitor = averagers(values), AssumptionsMonitor(n, block=60)
    for round in range(480):
        exchange(robots, failing(ring(n), loss, rng, one_way=False), round)
        monitor.observe(row_by_row(robots))
    np.testing.assert_allclose([robot.value for robot in robots], np.tile(values.mean(axis=0), (n, 1)), atol=1e-6)
    assert monitor.report().broken == ()
    assert monitor.report().blocks == 8


def test_the_union_over_t_rounds_is_what_has_to_be_connected() -> None:
    """One link a round: no round is connected, every four rounds are."""
    values = np.arange(5.0)
    robots, four, two = averagers(values), AssumptionsMonitor(5, block=8), AssumptionsMonitor(5, block=2)
    for round in range(1600):
        links = np.zeros((5, 5), dtype=bool)
        a = (round // 2) % 4  # twice each: the first time tells who hears whom
        links[a, a + 1] = links[a + 1, a] = True
        exchange(robots, links, round)
        for monitor in (four, two):
            monitor.observe(row_by_row(robots))
    np.testing.assert_allclose([robot.value for robot in robots], 2.0, atol=1e-9)
    assert four.report().broken == ()
    assert [reason[0] for reason in two.report().broken] == ["3"]
    assert two.report().connected == 0


def test_strongly_connected_asks_for_a_way_back() -> None:
    path = np.eye(3, k=1, dtype=bool)
    assert not strongly_connected(path)
    path[2, 0] = True
    assert strongly_connected(path)


@pytest.mark.parametrize("seed", range(5))
def test_one_way_loss_breaks_averages_and_push_sum_mends_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(5, 2))
    plain, monitor = averagers(values), AssumptionsMonitor(5, block=60)
    pushing = [PushSum(f"r{k}", value) for k, value in enumerate(values)]
    for round in range(600):
        hears = failing(ring(5), 0.3, rng, one_way=True)
        exchange(plain, hears, round)
        exchange(pushing, hears, round)
        monitor.observe(row_by_row(plain))
    mean = values.mean(axis=0)
    ends = np.array([robot.value for robot in plain])
    np.testing.assert_allclose(ends, np.tile(ends[0], (5, 1)), atol=1e-9)  # they agree ...
    assert np.abs(ends[0] - mean).max() > 1e-2  # ... on something else
    assert [reason[0] for reason in monitor.report().broken] == ["1"]
    np.testing.assert_allclose([robot.ratio for robot in pushing], np.tile(mean, (5, 1)), atol=1e-9)


def test_push_sum_loses_no_weight_but_that_under_way() -> None:
    rng = np.random.default_rng(3)
    robots = [PushSum(f"r{k}", [float(k)]) for k in range(4)]
    for round in range(50):
        exchange(robots, failing(ring(4), 0.4, rng, one_way=True), round)
        under_way = 4 - sum(robot.weight for robot in robots)
        assert -1e-12 <= under_way <= sum(robot.unconfirmed for robot in robots) + 1e-12
    for round in range(50, 53):  # nothing is lost: what was under way arrives, and peers say so one round later
        exchange(robots, ring(4), round)
    assert sum(robot.weight for robot in robots) == pytest.approx(4)


def test_a_robot_that_goes_for_good_leaves_a_deviation_that_is_reported() -> None:
    """Three go on; what they gave the fourth and what it held is missing, and it may differ from the average."""
    values = np.array([0.0, 1.0, 2.0, 30.0])
    robots = [PushSum(f"r{k}", [value]) for k, value in enumerate(values)]
    rng = np.random.default_rng(0)
    everybody = ~np.eye(4, dtype=bool)
    for round in range(4):
        exchange(robots, failing(everybody, 0.3, rng, one_way=True), round)
    rest = robots[:3]
    for round in range(4, 400):
        exchange(rest, ~np.eye(3, dtype=bool), round)
    ends = np.array([robot.ratio[0] for robot in rest])
    np.testing.assert_allclose(ends, ends[0], atol=1e-9)
    missing = 4 - sum(robot.weight for robot in rest)
    assert missing > 0.1
    bound = deviation_bound(missing, 4, float(np.ptp(values)))
    assert 1e-3 < abs(ends[0] - values.mean()) <= bound < np.ptp(values)
    stayed = sum(robot.weight for robot in rest)
    for round in range(400, 450):  # nobody gives it anything any more
        exchange(rest, ~np.eye(3, dtype=bool), round)
    assert sum(robot.weight for robot in rest) == pytest.approx(stayed)


def test_late_doubled_and_disordered_messages_do_no_harm() -> None:
    a, b = PushSum("a", [1.0]), PushSum("b", [3.0])
    sums = []
    for round in range(40):
        for sender, taker in ((a, b), (b, a)):
            message = sender.send(round)
            sums.append((taker, message))
            for _ in range(2):
                taker.receive(message, round)
        taker, old = sums[round // 2]
        taker.receive(old, round)
    assert a.ratio == pytest.approx(2.0)
    assert a.weight + b.weight == pytest.approx(2.0)
    late, other = Averager("a", [1.0]), Averager("b", [3.0])
    share = other.send(0)
    late.send(1)
    late.receive(share, 1)
    late.step()
    assert late.value == pytest.approx(1.0)
    assert late.send(2).heard == frozenset()


def test_costs_of_robots_add_up_to_the_graphs_and_know_only_their_own(benchmark: ModuleType) -> None:
    problem = benchmark.agreement(3, 0)
    zero = np.zeros_like(problem.start)
    assert sum(cost.value(zero) for cost in problem.costs) == pytest.approx(problem.optimum)
    owner = np.repeat(np.arange(3), 3 * benchmark.KEYFRAMES)
    for robot, cost in enumerate(problem.costs):
        others = owner != robot
        # Of two others it knows nothing: no reading between them, no odometry of theirs joins two of their poses.
        between = cost.hessian[np.ix_(owner == (robot + 1) % 3, owner == (robot + 2) % 3)]
        assert not between.any()
        assert np.linalg.eigvalsh(cost.hessian).min() > -1e-9
        own = np.linalg.eigvalsh(cost.hessian[np.ix_(~others, ~others)])
        np.testing.assert_allclose(own, 3.0)  # preconditioned


def test_the_cores_constrained_optimum_is_that_of_the_costs(benchmark: ModuleType) -> None:
    """At z = 0 the forces of the costs are balanced by bounds that are reached, and by no others."""
    problem = benchmark.agreement(3, 0)
    zero = np.zeros_like(problem.start)
    excess, slopes = problem.costs[0].bounds(zero), problem.costs[0].slopes(zero)
    reached = excess > -1e-6
    assert 0 < reached.sum() < len(reached)
    force = sum(cost.gradient(zero) for cost in problem.costs)
    multipliers, *_ = np.linalg.lstsq(slopes[reached].T, -force, rcond=None)
    assert (multipliers > 1e-3).all()
    np.testing.assert_allclose(slopes[reached].T @ multipliers, -force, atol=1e-6)
    assert excess.max() < 1e-6


def test_slopes_and_gradients_match_differences_and_projection_keeps_bounds(benchmark: ModuleType) -> None:
    problem = benchmark.agreement(3, 1)
    cost, rng, step = problem.costs[1], np.random.default_rng(0), 1e-6
    z = problem.start + rng.normal(size=len(problem.start))
    for k in rng.choice(len(z), 12, replace=False):
        along = step * np.eye(len(z))[k]
        assert cost.gradient(z)[k] == pytest.approx((cost.value(z + along) - cost.value(z - along)) / 2e-6, abs=1e-4)
        np.testing.assert_allclose(
            cost.slopes(z)[:, k], (cost.bounds(z + along) - cost.bounds(z - along)) / 2e-6, atol=1e-6
        )
    far = 20 * z
    assert cost.bounds(far).max() > 1
    kept = cost.projected(far)
    assert cost.bounds(kept).max() < 1e-9
    np.testing.assert_allclose(cost.projected(kept), kept, atol=1e-9)


def test_primal_dual_reaches_the_cores_constrained_optimum_as_fast_as_stated(benchmark: ModuleType) -> None:
    """Gap and violation shrink like K^−¼ or faster, 30 % of the links down in every round."""
    problem, rounds = benchmark.agreement(3, 0), (100, 400, 1600)
    found = []
    for planned in rounds:
        team, _ = benchmark.primal_dual(problem, planned, np.random.default_rng(planned))
        found.append(benchmark.errors(problem, team))
        for cost, robot in zip(problem.costs, team, strict=True):
            assert cost.bounds(robot.output).max() < 1e-9
            assert (robot.multipliers >= 0).all()
    gaps, violations = zip(*found, strict=True)
    assert benchmark.slope(rounds, gaps) <= -0.25
    assert benchmark.slope(rounds, violations) <= -0.25
    assert gaps[-1] < 0.25
    assert violations[-1] < 0.15
    # What a bound costs is felt: without multipliers the mean would stay where the plain optimum is.
    assert violations[-1] < 0.5 * problem.costs[0].bounds(plain_optimum(problem)).max()


def plain_optimum(problem: object) -> Array:
    costs = problem.costs  # type: ignore[attr-defined]
    return np.linalg.solve(sum(c.hessian for c in costs), -sum(c.gradient_at_0 for c in costs))


def test_gossip_needs_fewer_rounds_than_consensus(benchmark: ModuleType) -> None:
    """METHOD's table: the measurements of a ring of five are everywhere after a few rounds, and then all is exact."""
    rng = np.random.default_rng(0)
    told = np.median([benchmark.gossip(5, rng) for _ in range(200)])
    assert 2 <= told <= 5
    taken = benchmark.rounds_to(benchmark.agreement(5, 0, bound=False), 1e-4, 400, rng)
    assert taken is None or taken > 10 * told
