"""Observability: the paper's spectral test, T0 and T1 against brute force, METHOD §3's degenerate pairs."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dgorl import se2
from dgorl.observability import (
    Bars,
    edge_information,
    edge_ranks,
    geometry,
    rank_of,
    spectral_matrix,
    spectrally_observable,
)
from dgorl.observability_structure import Structure, spanning_trees, structure

Array = np.ndarray


def between_all(paths: Array) -> Bars:
    """A bar between every two of n paths (n, T, 2) at every time."""
    n, steps, _ = paths.shape
    i, j = (np.repeat(side, steps) for side in np.triu_indices(n, 1))
    t = np.tile(np.arange(steps), len(i) // steps)
    ones = np.ones(len(i))
    return Bars(i, j, paths[i, t], paths[j, t], ones, paths[:, -1], 0.0 * ones)


# ---- METHOD §3, degenerate pairs: paths of both robots, and the rank of their W_e ----

TIME = np.linspace(0.0, 10.0, 21)[:, None]
Rng = np.random.Generator


def unit(rng: Rng) -> Array:
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def somewhere(rng: Rng) -> Array:
    return rng.uniform(-10, 10, 2)


def wild(rng: Rng) -> Array:
    heading = np.cumsum(rng.uniform(-0.5, 0.5, len(TIME))) + rng.uniform(-np.pi, np.pi)
    return somewhere(rng) + np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0) / 2


def line(rng: Rng) -> Array:
    return somewhere(rng) + rng.uniform(0.3, 1.0) * TIME * unit(rng)


def circle(rng: Rng) -> Array:
    angle = rng.uniform(0.3, 0.8) * TIME + rng.uniform(-np.pi, np.pi)
    return somewhere(rng) + rng.uniform(1, 3) * np.hstack([np.cos(angle), np.sin(angle)])


def still(rng: Rng) -> Array:
    return somewhere(rng) + 0 * TIME


def parallel(rng: Rng) -> tuple[Array, Array]:
    way = 0.5 * TIME * unit(rng)
    return somewhere(rng) + way, somewhere(rng) + way


def translated(rng: Rng) -> tuple[Array, Array]:
    path = wild(rng)
    return path, path + somewhere(rng)


def constant_bearing(rng: Rng) -> tuple[Array, Array]:
    path = wild(rng)
    return path, path + (3 + np.abs(np.cumsum(rng.normal(size=TIME.shape), axis=0))) * unit(rng)


def in_file(rng: Rng) -> tuple[Array, Array]:
    along = unit(rng)
    path = somewhere(rng) + 0.5 * TIME * along
    return path, path + rng.uniform(2, 9) * along


def each(a: Callable[[Rng], Array], b: Callable[[Rng], Array]) -> Callable[[Rng], tuple[Array, Array]]:
    return lambda rng: (a(rng), b(rng))


PAIRS = {
    "one static or spinning": (each(wild, still), 2),
    "parallel at equal velocity": (parallel, 2),
    "identical translated curves": (translated, 2),
    "constant bearing": (constant_bearing, 2),
    "both static": (each(still, still), 1),
    "equal velocity along the line of sight": (in_file, 1),
    "random": (each(wild, wild), 3),
    "crossing straight lines": (each(line, line), 3),
    "circle and circle": (each(circle, circle), 3),
    "straight and circle": (each(line, circle), 3),
}


@pytest.mark.parametrize("name", PAIRS)
def test_rank_of_a_pair(name: str) -> None:
    make, rank = PAIRS[name]
    for seed in range(100):
        b = between_all(np.array(make(np.random.default_rng(seed))))
        assert rank_of(edge_information(b, (0, 1))) == rank, seed
        assert edge_ranks(b) == {(0, 1): rank}, seed
        found = geometry(b)
        assert (found.rank, found.full) == (rank, 3), seed
        assert found.observable == (rank == 3)


def bent(paths: Array, b: Bars, motion: Array, scale: float) -> Bars:
    """The bars after every body's twist about its origin, heading in metres."""
    moved = []
    for robot, path in enumerate(paths):
        x, y, turn = motion[robot]
        R, origin = se2.rotation(turn / scale), b.origin[robot]
        moved.append((path - origin) @ R.T + origin + [x, y])
    return between_all(np.array(moved))


