"""From node to node: which components are linked, what is possible of them, and who is joined. METHOD §4."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from math import inf

import numpy as np

from dgorl import se2
from dgorl.expansion.beam import expanded
from dgorl.expansion.hypotheses import Cluster, groups_of
from dgorl.expansion.step import Step, internal_links, restricted
from dgorl.formation import contacts
from dgorl.history import History
from dgorl.marginal import settled
from dgorl.stages import FORMATION, stage
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component, Prior

ENOUGH = 4
"""Readings between two components from which on they are expanded."""


def advance(
    history: History,
    previous: Sequence[Cluster],
    components: Sequence[Component],
    since: Mapping[TrackKey, float],
    g: float,
    boundary: float,
    held: frozenset[TrackKey] = frozenset(),
) -> tuple[list[Component], list[Cluster]]:
    """Components and clusters at node g [s]: components joined where two nodes agree, hypotheses about the others.

    previous: the clusters of the node before. since: from when on tracks count that were cut off [s]. boundary: where
    the next node's window starts [s]. Those are located, but not joined for one ``history``: they must not
    bend the others; nor are those held: one of them may be a liar.
    """
    if len(components) < 2:
        return list(components), []
    doubted = held | {key for key, stamp in since.items() if g - stamp < history.configuration.history}
    members = {key: k for k, component in enumerate(components) for key in component.tracks}
    step = Step(history, {t.key: t for t in history.tracks if t.key in members}, g, since)
    kept, clusters = list(range(len(components))), []
    joined: list[Component] = []
    with stage(FORMATION):
        sets = list(_sets(step, previous, components, members))
    for linked, first, before in sets:
        mine = [components[k] for k in linked]
        try:
            cluster = expanded(step, before, mine, first)
        except ValueError:  # the graph leaves a pose undetermined: nothing can be said of these
            continue
        again = [pair for pair in cluster.sure if not doubted & set(pair)]
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


def _sets(
    step: Step, previous: Sequence[Cluster], components: Sequence[Component], members: Mapping[TrackKey, int]
) -> Iterator[tuple[list[int], float, Cluster | None]]:
    """Sets of two or more components that readings link, the stamp of the first [s], and the cluster they were.

    Readings count where the graph has poses of both ends. Those of a robot's earlier epoch may all be older: then it is
    no part of the set, as nothing would determine it, nor anybody with it.
    """
    reach = _reach(step.since, previous, components)
    waiting = _linked(step, members, reach, step.history.horizon(step.g))
    while waiting:
        linked, first = waiting.pop(0)
        before = _before(previous, [components[k] for k in linked])
        base = -inf if before is None else before.base / KEYFRAMES_PER_SECOND
        if first < base:
            waiting += _linked(step, {key: k for key, k in members.items() if k in linked}, reach, base)
        else:
            yield linked, first, before


def _reach(
    since: Mapping[TrackKey, float], previous: Sequence[Cluster], components: Sequence[Component]
) -> Mapping[TrackKey, float]:
    """From when on readings of a track count [s]: joined ones have no older poses, but as part of hypotheses."""
    supposed = {key: s.first for c in previous for key, s in c.hypotheses[0].component.stretches.items()}
    joined = {
        key: min(component.stretches[key].first, supposed.get(key, inf)) / KEYFRAMES_PER_SECOND
        for component in components
        if len(component.stretches) > 1
        for key in component.tracks
    }
    return {key: max(joined.get(key, -inf), since.get(key, -inf)) for key in (*joined, *since)}


def _linked(
    step: Step, members: Mapping[TrackKey, int], since: Mapping[TrackKey, float], low: float
) -> list[tuple[list[int], float]]:
    """Sets of two or more components that readings since ``low`` [s] link, and the stamp of the first."""
    between: dict[tuple[int, int], tuple[int, float]] = {}
    for (a, b), contact in contacts(step.history, low, step.g, since).items():
        if a in members and b in members and members[a] != members[b]:
            pair = min(members[a], members[b]), max(members[a], members[b])
            readings, first = between.get(pair, (0, inf))
            between[pair] = readings + contact.readings, min(first, contact.first)
    sets: list[tuple[set[int], float]] = []
    for pair, (readings, first) in sorted(between.items()):
        if readings < ENOUGH:
            continue
        joined, begin = set(pair), first
        for other in [s for s in sets if s[0] & joined]:
            sets.remove(other)
            joined, begin = joined | other[0], min(begin, other[1])
        sets.append((joined, begin))
    return [(sorted(joined), begin) for joined, begin in sorted(sets, key=lambda s: min(s[0]))]


def _before(previous: Sequence[Cluster], components: Sequence[Component]) -> Cluster | None:
    """The cluster that knew most of the tracks of these components."""
    tracks = {key for component in components for key in component.tracks}
    known = [c for c in previous if len(c.tracks & tracks) > 1]
    return max(known, key=lambda c: (len(c.tracks & tracks), sorted(c.tracks)), default=None)


def _joined(step: Step, cluster: Cluster, components: Sequence[Component], boundary: float) -> Component:
    """One component of several, placed as the best hypothesis has them; a weak prior keeps it proper."""
    keys = {key for component in components for key in component.stretches}
    best = restricted(cluster.hypotheses[0].component, keys)
    low = cluster.base / KEYFRAMES_PER_SECOND
    weak = _weak(best, components)
    best = Component(best.stretches, (*best.priors, *weak), internal_links(step, best, low))
    return settled(step.history, best, low, step.g, boundary).component


def _weak(best: Component, components: Sequence[Component]) -> tuple[Prior, ...]:
    """Π between the body of the first track and each other one, at the newest keyframe where a track of both stands.

    A robot's earlier epoch is a track that ends, perhaps before the cluster begins: it need not be in ``best``.
    """
    bodies = [[key for key in component.tracks if key in best.stretches] for component in components]
    first = next(body for body in bodies if best.tracks[0] in body)
    found = []
    for body in bodies:
        abreast = None if body is first else _abreast(best, first, body)
        if abreast is None:
            continue
        keyframe, pair = abreast
        a, b = (best.stretches[key].poses[keyframe - best.stretches[key].first] for key in pair)
        relative = se2.between(a, b)
        sigma = max(float(np.hypot(relative[0], relative[1])), 5.0)
        information = np.diag([sigma**-2, sigma**-2, np.pi**-2])
        found.append(Prior(keyframe, pair[0], (pair[1],), relative[None], information, np.zeros(3)))
    return tuple(found)


def _abreast(best: Component, a: Sequence[TrackKey], b: Sequence[TrackKey]) -> tuple[int, tuple[TrackKey, ...]] | None:
    """The newest keyframe at which a track of both bodies stands, and these two; None if there is none."""
    found = []
    for pair in product(a, b):
        ends = [best.stretches[key] for key in pair]
        newest = min(s.first + len(s.poses) - 1 for s in ends)
        if newest >= max(s.first for s in ends):
            found.append((newest, pair))
    return max(found, key=lambda item: item[0], default=None)  # of several the first in canonical order
