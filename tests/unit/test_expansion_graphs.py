"""A cluster's whole and coarse graph, its bodies' candidates, and drafts of where they stand. METHOD §4."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dgorl import Configuration, Displacement, Range, Rssi, se2
from dgorl.configuration import merge
from dgorl.expansion import drafts
from dgorl.expansion.candidates import candidates
from dgorl.expansion.cluster_graph import ClusterGraph, cluster_graph
from dgorl.expansion.decimated import SPACING, Decimated, decimated
from dgorl.history import History
from dgorl.radio import range_to_rssi
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Component, grow
from tests.unit.reference import retract

Array = np.ndarray
ROBOTS = ("r1", "r2", "r3")
STARTS = np.array([[0.0, 0.0, 0.3], [9.0, 4.0, 2.0], [-6.0, 9.0, -1.0]])
TURNS = (0.15, -0.1, 0.05)
FIRST, LAST = 3, 60
"""Keyframes the robots drive from and to: 3 is no multiple of the coarse spacing."""


def team(sensor: str = "range", noise: float = 0.0, kernel: str = "none", odometry_sigma: float = 1e-4, seed: int = 0):
    """History of three robots on circles, the truth (keyframes, robots, 3), and the keyframe it begins at."""
    rng = np.random.default_rng(seed)
    settings = {"radio": {"sigma_db": 2.0, "kernel": kernel}, "ranging": {"kernel": kernel}}
    history = History(merge(Configuration(), settings, "test"))
    truth = [STARTS]
    for k in range(FIRST, LAST):
        step = np.array([[0.2, 0.0, turn] for turn in TURNS])
        for robot, (x, y, t) in zip(ROBOTS, step, strict=True):
            variance = (odometry_sigma**2, 0.0, 0.0, odometry_sigma**2, 0.0, odometry_sigma**2)
            told = np.array([x, y, t]) + noise * odometry_sigma * rng.normal(size=3)
            history.add(Displacement(robot, k / 2, (k + 1) / 2, *told, variance))
        truth.append(se2.compose(truth[-1], step))
    poses = np.array(truth)
    for k in range(1, LAST - FIRST + 1):
        for a, b in ((0, 1), (0, 2), (1, 2)):
            d = float(np.hypot(*(poses[k, a] - poses[k, b])[:2]))
            stamp = (FIRST + k) / 2
            if sensor == "range":
                history.add(Range(ROBOTS[a], ROBOTS[b], stamp, d + 0.1 * noise * rng.normal(), 0.1))
            else:
                dbm = float(range_to_rssi(d, history.configuration.radio)) + 2.0 * noise * rng.normal()
                history.add(Rssi(ROBOTS[a], ROBOTS[b], stamp, dbm))
    history.admit(LAST / 2, node_due=True)
    return history, poses


def cluster(history: History, starts: Array = STARTS) -> tuple[ClusterGraph, Array]:
    """The graph of three single tracks, and its poses (N, 3) as odometry has them from ``starts``."""
    components = grow(history, (), -np.inf, LAST / 2)
    assert [len(c.tracks) for c in components] == [1, 1, 1]
    groups = [c.tracks for c in components]
    union = Component({key: stretch for c in components for key, stretch in c.stretches.items()})
    graph = cluster_graph(history, union, groups, FIRST, LAST / 2)
    places = {key: start for (key,), start in zip(groups, starts, strict=True)}
    placed = Component({key: s._replace(poses=se2.compose(places[key], s.poses)) for key, s in union.stretches.items()})
    return graph, graph.start(placed)


def whole_truth(graph: ClusterGraph, poses: Array) -> Array:
    return np.concatenate([poses[:, k] for k in range(len(ROBOTS))])


# ---- the cluster's graph ----


def test_the_cluster_is_laid_out_by_track():
    history, truth = team()
    graph, poses = cluster(history)
    np.testing.assert_allclose(se2.between(whole_truth(graph, truth), poses), 0, atol=1e-9)
    assert [key.robot for key in graph.keys] == list(ROBOTS)
    assert (graph.body == np.repeat([0, 1, 2], LAST - FIRST + 1)).all()
    np.testing.assert_array_equal(graph.newest, (LAST - FIRST + 1) * np.array([1, 2, 3]) - 1)
    assert graph.graph.cost(poses) < 1e-9


def test_the_weak_prior_is_on_one_track_of_every_body_but_the_references():
    history, _ = team()
    graph, _ = cluster(history)
    np.testing.assert_array_equal(graph.soft, graph.newest[1:])
    farthest = max(m.value.max() for m in graph.window.problem.scalars)
    np.testing.assert_allclose(graph.pi, [farthest**-2, farthest**-2, np.pi**-2])


def test_mass_is_minus_cost_minus_half_log_determinant():
    history, _ = team(noise=1.0, odometry_sigma=0.02)
    graph, poses = cluster(history)
    optima = graph.optimize(poses[None])
    hessian, _ = graph.graph.hessian(optima.poses[0])
    free = np.flatnonzero(~graph.window.problem.fixed)
    place = np.searchsorted(free, graph.soft)
    for p in place:
        hessian[3 * p : 3 * p + 3, 3 * p : 3 * p + 3] += np.diag(graph.pi)
    expected = -graph.graph.cost(optima.poses[0]) - np.linalg.slogdet(hessian)[1] / 2
    assert optima.mass[0] == pytest.approx(expected, rel=1e-9)
    assert not optima.covariance[0, :3].any()
    joint = np.linalg.inv(hessian)
    rows = (3 * np.searchsorted(free, graph.newest[1:])[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(optima.covariance[0, 3:, 3:], joint[np.ix_(rows, rows)], rtol=1e-5, atol=1e-9)
    newest = optima.poses[0][graph.newest]
    np.testing.assert_allclose(optima.relative[0], se2.between(newest[0], newest))


# ---- the coarse one ----


def coarse_of(graph: ClusterGraph, poses: Array) -> Decimated:
    found = decimated(graph, poses)
    keyframes = np.arange(FIRST, LAST + 1)
    per_track = 1 + np.sum(keyframes[1:] % SPACING == 0)
    assert len(found.first) == 3 * per_track
    return found


def test_whole_is_the_inverse_of_coarse_for_trajectories_of_the_same_shape():
    history, _ = team()
    graph, poses = cluster(history)
    coarse = coarse_of(graph, poses)
    rng = np.random.default_rng(0)
    placed = [cluster(history, rng.uniform(-3, 3, (3, 3)))[1] for _ in range(3)]
    batch = np.stack([poses, *placed])
    np.testing.assert_allclose(se2.between(batch, coarse.whole(coarse.coarse(batch))), 0, atol=1e-9)
    few = rng.uniform(-3, 3, (2, len(coarse.first), 3))
    np.testing.assert_allclose(se2.between(few, coarse.coarse(coarse.whole(few))), 0, atol=1e-12)


@pytest.mark.parametrize("kernel", ["none", "huber"])
@pytest.mark.parametrize("sensor", ["range", "rssi"])
def test_the_coarse_cost_is_close_to_the_whole_one(sensor, kernel):
    """Exact readings, precise odometry: moving bodies apart costs the same in both graphs, averaged or not."""
    history, _ = team(sensor, kernel=kernel)
    graph, poses = cluster(history)
    coarse = coarse_of(graph, poses)
    rng = np.random.default_rng(1)
    steps = [0.5, 0.5, 0.1] * rng.normal(size=(6, 3, 3))
    starts = np.stack([cluster(history, retract(STARTS, step))[1] for step in steps])
    whole, few = graph.graph.costs(starts), coarse.graph.graph.costs(coarse.coarse(starts))
    assert whole.min() > 2
    np.testing.assert_allclose(few, whole, rtol=0.05)


def test_readings_are_fewer_without_a_kernel_and_all_there_with_one():
    counts = {}
    for kernel in ("none", "huber"):
        history, _ = team(kernel=kernel)
        graph, poses = cluster(history)
        (s,) = coarse_of(graph, poses).graph.window.problem.scalars
        counts[kernel] = len(s.value)
        assert len(graph.window.problem.scalars[0].value) == 3 * (LAST - FIRST)
    assert counts["huber"] == 3 * (LAST - FIRST)
    assert counts["none"] <= counts["huber"] / (SPACING / 2) + 6


@pytest.mark.parametrize("seed", range(2))
def test_coarse_odometry_is_composed_with_its_covariance(seed):
    """δ and Σ of a coarse step against the composition of its parts, Jacobians by differences."""
    history, _ = team(noise=1.0, odometry_sigma=0.05, seed=seed)
    graph, poses = cluster(history)
    coarse = coarse_of(graph, poses)
    into, to, motion, information = coarse.graph.window.problem.odometry
    i, _, delta, fine = graph.window.problem.odometry
    row = {int(k): n for n, k in enumerate(i)}
    for k in range(0, len(into), 3):
        edges = [row[p] for p in range(coarse.first[into[k]], coarse.first[to[k]])]

        def composed(noise: Array, edges: list[int] = edges) -> Array:
            total = np.zeros(3)
            for edge, xi in zip(edges, noise, strict=True):
                total = se2.compose(total, retract(delta[edge], xi))
            return total

        zero = np.zeros((len(edges), 3))
        np.testing.assert_allclose(se2.between(composed(zero), motion[k]), 0, atol=1e-9)
        covariance = np.zeros((3, 3))
        for n, edge in enumerate(edges):
            jacobian = np.zeros((3, 3))
            for axis in range(3):
                step = zero.copy()
                step[n, axis] = 1e-6
                jacobian[:, axis] = se2.between(composed(-step), composed(step)) / 2e-6
            covariance += jacobian @ np.linalg.inv(fine[edge]) @ jacobian.T
        np.testing.assert_allclose(np.linalg.inv(information[k]), covariance, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_the_coarse_optimum_is_near_the_whole_one(seed):
    """With noise: the newest poses differ by about their σ, and lead to the same optimum of the whole graph."""
    history, _ = team(noise=1.0, odometry_sigma=0.02, seed=seed)
    graph, poses = cluster(history)
    coarse = coarse_of(graph, poses)
    whole, few = graph.optimize(poses[None]), coarse.improve(coarse.optimize(poses[None]))
    step = se2.between(whole.relative[0, 1:], few.relative[0, 1:]).ravel()
    sigma = np.sqrt(np.diag(whole.covariance[0, 3:, 3:]))
    assert (np.abs(step) < 1.5 * sigma).all()
    ratio = np.sqrt(np.diag(few.covariance[0, 3:, 3:])) / sigma
    assert (ratio > 0.8).all()
    assert (ratio < 1.5).all()
    again = graph.optimize(coarse.whole(few.poses))
    np.testing.assert_allclose(se2.between(whole.poses, again.poses), 0, atol=1e-2)


# ---- candidates and drafts ----


def shapes(graph: ClusterGraph, poses: Array, seed: int = 0) -> drafts.Shapes:
    return drafts.shapes_of(graph, poses, graph.drift(), (seed, 6))


def apart_from(expected: Array, found: Array) -> float:
    """Largest difference (..., 3) of places seen from the first body's."""
    relative = se2.between(np.broadcast_to(found[:1], found.shape), found)
    return float(np.abs(se2.between(expected, relative)).max())


