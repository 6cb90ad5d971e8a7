"""Candidate graphs come best first, in the order of brute force. METHOD §4."""

from __future__ import annotations

from itertools import combinations, islice
from itertools import pairwise as successive

import numpy as np
import pytest

from dgorl.expansion.search import EXPANSIONS, WIDTH, best_graphs, brute_force


def draw(rng: np.random.Generator, shape: tuple[int, ...], trial: int) -> np.ndarray:
    """Scores of many magnitudes, with ties (small integers) in every other trial, impossible ones in every third."""
    integers = rng.integers(-3, 3, shape).astype(float)
    table = integers if trial % 2 else rng.normal(size=shape) * 10.0 ** rng.integers(-2, 4)
    if trial % 3 == 0:
        table[rng.random(shape) < 0.15] = -np.inf
    return table


def tables(seed: int):
    rng = np.random.default_rng(seed)
    n = rng.integers(1, 7)
    sizes = rng.integers(1, 5, n)
    unary = [draw(rng, (k,), seed) for k in sizes]
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.8]
    return unary, {(i, j): draw(rng, (sizes[i], sizes[j]), seed) for i, j in pairs}


def geometry(rng: np.random.Generator, n: int = 12, k: int = 5, sigma: float = 0.5, density: float = 1.0):
    """Candidates on rings about the reference, one near the truth and its mirror image; θ from ranges, METHOD §4."""
    truth = rng.uniform(-30, 30, (n, 2))
    candidates = []
    for p in truth:
        distance = np.hypot(*p) + sigma * rng.normal()
        bearing = rng.uniform(-np.pi, np.pi, k)
        bearing[0] = np.arctan2(p[1], p[0]) + rng.normal() / distance
        bearing[1] = -bearing[0]
        ring = distance * np.column_stack([np.cos(bearing), np.sin(bearing)])
        candidates.append(rng.permutation(ring + 0.5 * rng.normal(size=(k, 2))))
    pairs = {}
    variance = sigma**2 + 2 * 0.5**2
    for i in range(n):
        for j in range(i + 1, n):
            if rng.random() < density:
                measured = np.hypot(*(truth[i] - truth[j])) + sigma * rng.normal()
                apart = np.linalg.norm(candidates[i][:, None] - candidates[j][None], axis=2)
                pairs[i, j] = -0.5 * (apart - measured) ** 2 / variance - 0.5 * np.log(2 * np.pi * variance)
    return [rng.normal(size=k) for _ in range(n)], pairs


def test_the_order_is_that_of_brute_force():
    for seed in range(1000):
        unary, pairwise = tables(seed)
        assert list(best_graphs(unary, pairwise)) == brute_force(unary, pairwise), seed


