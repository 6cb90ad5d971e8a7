"""A team too large to be searched at once: bounded searches, everybody found, and no order matters."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import Team, se2
from dgorl.evaluation.records import truth_at
from dgorl.expansion import clusters, decimated, drafts, search
from dgorl.expansion.cluster_graph import ClusterGraph, cluster_graph
from dgorl.expansion.step import LARGEST, SPACING, WHOLE, Step
from dgorl.measurements import known_at
from dgorl.window import extended
from tests.integration.teams import settings, simulated

ROBOTS, END = 26, 36.0


@pytest.fixture(scope="module")
def log():
    steps = int(2 * END) + 2
    return simulated(robots=ROBOTS, area=64.0, steps=steps, sensors=("range",), comm_range=25.0, seed=2)


def node(log, team, order=None):
    """The team at END, told everything at once, or in an order and what is known at each node by itself."""
    stamps = [END] if order is None else np.arange(SPACING + 1.0, END + 0.1, SPACING)
    told = -1.0
    for now in stamps:
        for k in range(len(log.measurements)) if order is None else order:
            if told < known_at(log.measurements[k]) <= now:
                team.add(log.measurements[k])
        state, told = team.update(float(now)), now
    return state


def test_no_search_is_larger_than_a_part_and_everybody_is_found(log, monkeypatch):
    tracks, expanded, sets = [], [], []
    optimize, graphs, whole = ClusterGraph.optimize, drafts.best_graphs, clusters.expanded

    def counted(self, starts, *rest):
        tracks.append((len(self.keys), len(starts)))
        return optimize(self, starts, *rest)

    def searched(unary, pairwise):
        expanded.append(graphs(unary, pairwise))
        return expanded[-1]

    def step(at, before, components, since):
        sets.append((at.index, sum(len(c.tracks) for c in components)))
        return whole(at, before, components, since)

    monkeypatch.setattr(ClusterGraph, "optimize", counted)
    monkeypatch.setattr(drafts, "best_graphs", searched)
    monkeypatch.setattr(clusters, "expanded", step)
    state = node(log, Team(settings(log)))
    assert max(count for _, count in sets) <= LARGEST
    for index in {index for index, _ in sets}:
        parts = [count for at, count in sets if at == index]
        assert len(parts) < ROBOTS / 2
    assert {starts for count, starts in tracks if count > WHOLE} <= {1}  # a joined team's one coarse start
    assert max(graphs.expanded for graphs in expanded) <= search.EXPANSIONS + search.WIDTH * LARGEST
    (joined,) = state.joined
    assert len(joined.members) == ROBOTS
    names = sorted(joined.members)
    at = {key: truth_at(log.truth, key.robot, np.array([END]))[0] for key in names}
    for a in names[::7]:
        relative = joined.relative(a)
        for b in names:
            if a != b:
                off = (relative[b].pose - se2.between(at[a], at[b]))[:2]
                sigma = np.sqrt(np.linalg.eigvalsh(relative[b].covariance[:2, :2])[-1])
                assert np.hypot(*off) < max(2.0, 5 * sigma)


def test_a_large_team_is_the_same_whatever_the_order(log):
    order = np.random.default_rng(1).permutation(len(log.measurements))
    one, other = node(log, Team(settings(log))), node(log, Team(settings(log)), order)
    assert len(one.joined) == len(other.joined)
    for a, b in zip(one.joined, other.joined, strict=True):
        assert a.members == b.members
        first = min(a.members)
        for key, seen in a.relative(first).items():
            np.testing.assert_array_equal(seen.pose, b.relative(first)[key].pose)
            np.testing.assert_array_equal(seen.covariance, b.relative(first)[key].covariance)


def test_a_large_component_starts_from_its_coarse_optimum(log):
    """Where it was moved by odometry alone it fits far better, in the same frame."""
    team = Team(settings(log))
    node(log, team)
    component = max(team._memo.node(25.0).components, key=lambda c: len(c.tracks))
    assert len(component.tracks) > WHOLE
    tracks = {t.key: t for t in team.history.tracks}
    grown = extended(component, tracks, 30.0)
    moved = decimated.smoothed(Step(team.history, tracks, 30.0), grown)
    assert moved.stretches.keys() == grown.stretches.keys()
    assert all(moved.stretches[key].first == grown.stretches[key].first for key in grown.tracks)
    first = min(s.first for s in grown.stretches.values())
    graph = cluster_graph(team.history, grown, [grown.tracks], first, 30.0)
    starts = np.stack([graph.start(grown), graph.start(moved)])
    (before, after), (least,) = graph.graph.costs(starts), graph.optimize(starts[1:], iterations=100).cost
    assert after - least < 0.75 * (before - least)