@pytest.mark.parametrize("seed", range(3))
def test_a_cold_draft_is_the_truth(seed):
    """Bodies in frames of their own: the best drafts have the one that was simulated."""
    history, _ = team(noise=1.0, odometry_sigma=0.01, seed=seed)
    graph, poses = cluster(history, np.zeros((3, 3)))
    found = drafts.cold(shapes(graph, poses, seed), 5)
    expected = se2.between(np.broadcast_to(STARTS[:1], STARTS.shape), STARTS)
    assert apart_from(expected, found[0]) < 1.0
    assert len({tuple(np.round(d.ravel(), 6)) for d in found}) == len(found)


def test_chance_is_seeded_by_node_and_body():
    history, _ = team(noise=1.0)
    graph, poses = cluster(history, np.zeros((3, 3)))
    first, again, other = (drafts.cold(shapes(graph, poses, seed), 5) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).any()


def test_candidates_of_no_readings_are_none():
    nothing = np.zeros((0, 3))
    found = candidates([], (-40.0, 3.0), np.ones(3), 5, np.random.default_rng(0), nothing)
    assert len(found) == 0


def test_a_body_out_of_reach_of_the_reference_is_placed_by_the_others():
    """r3 and r1 never hear one another: complete() puts r3 where r2 sees it."""
    history, _ = team(noise=1.0, odometry_sigma=0.01)
    graph, poses = cluster(history, np.zeros((3, 3)))
    whole = shapes(graph, poses)
    linked = [s.i + s.j != 2 for s in whole.found]
    rows = [
        replace(
            s,
            **{
                f: getattr(s, f)[keep]
                for f in ("i", "j", "point_i", "point_j", "height", "value", "sigma", "distance", "slope")
            },
        )
        for s, keep in zip(whole.found, linked, strict=True)
    ]
    line = replace(whole, found=rows)
    placed = np.zeros((1, 3, 3))
    placed[0, 1] = se2.between(STARTS[0], STARTS[1])
    found = drafts.complete(line, placed, np.zeros(1), [0, 1], 5)
    expected = se2.between(np.broadcast_to(STARTS[:1], STARTS.shape), STARTS)
    assert min(apart_from(expected, draft) for draft in found) < 1.0