def test_scores_are_the_sums_of_the_tables():
    for seed in range(0, 200, 7):
        unary, pairwise = tables(seed)
        for score, chosen in islice(best_graphs(unary, pairwise), 20):
            parts = [u[a] for u, a in zip(unary, chosen, strict=True)]
            parts += [theta[chosen[i], chosen[j]] for (i, j), theta in pairwise.items()]
            assert score == pytest.approx(sum(parts), rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("density", [1.0, 0.4])
def test_few_partial_graphs_are_expanded(density):
    expanded = []
    for seed in range(25):
        graphs = best_graphs(*geometry(np.random.default_rng(seed), density=density))
        found = list(islice(graphs, 10))
        assert all(a[0] >= b[0] for a, b in successive(found))
        assert len({chosen for _, chosen in found}) == 10
        expanded.append(graphs.expanded)
    assert np.median(expanded) <= 1000


def reference_beam(unary, pairwise, width):
    """What a beam alone finds, by the definition: of each length the graphs of the highest bounds go on."""

    def bound(chosen):
        """The score so far, and for each member left the best it could do with the chosen ones and after it."""
        total = sum(unary[i][a] for i, a in enumerate(chosen))
        total += sum(t[chosen[i], chosen[j]] for (i, j), t in pairwise.items() if j < len(chosen))
        for j in range(len(chosen), len(unary)):
            able = unary[j].copy()
            for (a, b), t in pairwise.items():
                if b == j and a < len(chosen):
                    able = able + t[chosen[a]]
                elif a == j:
                    able = able + t.max(axis=1)
            total += able.max()
        return -total, chosen

    graphs = [()]
    for u in unary:
        best = sorted(b for b in map(bound, graphs) if b[0] < np.inf)[:width]
        graphs = [(*chosen, a) for _, chosen in best for a in range(len(u))]
    return sorted(b for b in map(bound, graphs) if b[0] < np.inf)


def integer_tables(seed: int):
    """Tables whose sums are exact in any order, many of them tied, some of them impossible."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 5, rng.integers(1, 7))
    unary = [rng.integers(-9, 9, k).astype(float) for k in sizes]
    pairs = {}
    for i, j in [pair for pair in combinations(range(len(sizes)), 2) if rng.random() < 0.8]:
        pairs[i, j] = rng.integers(-9, 9, (sizes[i], sizes[j])).astype(float)
        pairs[i, j][rng.random(pairs[i, j].shape) < 0.1] = -np.inf
    return unary, pairs


@pytest.mark.parametrize(("limit", "width"), [(0, 1), (1, 2), (7, 3), (40, 1), (40, 20)])
def test_beyond_its_bound_the_search_yields_what_it_promises(limit, width):
    reached = 0
    for seed in range(300):
        unary, pairwise = tables(seed)
        every = brute_force(unary, pairwise)
        graphs = best_graphs(unary, pairwise, limit, width)
        exact = []
        for graph in graphs:
            if graphs.expanded > limit:  # the beam has been at work
                reached += 1
                rest = [graph, *graphs]
                break
            exact.append(graph)
        else:
            rest = []
        assert exact == every[: len(exact)], seed
        scores = {chosen: score for score, chosen in every}
        assert all(scores[chosen] == score for score, chosen in rest), seed
        assert rest == sorted(rest, key=lambda graph: (-graph[0], graph[1])), seed
        assert len({chosen for _, chosen in exact + rest}) == len(exact) + len(rest), seed
        assert graphs.expanded <= limit + width * len(unary), seed
    assert reached > 30


@pytest.mark.parametrize("width", [1, 3, 25])
def test_after_its_bound_the_search_is_a_beam(width):
    for seed in range(100):
        unary, pairwise = integer_tables(seed)
        found = [(-score, chosen) for score, chosen in best_graphs(unary, pairwise, 0, width)]
        assert found == reference_beam(unary, pairwise, width), seed


def test_a_beam_that_drops_nothing_is_exact():
    for seed in range(100):
        unary, pairwise = tables(seed)
        assert list(best_graphs(unary, pairwise, seed % 9, 10**6)) == brute_force(unary, pairwise), seed


def test_a_large_team_whose_scores_nearly_tie_costs_no_more_than_the_bound():
    """Long ranges without line of sight spoil the bound of A*: it expanded half a million for 20 robots."""
    rng = np.random.default_rng(4)
    for n in (30, 45):
        unary, pairwise = geometry(rng, n=n, density=0.3)
        pairwise = {pair: np.maximum(t, -2.0) for pair, t in pairwise.items()}
        graphs = best_graphs(unary, pairwise)
        found = list(islice(graphs, 20))
        assert EXPANSIONS < graphs.expanded <= EXPANSIONS + WIDTH * n
        assert len({chosen for _, chosen in found}) == 20
        assert all(a[0] >= b[0] for a, b in successive(found))
        assert all(len(chosen) == n for _, chosen in found)


def test_equal_scores_come_in_order_of_the_candidates_and_lazily():
    graphs = best_graphs([np.zeros(5)] * 12, {})
    assert [chosen[-2:] for _, chosen in islice(graphs, 6)] == [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 0)]
    assert graphs.expanded < 20


def test_a_team_of_one_and_an_impossible_team():
    assert list(best_graphs([], {})) == [(0.0, ())]
    assert list(best_graphs([np.array([-np.inf, -np.inf])], {})) == []
    assert list(best_graphs([np.zeros(2)] * 2, {(0, 1): np.full((2, 2), -np.inf)})) == []


def test_inputs_stay_as_they_are():
    unary, pairwise = tables(3)
    before = [u.copy() for u in unary], {key: theta.copy() for key, theta in pairwise.items()}
    list(best_graphs(unary, pairwise))
    assert all(np.array_equal(a, b) for a, b in zip(unary, before[0], strict=True))
    assert all(np.array_equal(pairwise[key], before[1][key]) for key in pairwise)


@pytest.mark.parametrize(
    ("unary", "pairwise", "message"),
    [
        ([np.zeros(0)], {}, r"unary\[0\]"),
        ([np.array([0.0, np.nan])], {}, r"unary\[0\]"),
        ([np.zeros(2)] * 2, {(1, 0): np.zeros((2, 2))}, r"pairwise\[1, 0\]: needs members"),
        ([np.zeros(2), np.zeros(3)], {(0, 1): np.zeros((3, 2))}, r"pairwise\[0, 1\]: .* shape \(2, 3\)"),
        ([np.zeros(2)] * 2, {(0, 1): np.full((2, 2), np.inf)}, r"pairwise\[0, 1\]"),
    ],
)
def test_tables_that_are_none_are_refused(unary, pairwise, message):
    with pytest.raises(ValueError, match=message):
        best_graphs(unary, pairwise)