@pytest.mark.parametrize("name", [name for name, (_, rank) in PAIRS.items() if rank < 3])
def test_null_motions_keep_all_ranges(name: str) -> None:
    paths = np.array(PAIRS[name][0](np.random.default_rng(7)))
    b = between_all(paths)
    found = geometry(b)
    assert not found.null[:, 0].any()
    for motion in found.null:
        assert np.linalg.norm(motion) == pytest.approx(1.0)
        step = 1e-4
        ahead, back = (bent(paths, b, s * motion, found.scale).distance for s in (step, -step))
        np.testing.assert_allclose((ahead - back) / (2 * step), 0.0, atol=1e-6)


def test_rows_are_derivatives_of_ranges() -> None:
    rng = np.random.default_rng(3)
    paths = np.array([wild(rng), wild(rng), wild(rng)])
    b = between_all(paths)
    row_i, row_j = b.rows()
    motion, step = rng.normal(size=(3, 3)), 1e-5
    ahead, back = (bent(paths, b, s * motion, b.scale).distance for s in (step, -step))
    told = (row_i * motion[b.i]).sum(1) + (row_j * motion[b.j]).sum(1)
    np.testing.assert_allclose(told, (ahead - back) / (2 * step), atol=1e-8)


def test_rank_tolerance_is_the_square_of_noise_over_distance() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = parallel(rng)
        sigma, distance = 0.05, np.linalg.norm(a - b, axis=1).mean()
        noisy = np.array([a, b]) + sigma * rng.normal(size=(2, *a.shape))
        information = edge_information(between_all(noisy), (0, 1))
        assert rank_of(information) == 3
        assert rank_of(information, 8 * (sigma / distance) ** 2) <= 2


# ---- T0 ----


def by_partitions(nodes: int, edges: list[tuple[int, int]], count: int) -> bool:
    """Nash-Williams and Tutte: every partition into p parts is crossed by at least count (p − 1) edges."""
    return all(
        sum(home[a] != home[b] for a, b in edges) >= count * (len(set(home)) - 1)
        for home in product(range(nodes), repeat=nodes)
    )


@given(st.integers(2, 5), st.data())
def test_spanning_trees_against_all_partitions(nodes: int, data: st.DataObject) -> None:
    every = list(combinations(range(nodes), 2))
    edges = data.draw(st.lists(st.sampled_from(every), max_size=3 * (nodes - 1) + 4))
    count = data.draw(st.integers(1, 3))
    assert spanning_trees(nodes, edges, count) == by_partitions(nodes, edges, count)


def test_spanning_trees_that_only_exchanges_find() -> None:
    found = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        count, nodes = 3, 6
        trees = []
        for _ in range(count):  # a random graph that does hold three disjoint trees, shuffled
            order = rng.permutation(nodes)
            trees += [(int(order[k]), int(order[rng.integers(k)])) for k in range(1, nodes)]
        edges = [trees[k] for k in rng.permutation(len(trees))]
        assert spanning_trees(nodes, edges, count)
        assert not spanning_trees(nodes, edges[1:], count)
        greedy = [set() for _ in range(count)]  # type: ignore[var-annotated]
        for k, edge in enumerate(edges):
            for forest in greedy:
                if len({*forest, k}) == rank_of_edges(nodes, [*(edges[q] for q in forest), edge]):
                    forest.add(k)
                    break
        found += sum(map(len, greedy)) < count * (nodes - 1)
    assert found > 10  # the exchanges were needed


