"""From node to node: which components are linked, what is possible of them, and who is joined. METHOD §4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
        sets = _linked(step, members)
    for linked, first in sets:
        mine = [components[k] for k in linked]
        before = _before(previous, mine)
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


def _linked(step: Step, members: Mapping[TrackKey, int]) -> list[tuple[list[int], float]]:
    """Sets of two or more components that readings of the last ``history`` seconds link, and the stamp of the first."""
    horizon = step.history.horizon(step.g)
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
