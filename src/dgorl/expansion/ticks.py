"""Between nodes: every hypothesis re-optimised with what came since, and weighed anew. METHOD §4."""

from __future__ import annotations

import numpy as np

from dgorl.expansion.cluster_graph import cluster_graph
from dgorl.expansion.hypotheses import Cluster, Hypothesis, probabilities
from dgorl.expansion.step import Step, internal_links
from dgorl.history import History
from dgorl.optimization.problem import Indices, Solution
from dgorl.team_state import TOLERANCE, TeamState, joint_now
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Component, extended

Weighed = tuple[float, TeamState]
"""Probability of a hypothesis, and where everybody is if it holds."""


def hypotheses_now(history: History, cluster: Cluster, now: float) -> list[Weighed]:
    """The beam of a cluster at ``now`` [s], most probable first; empty when none can be carried on."""
    tracks = {t.key: t for t in history.tracks if t.key in cluster.tracks}
    step = Step(history, tracks, now)
    found = []
    for hypothesis in cluster.hypotheses:
        try:
            found.append(_now(step, cluster, hypothesis))
        except ValueError:  # the graph leaves a pose undetermined
            continue
    if not found:
        return []
    probability = probabilities(np.array([mass for mass, _ in found]))
    weighed = [(float(p), state) for p, (_, state) in zip(probability, found, strict=True)]
    return sorted(weighed, key=lambda item: -item[0])


def _now(step: Step, cluster: Cluster, hypothesis: Hypothesis) -> tuple[float, TeamState]:
    """Log mass of a hypothesis now, and its team."""
    unit = extended(hypothesis.recent, step.tracks, step.g)
    if not unit.tracks:
        raise ValueError("no track is left")
    base = min(unit.stretches[key].first for key in unit.tracks)
    unit = Component(unit.stretches, unit.priors, internal_links(step, unit, base / KEYFRAMES_PER_SECOND))
    graph = cluster_graph(step.history, unit, cluster.groups, base, step.g)
    optima = graph.optimize(graph.start(unit)[None], TOLERANCE)

    def solution(_: Indices) -> Solution:
        return Solution(optima.poses[0], float(optima.cost[0]), 0, "converged", optima.covariance[0])

    mass = hypothesis.mass + float(optima.mass[0]) - hypothesis.recent_mass
    return mass, joint_now(step.history, graph.window, step.g, solution)