def rank_of_edges(nodes: int, edges: list[tuple[int, int]]) -> int:
    incidence = np.zeros((len(edges), nodes))
    for k, (a, b) in enumerate(edges):
        incidence[k, a], incidence[k, b] = -1, 1
    return int(np.linalg.matrix_rank(incidence))


def test_structure_of_small_teams() -> None:
    assert structure(1, {}) == Structure(True, True)
    assert structure(3, {(0, 1): 3, (1, 2): 3}) == Structure(True, True)
    assert structure(3, {(0, 1): 3, (1, 2): 2}) == Structure(False, False)
    assert structure(3, {(0, 1): 2, (1, 2): 2, (0, 2): 2}) == Structure(False, True)  # six bars, two for each tree
    assert structure(3, {(0, 1): 2, (1, 2): 2, (0, 2): 1}) == Structure(False, False)
    assert structure(4, {(0, 1): 3, (1, 2): 3, (0, 2): 3}) == Structure(False, False)  # the fourth is not linked


def test_structure_is_fast_for_twelve() -> None:
    everyone = dict.fromkeys(combinations(range(12), 2), 1)
    assert structure(12, everyone) == Structure(False, True)


@pytest.mark.parametrize(("moving", "observable"), [("parallel", False), ("translated", False), ("wild", True)])
def test_formations_of_three(moving: str, observable: bool) -> None:
    """Rank 2 on every edge passes T0, as generic; T1 then finds that all three drift together."""
    for seed in range(100):
        rng = np.random.default_rng(seed)
        way = {"parallel": 0.5 * TIME * unit(rng), "translated": wild(rng)}.get(moving)
        paths = np.array([wild(rng) if way is None else somewhere(rng) + way for _ in range(3)])
        b = between_all(paths)
        ranks = edge_ranks(b)
        assert set(ranks.values()) == {3 if observable else 2}
        assert structure(3, ranks) == Structure(observable, True)
        assert geometry(b).observable == observable
    two = {edge: ranks[edge] for edge in ((0, 1), (1, 2))}
    assert structure(3, two) == Structure(observable, observable)  # a chain of two edges of rank 2: failing is final


def test_failing_structure_is_final() -> None:
    """Whatever the geometry: a team that fails T0 fails T1."""
    failed = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        paths = np.array([(wild, still, line)[rng.integers(3)](rng) for _ in range(4)])
        whole = between_all(paths)
        pick = {pair for pair in combinations(range(4), 2) if rng.uniform() < 0.6}
        on = np.array([pair in pick for pair in zip(whole.i.tolist(), whole.j.tolist(), strict=True)])
        b = Bars(whole.i[on], whole.j[on], whole.a[on], whole.b[on], whole.weight[on], whole.origin, whole.height[on])
        said, known = structure(4, edge_ranks(b)), geometry(b).observable
        failed += not said.generic
        assert said.generic or not known
        assert known or not said.rigid
    assert 10 < failed < 50


# ---- the paper's spectral test ----


def windowed_rank(edges: Array, positions: Array, velocities: Array, spins: Array) -> int:
    """Rank of relative positions in the observer's body over a window, odometry known: by finite differences."""
    n, p = positions.shape
    i, j = edges.T

    def turned(yaw: Array, vectors: Array) -> Array:
        flat = np.einsum("kij,kj->ki", se2.rotation(yaw), vectors[:, :2])
        return np.hstack([flat, vectors[:, 2:]])

    def seen(state: Array) -> Array:
        x, yaw = state[: n * p].reshape(n, p), state[n * p :]
        rows = []
        for t in (0.0, 0.4, 1.1):
            way = t * velocities  # a constant twist leaves the body's start along half its turn
            way[:, :2] *= np.sinc(spins * t / 2 / np.pi)[:, None]
            at = x + turned(yaw + spins * t / 2, way)
            rows.append(turned(-(yaw + spins * t)[i], at[j] - at[i]))
        return np.concatenate(rows).ravel()

    state = np.concatenate([positions.ravel(), np.zeros(n)])
    step = 1e-5
    jacobian = [(seen(state + step * e) - seen(state - step * e)) / (2 * step) for e in np.eye(len(state))]
    return int(np.linalg.matrix_rank(np.transpose(jacobian), tol=1e-6))


