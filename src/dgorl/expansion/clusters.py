"""From node to node: which components are linked, what is possible of them, and who is joined. METHOD §4."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf

from dgorl.expansion.beam import expanded
from dgorl.expansion.hypotheses import Cluster, groups_of
from dgorl.expansion.join import Agreement, joined_parts, joined_whole
from dgorl.expansion.parts import ENOUGH, Parts
from dgorl.expansion.step import WHOLE, Step
from dgorl.formation import contacts
from dgorl.history import History
from dgorl.marginal import excerpt
from dgorl.stages import FORMATION, stage
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component


@dataclass(frozen=True)
class _Set:
    """What is expanded together: its components, or excerpts, by number; the stamp of the first reading [s]."""

    linked: Sequence[int]
    components: Sequence[Component]
    first: float
    before: Cluster | None


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
    with stage(FORMATION):
        sets = list(_sets(step, previous, components, members))
    found: list[tuple[_Set, Agreement]] = []
    for each in sets:
        try:
            cluster = expanded(step, each.before, each.components, each.first)
        except ValueError:  # the graph leaves a pose undetermined: nothing can be said of these
            continue
        found.append((each, Agreement(cluster, [pair for pair in cluster.sure if not doubted & set(pair)])))
    groups = groups_of([pair for _, agreement in found for pair in agreement.pairs], members)
    done: set[int] = set()
    joined: list[Component] = []
    for group in groups:
        mine = [both for both in found if any(members[a] in group for a, _ in both[1].pairs)]
        try:
            joined.append(_merged(step, mine, group, components, boundary))
        except ValueError:
            continue
        done |= group
    clusters = [
        agreement.cluster
        for each, agreement in found
        if len(set(each.linked) - done) + sum(bool(group & set(each.linked)) for group in groups) > 1
    ]
    return [*(component for k, component in enumerate(components) if k not in done), *joined], clusters


def _merged(
    step: Step,
    found: Sequence[tuple[_Set, Agreement]],
    group: set[int],
    components: Sequence[Component],
    boundary: float,
) -> Component:
    """The components of a group as one. Raises ValueError when a pose is left undetermined."""
    mine = {k: components[k] for k in sorted(group)}
    if len(found) == 1:
        ((each, agreement),) = found
        if all(any(component is whole for whole in each.components) for component in mine.values()):
            return joined_whole(step, agreement.cluster, list(mine.values()), boundary)
    return joined_parts(step, [agreement for _, agreement in found], mine, boundary)


def _sets(
    step: Step, previous: Sequence[Cluster], components: Sequence[Component], members: Mapping[TrackKey, int]
) -> Iterator[_Set]:
    """Sets of two or more components that readings link, large ones in parts.

    Readings count where the graph has poses of both ends. Those of a robot's earlier epoch may all be older: then it is
    no part of the set, as nothing would determine it, nor anybody with it.
    """
    reach = _reach(step.since, previous, components)
    horizon = step.history.horizon(step.g)
    waiting = _linked(step, members, reach, horizon)
    while waiting:
        linked, first = waiting.pop(0)
        mine = [components[k] for k in linked]
        if sum(len(component.tracks) for component in mine) > WHOLE:
            yield from _parts(step, previous, components, linked, reach)
            continue
        before = _before(previous, mine)
        base = -inf if before is None else before.base / KEYFRAMES_PER_SECOND
        if first < base:
            waiting += _linked(step, {key: k for key, k in members.items() if k in linked}, reach, base)
        else:
            yield _Set(linked, mine, first, before)


def _parts(
    step: Step,
    previous: Sequence[Cluster],
    components: Sequence[Component],
    linked: Sequence[int],
    reach: Mapping[TrackKey, float],
) -> Iterator[_Set]:
    """The parts of a large set."""
    home = {key: k for k in linked for key in components[k].tracks}
    horizon = step.history.horizon(step.g)
    heard = {
        (a, b): contact.readings
        for (a, b), contact in contacts(step.history, horizon, step.g, reach).items()
        if a in home and b in home and home[a] != home[b]
    }

    def largest(tracks: set[TrackKey], low: float) -> tuple[list[int], float] | None:
        sets = _linked(step, {key: home[key] for key in sorted(tracks)}, reach, low)
        return max(sets, key=lambda found: (len(found[0]), -found[0][0]), default=None)

    def stands(cluster: Cluster, tracks: set[TrackKey]) -> set[TrackKey]:
        found = largest(tracks, max(horizon, cluster.base / KEYFRAMES_PER_SECOND))
        return set() if found is None else {key for key in tracks if home[key] in found[0]}

    for part, before in Parts(components, linked, heard).chosen(previous, step.index, stands):
        low = horizon if before is None else max(horizon, before.base / KEYFRAMES_PER_SECOND)
        found = largest({key for keys in part.values() for key in keys}, low)
        if found is not None:
            yield _Set(found[0], [excerpt(components[k], part[k]) for k in found[0]], found[1], before)


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
