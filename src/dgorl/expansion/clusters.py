"""From node to node: which components are linked, what is possible of them, and who is joined. METHOD §4."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from math import floor, inf

import numpy as np

from dgorl import se2
from dgorl.expansion import drafts
from dgorl.expansion.cluster_graph import ClusterGraph, Optima, cluster_graph
from dgorl.expansion.decimated import Decimated, decimated
from dgorl.expansion.hypotheses import (
    CERTAIN,
    COARSE,
    Cluster,
    Hypothesis,
    agreement,
    both,
    distinct,
    fresh,
    groups_of,
    probabilities,
    settled_pair,
)
from dgorl.formation import contacts
from dgorl.history import WORLD_KEY, History
from dgorl.marginal import marginalized, settled, stretches
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, Track, TrackKey
from dgorl.window import Component, Link, Prior, alone, extended, links, stands

SPACING = 5.0
"""Seconds between nodes."""

ENOUGH = 4
"""Readings between two components from which on they are expanded."""

RECENT = 20
"""Keyframes of a hypothesis that ticks optimise; what came before is a prior to them."""

NODES = 2
"""Nodes in a row at which a relative pose has to be certain to be accepted."""

DRAFTS, IMPROVED, STARTS = 30, 10, 4
"""Candidate graphs that are optimised coarsely, more so, and wholly, at a time."""

WARM = 8
"""Warm particles of the best hypothesis."""

Group = tuple[TrackKey, ...]


@dataclass(frozen=True)
class Step:
    """Where a cluster is taken at node time g [s], with the tracks known there."""

    history: History
    tracks: Mapping[TrackKey, Track]
    g: float
    since: Mapping[TrackKey, float] = field(default_factory=dict)

    @property
    def index(self) -> int:
        """Number of the node."""
        return int(self.g // SPACING)

    @property
    def seed(self) -> tuple[int, int]:
        return self.history.configuration.seed, self.index % 2**31


def advance(
    history: History,
    previous: Sequence[Cluster],
    components: Sequence[Component],
    since: Mapping[TrackKey, float],
    low: float,
    g: float,
    boundary: float,
) -> tuple[list[Component], list[Cluster]]:
    """Components and clusters at node g [s]: components joined where two nodes agree, hypotheses about the others.

    previous: the clusters of the node before. since: from when on tracks count that were cut off [s]. low, boundary: starts of this and the next node's window [s].
    """
    members = {key: k for k, component in enumerate(components) for key in component.tracks}
    step = Step(history, {t.key: t for t in history.tracks if t.key in members}, g, since)
    kept, clusters = list(range(len(components))), []
    joined: list[Component] = []
    for linked, first in _linked(step, members):
        mine = [components[k] for k in linked]
        before = _before(previous, mine)
        try:
            cluster = _expanded(step, before, mine, first)
        except ValueError:  # the graph leaves a pose undetermined: nothing can be said of these
            continue
        again = [pair for pair, count in sorted(cluster.agreed.items()) if count >= NODES]
        left = set(linked)
        for group in groups_of(again, members):
            try:
                joined.append(_joined(step, cluster, [components[k] for k in sorted(group)], boundary))
            except ValueError:
                continue
            left -= group
            kept = [k for k in kept if k not in group]
        if len(left) + len(groups_of(again, members)) > 1:
            clusters.append(cluster)
    return [*(components[k] for k in kept), *joined], clusters


def _linked(step: Step, members: Mapping[TrackKey, int]) -> list[tuple[list[int], float]]:
    """Sets of two or more components that readings of the last ``history`` seconds link, and the stamp of the first."""
    configuration = step.history.configuration
    horizon = -inf if configuration.window == "all" else step.g - configuration.history
    between: dict[tuple[int, int], tuple[int, float]] = {}
    for (a, b), contact in contacts(step.history, horizon, step.g, step.since).items():
        if a in members and b in members and members[a] != members[b]:
            pair = min(members[a], members[b]), max(members[a], members[b])
            readings, first = between.get(pair, (0, inf))
            between[pair] = readings + contact.readings, min(first, contact.first)
    sets: list[tuple[set[int], float]] = []
    for pair, (readings, first) in sorted(between.items()):
        if readings < ENOUGH:
            continue
        joined, since = set(pair), first
        for other in [s for s in sets if s[0] & joined]:
            sets.remove(other)
            joined, since = joined | other[0], min(since, other[1])
        sets.append((joined, since))
    return [(sorted(joined), since) for joined, since in sorted(sets, key=lambda s: min(s[0]))]


def _before(previous: Sequence[Cluster], components: Sequence[Component]) -> Cluster | None:
    """The cluster that knew most of the tracks of these components."""
    tracks = {key for component in components for key in component.tracks}
    known = [c for c in previous if len(c.tracks & tracks) > 1]
    return max(known, key=lambda c: (len(c.tracks & tracks), sorted(c.tracks)), default=None)


def _expanded(step: Step, before: Cluster | None, components: Sequence[Component], since: float) -> Cluster:
    """The cluster of these components at g, from what was known of it."""
    history, g = step.history, step.g
    first = floor(since * KEYFRAMES_PER_SECOND)
    base = first if before is None else max(before.base, first)
    groups = [tuple(component.stretches) for component in components]
    known = [] if before is None else [_carried(step, h.component, groups, base) for h in before.hypotheses]
    added = [_fresh(step, component, base) for component in components]
    unions = [_union([h, *(c for c in added if not c.stretches.keys() & h.stretches.keys())]) for h in known]
    union = unions[0] if unions else _union(added)
    union = Component(union.stretches, union.priors, internal_links(step, union, base / KEYFRAMES_PER_SECOND))
    graph = cluster_graph(history, union, groups, base, g)
    k = history.configuration.candidates
    shapes = drafts.shapes_of(graph, graph.start(_rigid(union, added)), graph.drift(), step.seed)
    coarse = decimated(graph, shapes.poses)
    optima = None
    if unions:
        starts = np.stack([graph.start(u) for u in unions])
        new = [j for j, c in enumerate(added) if not c.stretches.keys() & known[0].stretches.keys()]
        starts = _with_new(step, graph, starts, new, k) if new else starts
        optima = distinct(graph.optimize(coarse.whole(coarse.optimize(starts).poses)))
    optima = _searched(graph, coarse, optima, shapes.starts(drafts.cold(shapes, k)))
    for _ in range(1 if unions else 2):
        near = drafts.shapes_of(graph, optima.poses[0], graph.drift(), step.seed)
        places = np.concatenate([drafts.reseeded(near), drafts.mirrored(near), drafts.warm(near, optima[[0]], WARM)])
        optima = _searched(graph, coarse, optima, near.starts(places))
    return _cluster(step, graph, optima, union, base, before)


def _rigid(union: Component, added: Sequence[Component]) -> Component:
    """Single tracks as odometry has them, joined components as a hypothesis does."""
    singles = {key: s for c in added if len(c.stretches) == 1 for key, s in c.stretches.items()}
    return Component({**union.stretches, **singles})


def _searched(graph: ClusterGraph, coarse: Decimated, optima: Optima | None, starts: Array) -> Optima:
    """The best of the optima and of what candidate graphs lead to: coarsely all of them, wholly the few best."""
    tried = coarse.optimize(starts[:DRAFTS])
    found = coarse.improve(distinct(tried, IMPROVED, np.inf))
    if optima is None:
        return distinct(graph.optimize(coarse.whole(distinct(found, STARTS, COARSE).poses)))
    new = fresh(coarse.optimize(optima.poses), found, STARTS)
    return distinct(both(optima, graph.optimize(coarse.whole(new.poses)))) if len(new.mass) else optima


def _with_new(step: Step, graph: ClusterGraph, starts: Array, fresh: list[int], k: int) -> Array:
    """Starts in which components new to the cluster are placed where each hypothesis sees them."""
    placed = [j for j in range(len(graph.bodies)) if j not in fresh]
    grown = []
    for start in starts[: max(STARTS // k, 1)]:
        shapes = drafts.shapes_of(graph, start, graph.drift(), step.seed)
        found = drafts.complete(shapes, np.zeros((1, shapes.size, 3)), np.zeros(1), placed, k)
        grown.append(shapes.starts(found))
    return np.concatenate(grown)[: 2 * STARTS]


def _cluster(
    step: Step, graph: ClusterGraph, optima: Optima, union: Component, base: int, before: Cluster | None
) -> Cluster:
    """The beam of these optima as a cluster."""
    probability = probabilities(optima.mass)
    pin = floor(step.g * KEYFRAMES_PER_SECOND) - RECENT
    hypotheses = []
    for poses, mass, p in zip(optima.poses, optima.mass, probability, strict=True):
        component = Component(stretches(graph.window, poses, None), union.priors)
        recent = component
        if pin > graph.window.base:
            recent = Component(stretches(graph.window, poses, pin), marginalized(graph.window, poses, pin))
        same = len(optima.mass) == 1 or recent is component
        recent_mass = float(mass) if same else _mass(step, graph.bodies, recent)
        hypotheses.append(Hypothesis(component, float(mass), float(p), recent, recent_mass))
    agreed = {}
    keys, body = graph.keys, graph.body[graph.newest]
    for a, b in combinations(range(len(keys)), 2):
        if (
            body[a] != body[b]
            and (len(probability) == 1 or agreement(optima, probability, a, b) >= CERTAIN)
            and settled_pair(optima, a, b)
        ):
            agreed[keys[a], keys[b]] = 1 + (0 if before is None else before.agreed.get((keys[a], keys[b]), 0))
    return Cluster(base, graph.bodies, tuple(hypotheses), agreed)


def _mass(step: Step, groups: Sequence[Group], recent: Component) -> float:
    """Log mass of the recent part of a hypothesis where it stands."""
    base = min(recent.stretches[key].first for key in recent.tracks)
    unit = Component(recent.stretches, recent.priors, internal_links(step, recent, base / KEYFRAMES_PER_SECOND))
    graph = cluster_graph(step.history, unit, groups, base, step.g)
    poses = graph.start(unit)[None]
    return float(graph.weigh(poses, graph.graph.costs(poses)).mass[0])


def _joined(step: Step, cluster: Cluster, components: Sequence[Component], boundary: float) -> Component:
    """One component of several, placed as the best hypothesis has them; a weak prior keeps it proper."""
    keys = {key for component in components for key in component.stretches}
    best = restricted(cluster.hypotheses[0].component, keys)
    low = cluster.base / KEYFRAMES_PER_SECOND
    weak = _weak(best, components, step)
    best = Component(best.stretches, (*best.priors, *weak), internal_links(step, best, low))
    return settled(step.history, best, low, step.g, boundary).component


def _weak(best: Component, components: Sequence[Component], step: Step) -> tuple[Prior, ...]:
    """Π between the first track and the first of each other component, where both stand at the newest keyframe."""
    first = best.tracks[0]
    newest = {key: s.first + len(s.poses) - 1 for key, s in best.stretches.items()}
    found = []
    for component in components:
        other = component.tracks[0]
        keyframe = min(newest[first], newest[other])
        if first in component.stretches or keyframe < max(best.stretches[first].first, best.stretches[other].first):
            continue
        a, b = (best.stretches[key].poses[keyframe - best.stretches[key].first] for key in (first, other))
        relative = se2.between(a, b)
        sigma = max(float(np.hypot(relative[0], relative[1])), 5.0)
        information = np.diag([sigma**-2, sigma**-2, np.pi**-2])
        found.append(Prior(keyframe, first, (other,), relative[None], information, np.zeros(3)))
    return tuple(found)


def restricted(component: Component, keys: Iterable[TrackKey]) -> Component:
    """What a component knows of some of its tracks alone."""
    keys = set(keys)
    priors = tuple(p for p in component.priors if {p.reference, *p.members} <= keys)
    return Component({key: s for key, s in component.stretches.items() if key in keys}, priors)


def internal_links(step: Step, component: Component, low: float) -> tuple[Link, ...]:
    """Measured relative poses inside a component since ``low`` [s]."""
    inside = component.stretches
    return tuple(
        link
        for link in links(step.history, step.tracks, low, step.g)
        if {link.reference, link.robot} <= inside.keys()
        and stands(component, link.reference, link.stamp_reference)
        and stands(component, link.robot, link.stamp_robot)
    )


def _carried(step: Step, component: Component, groups: Sequence[Group], base: int) -> Component:
    """A hypothesis carried on to g, of the tracks that are still there."""
    keys = {key for group in groups for key in group}
    kept = extended(restricted(component, keys), step.tracks, step.g)
    return kept


def _fresh(step: Step, component: Component, base: int) -> Component:
    """A component as it enters a cluster: single tracks from the base on."""
    if len(component.stretches) > 1 or WORLD_KEY in component.stretches:
        return Component(component.stretches, component.priors)
    key = component.tracks[0]
    return alone(step.tracks[key], max(base / KEYFRAMES_PER_SECOND, step.since.get(key, -inf)), step.g)


def _union(components: Sequence[Component]) -> Component:
    """Several components side by side, each in its own frame."""
    stretches = {key: s for component in components for key, s in component.stretches.items()}
    return Component(stretches, tuple(prior for component in components for prior in component.priors))