def connected(n: int, rng: Rng) -> Array:
    """A random directed spanning tree with a few more edges."""
    tree = [(int(rng.integers(k)), k) for k in range(1, n)]
    more = [tuple(map(int, rng.choice(n, 2, replace=False))) for _ in range(rng.integers(3))]
    return np.array([edge if rng.uniform() < 0.5 else edge[::-1] for edge in [*tree, *more]])


@pytest.mark.parametrize("p", [2, 3])
def test_spectral_rank_is_that_of_a_window_of_relative_positions(p: int) -> None:
    """d (n − 1), d = 3 in the plane and 4 in space with yaw, and less when observed robots do not move."""
    verdicts = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 5))
        edges, positions, velocities = connected(n, rng), rng.normal(size=(n, p)) * 5, rng.normal(size=(n, p))
        velocities[rng.uniform(size=n) < 0.3, :2] = 0.0  # up and down tells nothing
        found = spectrally_observable(edges, positions, velocities)
        rank = windowed_rank(edges, positions, velocities, rng.normal(size=n))
        assert np.linalg.matrix_rank(spectral_matrix(edges, positions, velocities), tol=1e-8) == rank
        assert found == (rank == (p + 1) * (n - 1))
        if np.hypot(*velocities[edges[:, 1], :2].T).all():
            assert found  # every edge passes the motion constraint: sufficient
        verdicts.append(found)
    assert 5 < sum(verdicts) < 35


@pytest.mark.parametrize("p", [2, 3])
def test_a_common_motion_is_all_the_spectral_matrix_leaves(p: int) -> None:
    """p translations and the turn of all about the origin: δp = Jp, δθ = 1."""
    rng = np.random.default_rng(0)
    n = 4
    edges, positions, velocities = connected(n, rng), rng.normal(size=(n, p)), rng.normal(size=(n, p))
    matrix = spectral_matrix(edges, positions, velocities)
    turned = np.zeros((n, p))
    turned[:, 0], turned[:, 1] = -positions[:, 1], positions[:, 0]
    np.testing.assert_allclose(matrix @ [*turned.ravel(), *np.ones(n)], 0.0, atol=1e-12)
    for axis in np.eye(p):
        np.testing.assert_allclose(matrix @ [*np.tile(axis, n), *np.zeros(n)], 0.0, atol=1e-12)
    assert np.linalg.matrix_rank(matrix) == n * (p + 1) - (p + 1)


def test_moving_edges_are_sufficient_component_by_component() -> None:
    edges = np.array([[0, 1], [2, 3]])
    rng = np.random.default_rng(0)
    positions, velocities = rng.normal(size=(4, 2)), rng.normal(size=(4, 2))
    assert spectrally_observable(edges, positions, velocities, components=2)
    assert not spectrally_observable(edges, positions, velocities, components=1)


def test_the_motion_constraint_is_not_necessary() -> None:
    positions, rest = np.array([[0.0, 0.0], [3.0, 1.0]]), np.zeros((2, 2))
    assert not spectrally_observable(np.array([[0, 1]]), positions, rest)
    assert spectrally_observable(np.array([[0, 1], [1, 0]]), positions, rest)


def test_the_spectral_test_is_not_one_for_ranges() -> None:
    """It passes where T1 on ranges fails: parallel formations, and one robot that stands and looks."""
    rng = np.random.default_rng(0)
    velocity = np.tile(unit(rng), (2, 1))
    assert spectrally_observable(np.array([[0, 1]]), rng.normal(size=(2, 2)), velocity)
    assert not geometry(between_all(np.array(parallel(rng)))).observable