def test_reseeded_drafts_move_one_body_relative_to_the_others():
    history, _ = team(noise=1.0, odometry_sigma=0.01)
    graph, poses = cluster(history)
    found = drafts.reseeded(shapes(graph, poses))
    assert len(found)
    for draft in found:
        assert not draft[0].any()
        rest = se2.between(draft[:, None], draft[None])
        fixed = np.abs(rest).max(axis=2) < 1e-9
        assert fixed.sum() >= 5  # each body with itself, and two with one another
    # At the optimum every body's best place is about where it stands.
    assert np.abs(found[:3]).max() < 1.0


def test_warm_drafts_scatter_as_the_covariance_says():
    history, _ = team(noise=1.0, odometry_sigma=0.02)
    graph, poses = cluster(history)
    best = graph.optimize(poses[None])
    near = shapes(graph, best.poses[0])
    found = drafts.warm(near, best, 4000)
    newest = best.poses[0][graph.newest]
    at = se2.compose(found, newest)
    draws = se2.between(newest, at)
    np.testing.assert_allclose(draws[:, 0], 0, atol=1e-12)
    spread = np.cov(draws[:, 1:].reshape(-1, 6).T)
    expected = 4 * best.covariance[0, 3:, 3:]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(spread / scale, expected / scale, atol=0.1)
    assert graph.newest[0] == KEYFRAMES_PER_SECOND * (LAST - FIRST) // 2
