"""RPMG and ERPMG: graph theory on random graphs, contacts against a readable reference. METHOD §3."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from dgorl import Configuration, Range
from dgorl.configuration import merge
from dgorl.formation import Contact, Rpmg, contacts, erpmg, lemma_1, motion_constraint, rpmg
from dgorl.history import History
from dgorl.measurements import Bearing, Measurement, Odometry, RelativePose, Rssi, known_at
from dgorl.radio import rssi_to_range
from dgorl.simulation import Scenario, simulate
from dgorl.tracks import TrackKey


@st.composite
def graphs(draw: st.DrawFn) -> Rpmg[str]:
    names = [f"r{k}" for k in range(draw(st.integers(1, 8)))]
    pairs = list(combinations(names, 2))
    edges = draw(st.lists(st.sampled_from(pairs), unique=True)) if pairs else []
    weights = draw(st.lists(st.floats(0.1, 50), min_size=len(edges), max_size=len(edges)))
    turned = draw(st.lists(st.booleans(), min_size=len(edges), max_size=len(edges)))
    return Rpmg.of(
        draw(st.permutations(names)),
        {(e[::-1] if turn else e): w for e, w, turn in zip(edges, weights, turned, strict=True)},
    )


@given(graphs())
def test_lemma_1_holds_of_signed_incidence(graph: Rpmg[str]) -> None:
    count, _ = connected_components(graph.adjacency, directed=False)
    assert len(graph.components) == count
    assert lemma_1(graph.incidence, count)
    assert not lemma_1(graph.incidence, count - 1)


def test_lemma_1_fails_of_the_papers_unsigned_incidence() -> None:
    triangle = Rpmg.of(("a", "b", "c"), {("a", "b"): 1.0, ("b", "c"): 1.0, ("a", "c"): 1.0})
    assert lemma_1(triangle.incidence, 1)
    assert np.linalg.matrix_rank(np.abs(triangle.incidence)) == 3
    assert not lemma_1(np.abs(triangle.incidence), 1)


@given(graphs())
def test_components_are_the_partition_that_edges_make(graph: Rpmg[str]) -> None:
    home = {name: part for part in graph.components for name in part}
    assert sorted(home) == list(graph.names) == sorted(name for part in graph.components for name in part)
    assert list(graph.components) == sorted(tuple(sorted(part)) for part in graph.components)
    assert all(home[a] == home[b] for a, b in graph.edges)
    _, label = connected_components(graph.adjacency, directed=False)
    assert len({(home[name], label[k]) for k, name in enumerate(graph.names)}) == len(graph.components)


@given(graphs())
def test_laplacian_is_what_incidence_and_weights_make(graph: Rpmg[str]) -> None:
    np.testing.assert_allclose(
        graph.laplacian, graph.incidence.T @ np.diag(graph.weights) @ graph.incidence, atol=1e-12
    )
    np.testing.assert_array_equal(graph.adjacency, graph.adjacency.T)
    np.testing.assert_allclose(graph.degree, graph.laplacian.diagonal())


@pytest.mark.parametrize(
    "weights",
    [{("a", "a"): 1.0}, {("a", "c"): 1.0}, {("a", "b"): 0.0}, {("a", "b"): 1.0, ("b", "a"): 1.0}],
)
def test_what_is_no_edge_is_refused(weights: dict[tuple[str, str], float]) -> None:
    with pytest.raises(ValueError, match="edge"):
        Rpmg.of(("a", "b"), weights)


# ---- contacts ----


def filled(measurements: list[Measurement], configuration: Configuration, now: float) -> History:
    history = History(configuration)
    for m in measurements:
        history.add(m)
    history.admit(now, node_due=True)
    return history


def expected(measurements: list[Measurement], history: History, low: float, high: float) -> dict[object, Contact]:
    """The same, reading by reading, for a history without thinning."""
    found: dict[tuple[TrackKey, TrackKey], list[tuple[float, float | None]]] = {}
    for m in measurements:
        match m:
            case Rssi():
                ends, distance = (m.transmitter, m.receiver), float(rssi_to_range(m.dbm, history.configuration.radio))
            case Range():
                ends, distance = (m.robot, m.peer), m.range
            case Bearing():
                ends, distance = (m.observer, m.target), None
            case _:
                continue
        tracks = [history.trails[name].at(m.stamp) if name in history.trails else None for name in ends]
        if not low <= m.stamp <= high or any(t is None or t.end < m.stamp for t in tracks):
            continue
        a, b = sorted(track.key for track in tracks if track is not None)
        found.setdefault((a, b), []).append((m.stamp, distance))
    result: dict[object, Contact] = {}
    for pair, rows in found.items():
        ranges = [d for _, d in rows if d is not None]
        stamps = [stamp for stamp, _ in rows]
        result[pair] = Contact(len(rows), min(stamps), max(stamps), float(np.median(ranges)) if ranges else None)
    return result


@pytest.mark.parametrize("sensors", [("rssi",), ("bearing",), ("rssi", "range", "bearing")])
@pytest.mark.parametrize("window", [(-np.inf, np.inf), (5.0, 12.0), (12.3, 12.4)])
def test_contacts_of_a_simulated_team(sensors: tuple[str, ...], window: tuple[float, float]) -> None:
    log = simulate(Scenario(steps=40, comm_range=30.0, sensors=sensors))  # type: ignore[arg-type]
    measurements = sorted(log.measurements, key=known_at)
    history = filled(measurements, merge(Configuration(), log.configuration, "log"), 20.0)
    found, wanted = contacts(history, *window), expected(measurements, history, *window)
    assert found.keys() == wanted.keys()
    assert list(found) == sorted(found)
    for pair, contact in found.items():
        assert contact[:3] == wanted[pair][:3]
        assert contact.median_range == pytest.approx(wanted[pair].median_range)


def driving(robot: str, until: float, begin: float = 0.0, epoch: int = 0) -> list[Measurement]:
    return [Odometry(robot, t, t + 0.5, 0.5, 0.0, epoch) for t in np.arange(begin, until, 0.5).tolist()]


def test_readings_without_a_track_are_no_contacts() -> None:
    odometry = [*driving("a", 10.0), *driving("b", 5.0)]
    told = [Range("a", "b", 2.0, 3.0), Range("b", "a", 4.0, 9.0), Range("a", "b", 8.0, 5.0), Range("a", "c", 3.0, 1.0)]
    found = contacts(filled([*odometry, *told], Configuration(), 10.0), 0.0, 10.0)
    assert [(a.robot, b.robot, c) for (a, b), c in found.items()] == [("a", "b", Contact(2, 2.0, 4.0, 6.0))]


def test_a_new_epoch_is_another_node() -> None:
    odometry = [*driving("a", 20.0), *driving("b", 10.0), *driving("b", 20.0, 10.0, epoch=1)]
    told = [Range("a", "b", 2.0, 3.0), Range("a", "b", 15.0, 7.0)]
    found = contacts(filled([*odometry, *told], Configuration(), 20.0), 0.0, 20.0)
    assert [(b.epoch, c.median_range) for (_, b), c in found.items()] == [(0, 3.0), (1, 7.0)]


def test_relative_poses_are_contacts_but_not_with_the_world() -> None:
    sure = (0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
    odometry = [*driving("a", 10.0), *driving("b", 10.0)]
    poses = [
        RelativePose("b", "a", 4.0, 3.0, 4.0, 0.0, sure),
        RelativePose("world", "a", 0.0, 0.0, 0.0, 0.0, sure, prior=True),
    ]
    history = filled([*odometry, *poses], Configuration(), 10.0)
    found = contacts(history, 0.0, 10.0)
    assert [(a.robot, b.robot, c) for (a, b), c in found.items()] == [("a", "b", Contact(1, 4.0, 4.0, 5.0))]
    assert contacts(history, 5.0, 10.0) == {}


def test_rpmg_of_contacts_weighs_by_median_range_and_keeps_the_lonely() -> None:
    pair, seen = ("a", "b"), ("b", "c")
    graph = rpmg({pair: Contact(3, 0.0, 1.0, 7.0), seen: Contact(1, 0.0, 0.0, None)}, ("d",))
    assert graph.names == ("a", "b", "c", "d")
    assert graph.edges == (pair, seen)
    assert graph.weights.tolist() == [7.0, 1.0]
    assert graph.components == (("a", "b", "c"), ("d",))


# ---- the motion constraint ----


@given(st.floats(-np.pi, np.pi), st.floats(0.2, 2.0), st.floats(-5, 5))
def test_the_observed_robot_has_to_move_horizontally(heading: float, speed: float, climb: float) -> None:
    velocity = np.array([speed * np.cos(heading), speed * np.sin(heading), climb])
    assert motion_constraint(velocity, speed / 3.1)
    assert not motion_constraint(velocity, speed / 2.9)
    assert not motion_constraint([0.0, 0.0, climb], 1e-9)


def test_erpmg_keeps_all_nodes_and_the_edges_that_tell() -> None:
    weights = {("a", "b"): 1.0, ("b", "c"): 2.0, ("a", "c"): 3.0}
    kept = erpmg(Rpmg.of(("a", "b", "c"), weights), {("a", "b"): 3, ("b", "c"): 0})
    assert kept.graph.names == ("a", "b", "c")
    assert kept.graph.edges == (("a", "b"),)
    assert kept.graph.weights.tolist() == [1.0]
    assert kept.ranks.tolist() == [3]
    assert kept.graph.components == (("a", "b"), ("c",))
