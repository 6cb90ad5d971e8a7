"""A joined component in which two robots have passed one another: is the side they took still open? METHOD §4.

What tells the side may come later than the passing, and until it does there are two optima of like mass. A component
has room for one: while both are possible it is a cluster again, whose hypotheses they are. Pairs on which these agree
stay accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from math import degrees, floor

import numpy as np

from dgorl import se2
from dgorl.configuration import Status
from dgorl.expansion.apart import SAME
from dgorl.expansion.beam import beam
from dgorl.expansion.cluster_graph import ClusterGraph, Optima, cluster_graph
from dgorl.expansion.hypotheses import CERTAIN, NODES, Cluster, distinct, pair_relative, probabilities
from dgorl.expansion.passing import Layout, Passing, passed, passings
from dgorl.expansion.step import Step, beside
from dgorl.marginal import excerpt, stretches
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component

REMEMBERED = 30.0
"""For so long [s] the side on which two joined robots have passed one another is not taken for granted."""

BETTER = 1e-3
"""Log mass by which another optimum of a joined component has to be higher to take its place."""


def sides(step: Step, component: Component, since: float) -> tuple[Component, Cluster | None]:
    """The component at the best optimum of its passings since a stamp [s]; as a cluster while others are possible."""
    groups = [(key,) for key in component.tracks]
    base = min(component.stretches[key].first for key in component.tracks)
    graph = cluster_graph(step.history, component, groups, base, step.g)
    known = graph.start(component)
    met = passings(graph.window.layout, known, floor(since * KEYFRAMES_PER_SECOND))
    if not met:
        return component, None
    tried = graph.optimize(np.concatenate([known[None], passed(graph, known, met)]))
    optima = distinct(tried)
    if len(optima.mass) > 1 and (open_ := _open(graph, optima, step.history.configuration.status)):
        found = beam(step, graph, optima, component, base, None)
        settled = [pair for pair in combinations(graph.keys, 2) if pair not in open_]
        return component, replace(found, agreed=dict.fromkeys(settled, NODES), passing=_named(met, open_))
    best = int(np.argmax(tried.mass))
    if not tried.mass[best] > tried.mass[0] + BETTER:
        return component, None
    return Component(stretches(graph.window, tried.poses[best], None), component.priors, component.links), None


def sides_of_some(step: Step, component: Component, since: float) -> Component:
    """A large component, at the best side of its nearest passing as those tell it who are nearest; it stays joined."""
    layout, offset = {}, 0
    for key in component.tracks:
        stretch = component.stretches[key]
        layout[key] = (offset, stretch.first, len(stretch.poses))
        offset += len(stretch.poses)
    poses = np.concatenate([component.stretches[key].poses for key in component.tracks])
    met = [] if component.has_world else passings(layout, poses, floor(since * KEYFRAMES_PER_SECOND))
    if not met:
        return component
    part = excerpt(component, beside(component, met[0].pair))
    moved, _ = sides(step, part, since)
    return component if moved is part else replace(component, stretches={**component.stretches, **moved.stretches})


def _open(graph: ClusterGraph, optima: Optima, limits: Status) -> list[tuple[TrackKey, TrackKey]]:
    """Pairs of tracks that are elsewhere with more probability than what is accepted leaves to others.

    None of these if for no pair it would change what its status promises.
    """
    probability = probabilities(optima.mass)
    found, matters = [], False
    for (a, first), (b, second) in combinations(enumerate(graph.keys), 2):
        T_a_b, covariance = pair_relative(optima.relative[0], optima.covariance[0], a, b)
        change = se2.between(T_a_b, se2.between(optima.relative[:, a], optima.relative[:, b]))
        elsewhere = np.einsum("bi,ij,bj->b", change, np.linalg.inv(covariance), change) > SAME**2
        if probability[elsewhere].sum() <= 1 - CERTAIN:
            continue
        found.append((first, second))
        accuracy = max(limits.accuracy, limits.accuracy_per_metre * float(np.hypot(T_a_b[0], T_a_b[1])))
        far = (np.hypot(change[:, 0], change[:, 1]) > accuracy) | (degrees(1.0) * np.abs(change[:, 2]) > limits.heading)
        matters = matters or bool(probability[elsewhere & far].sum() > 1 - CERTAIN)
    return found if matters else []


def _named(met: Sequence[Passing], open_: Sequence[tuple[TrackKey, TrackKey]]) -> tuple[TrackKey, TrackKey]:
    """The nearest passing, of a pair that is open if there is one."""
    return next((passing.pair for passing in met if passing.pair in open_), met[0].pair)


def just_passed(layout: Layout, poses: Array, since: float) -> bool:
    """Whether anybody has passed anybody since a stamp [s]; as :attr:`Window.layout`, poses (N, 3)."""
    return bool(passings(layout, poses, floor(since * KEYFRAMES_PER_SECOND)))
