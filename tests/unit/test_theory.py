"""What docs/theory.md states and no other test checks: hardness, candidate graphs, how damping converges."""

from __future__ import annotations

import re
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import _core, se2
from dgorl.expansion.search import best_graphs, brute_force

ROOT = Path(__file__).parents[2]
Edges = frozenset[tuple[int, int]]


@st.composite
def graphs(draw: st.DrawFn) -> tuple[int, Edges]:
    n = draw(st.integers(1, 8))
    pairs = list(combinations(range(n), 2))
    return n, frozenset(pair for pair in pairs if draw(st.booleans()))


def largest_independent_set(n: int, edges: Edges) -> int:
    sets = (chosen for size in range(n, -1, -1) for chosen in combinations(range(n), size))
    return next(len(chosen) for chosen in sets if not edges & set(combinations(chosen, 2)))


@settings(max_examples=50, deadline=None)
@given(graphs())
def test_the_best_candidate_graph_is_as_hard_as_a_largest_independent_set(graph: tuple[int, Edges]) -> None:
    """The paper's reduction: two candidates a robot, one that counts, and no two that count on an edge."""
    n, edges = graph
    unary = [np.array([0.0, 1.0])] * n
    tables = {edge: np.array([[0.0, 0.0], [0.0, -float(n + 1)]]) for edge in edges}
    score, chosen = next(iter(best_graphs(unary, tables)))
    assert score == largest_independent_set(n, edges)
    assert not edges & set(combinations(np.flatnonzero(chosen).tolist(), 2))


@pytest.mark.parametrize(("n", "k"), [(2, 5), (3, 4), (5, 3)])
def test_there_are_k_to_the_n_minus_1_candidate_graphs(n: int, k: int) -> None:
    """One robot is the reference, so it has no candidates; the paper counts n^k."""
    graphs = brute_force([np.zeros(k)] * (n - 1), {})
    assert len({chosen for _, chosen in graphs}) == len(graphs) == k ** (n - 1)


def two_robots(seed: int, straight: bool) -> tuple[_core.Graph, np.ndarray, np.ndarray]:
    """Graph, true poses, and the truth with robot B mirrored at A's line; A's first pose is fixed, ranges are exact."""
    rng, steps = np.random.default_rng(seed), 8
    turns = np.zeros((2, steps)) if straight else rng.uniform(-0.8, 0.8, (2, steps))
    starts = np.array([[0.0, 0.0, 0.0], [2.0, 6.0, rng.uniform(-2.5, -0.5)]])
    paths = []
    for start, turned in zip(starts, turns, strict=True):
        deltas = np.column_stack([np.full(steps, 1.0), np.zeros(steps), turned])
        paths.append(_core.chain(start, deltas))
    truth = np.concatenate(paths)
    mirrored = np.where(np.arange(len(truth))[:, None] > steps, truth * [1.0, -1.0, -1.0], truth)
    fixed = np.zeros(len(truth), dtype=bool)
    fixed[0] = True
    graph = _core.Graph(np.tile(np.arange(steps + 1), 2), fixed)
    i = np.concatenate([np.arange(steps), steps + 1 + np.arange(steps)])
    information = np.tile(np.diag([100.0, 100.0, 400.0]), (len(i), 1, 1))
    graph.add_odometry(i, i + 1, se2.between(truth[i], truth[i + 1]), information)
    a, b = np.arange(steps + 1), steps + 1 + np.arange(steps + 1)
    still, sigma = np.zeros((steps + 1, 2)), np.full(steps + 1, 0.1)
    ranges = np.hypot(*(truth[a, :2] - truth[b, :2]).T)
    graph.add_ranges(a, b, still, still, np.zeros(steps + 1), ranges, sigma)
    return graph, truth, mirrored


@pytest.mark.parametrize("seed", range(5))
def test_damping_never_lets_the_cost_rise_and_ends_where_it_is_stationary(seed: int) -> None:
    graph, truth, _ = two_robots(seed, straight=False)
    far = truth + np.random.default_rng(seed).normal(0.0, [1.5, 1.5, 0.5], truth.shape)
    far[0] = truth[0]
    costs = [graph.optimize(far[None], max_iterations=k).cost[0] for k in range(60)]
    assert costs[0] == pytest.approx(graph.cost(far))
    assert all(after <= before + 1e-9 * costs[0] for before, after in pairwise(costs))
    end = graph.optimize(far[None], max_iterations=500)
    _, gradient = graph.hessian(end.poses[0])
    assert end.reason[0] in ("converged", "stalled")
    assert np.abs(gradient).max() < 1e-5


@pytest.mark.parametrize("seed", range(5))
def test_where_it_ends_depends_on_the_start(seed: int) -> None:
    """Robots that drive straight fit mirrored as well: damped steps from there find that optimum, and stay."""
    graph, truth, mirrored = two_robots(seed, straight=True)
    off = np.random.default_rng(seed).normal(0.0, [0.3, 0.3, 0.05], truth.shape)
    off[0] = 0.0
    found = graph.optimize(np.stack([truth + off, mirrored + off]))
    np.testing.assert_allclose(found.cost, 0.0, atol=1e-9)
    left, right = found.poses[:, truth[:, 1].argmax(), 1]
    assert left > 5 > -5 > right
    bent, _, mirrored = two_robots(seed, straight=False)
    assert bent.cost(mirrored) > 1.0


def test_what_the_page_names_is_there() -> None:
    page = (ROOT / "docs" / "theory.md").read_text()
    files = set(re.findall(r"`((?:tests|benchmarks)/[\w/]+\.py)`", page))
    files |= set(re.findall(r"`python (benchmarks/\w+\.py)`", page))
    missing = [name for name in files if not (ROOT / name).exists()]
    assert files
    assert not missing
    defined = "".join((ROOT / name).read_text() for name in files)
    named = set(re.findall(r"`(test_\w+)`", page))
    assert len(named) > 20
    assert {name for name in named if f"def {name}(" not in defined} == set()
