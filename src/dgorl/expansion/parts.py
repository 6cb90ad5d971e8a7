"""Large teams in parts: which tracks of a large set are expanded together. METHOD §6.

What a search costs grows with the cube of the tracks in its graph. A set of more than ``WHOLE`` is expanded in parts
of at most ``LARGEST``, chosen by who heard whom most; a joined component takes part by the tracks that the others hear
best. Parts that are joined become components, which the next nodes join in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from dgorl.expansion.hypotheses import Cluster
from dgorl.expansion.step import LARGEST
from dgorl.tracks import TrackKey
from dgorl.window import Component

EXCERPT = 6
"""Tracks by which a joined component takes part."""

ENOUGH = 4
"""Readings between two components from which on they are expanded."""

PATIENCE = 6
"""Nodes after which a part that is not joined is formed anew: others may tell it more by now."""

Heard = Mapping[tuple[TrackKey, TrackKey], int]
"""Readings between tracks of different components, by pair, first track first."""

Chosen = dict[int, set[TrackKey]]
"""The tracks of a part by component."""


@dataclass
class Parts:
    """Parts of one large set under construction; components: all, of which ``linked`` are in the set."""

    components: Sequence[Component]
    linked: Collection[int]
    heard: Heard

    def __post_init__(self) -> None:
        self._home = {key: k for k in self.linked for key in self.components[k].tracks}
        self._readings: dict[tuple[int, int], int] = {}
        for (a, b), count in self.heard.items():
            pair = _ordered(self._home[a], self._home[b])
            self._readings[pair] = self._readings.get(pair, 0) + count
        self._taken: set[int] = set()
        self._part_of = {k: {k} for k in self.linked}
        """the components that parts connect with one"""

    def chosen(self, previous: Sequence[Cluster], node: int, stands: Callable[[Cluster, set[TrackKey]], set[TrackKey]]
               ) -> Iterator[tuple[Chosen, Cluster | None]]:  # fmt: skip
        """Every part and the cluster it was: those of the node before first, then new ones, most readings first.

        node: number of the node. stands: which of a cluster's tracks readings still link.
        """
        begun: list[tuple[Chosen, Cluster | None]] = []
        for cluster in previous:
            if node - cluster.begun < PATIENCE and len(cluster.tracks) <= LARGEST:
                part = self._by_component(stands(cluster, {key for key in cluster.tracks if key in self._home}))
                if len(part) > 1 and not self._taken & part.keys():
                    self._take(part)
                    begun.append((part, cluster))
        for part, _ in begun:
            self._grow(part)
        yield from begun
        for (a, b), count in sorted(self._readings.items(), key=lambda item: (-item[1], item[0])):
            if count < ENOUGH or self._taken & {a, b} or b in self._part_of[a]:
                continue
            part = {a: self._excerpt(a, {b}), b: self._excerpt(b, {a})}
            self._take(part)
            self._grow(part)
            yield part, None

    def _by_component(self, tracks: Collection[TrackKey]) -> Chosen:
        part: Chosen = {}
        for key in sorted(tracks):
            part.setdefault(self._home[key], set()).add(key)
        return part

    def _grow(self, part: Chosen) -> None:
        """Add the components that the part hears most, while there is room."""
        while True:
            room = LARGEST - sum(len(keys) for keys in part.values())
            tracks = {key for keys in part.values() for key in keys}
            linked: dict[int, int] = {}
            for (a, b), count in self.heard.items():
                if (a in tracks) != (b in tracks):
                    other = self._home[b if a in tracks else a]
                    linked[other] = linked.get(other, 0) + count
            able = [
                k
                for k, count in linked.items()
                if count >= ENOUGH and k not in part and k not in self._taken and min(self._size(k), EXCERPT) <= room
                and not self._part_of[k] & part.keys()
                and any(self._readings.get(_ordered(k, other), 0) >= ENOUGH for other in part)
            ]  # fmt: skip
            if not able:
                return
            best = max(able, key=lambda k: (linked[k], -k))
            part[best] = self._excerpt(best, part.keys())
            self._take(part)

    def _size(self, k: int) -> int:
        return len(self.components[k].tracks)

    def _take(self, part: Chosen) -> None:
        """Nobody alone is in two parts; what a part connects needs no other one."""
        self._taken |= {k for k in part if self._size(k) == 1}
        whole = set().union(*(self._part_of[k] for k in part))
        for k in whole:
            self._part_of[k] = whole

    def _excerpt(self, k: int, others: Collection[int]) -> set[TrackKey]:
        """The tracks of a component that the others hear best."""
        counts = dict.fromkeys(self.components[k].tracks, 0)
        for (a, b), count in self.heard.items():
            for mine, other in ((a, b), (b, a)):
                if mine in counts and self._home[other] in others:
                    counts[mine] += count
        return set(sorted(counts, key=lambda key: (-counts[key], key))[:EXCERPT])


def _ordered(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)
