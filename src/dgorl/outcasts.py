"""The expansion of a node among members that are believed, and then with those that lied. METHOD §4, break."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dgorl.doubts import Doubt, doubt_about
from dgorl.expansion.clusters import advance
from dgorl.expansion.hypotheses import NODES, Cluster
from dgorl.expansion.step import SPACING, WHOLE
from dgorl.history import History
from dgorl.tracks import TrackKey
from dgorl.window import Component, alone

DOUBTED = 30.0
"""An outcast is inconsistent until it has fitted for so long [s]."""

Since = Mapping[TrackKey, float]


@dataclass(frozen=True)
class Placed:
    """What the expansion leaves of a node: as in Node."""

    components: Sequence[Component]
    clusters: tuple[Cluster, ...]
    doubts: tuple[Doubt, ...]
    outcasts: Since
    since: Since


@dataclass(frozen=True)
class Expansion:
    """The expansion at node g [s]; low, boundary: where its window and the next node's start [s]."""

    history: History
    g: float
    low: float
    boundary: float

    def placed(
        self,
        found: Sequence[Component],
        clusters: Sequence[Cluster],
        doubts: Sequence[Doubt],
        outcasts: Since,
        since: Since,
    ) -> Placed:
        """Of the components found settled, with the node before's clusters, doubts and outcasts.

        since: from when on a track counts that was cut off [s].
        """
        singles = {key for c in found if len(c.stretches) == 1 for key in c.tracks}
        cast = {k: at for k, at in outcasts.items() if k in singles and self.g - at < DOUBTED}
        honest = [c for c in found if not cast.keys() & set(c.tracks)]
        before = [c for c in clusters if not cast.keys() & c.tracks]
        held = frozenset(key for doubt in doubts for key in doubt.without)
        components, known = advance(self.history, before, honest, since, self.g, self.boundary, held)
        open_: list[Doubt] = []
        since = dict(since)
        for doubt in self._doubts(components, known, doubts, since):
            if doubt.liar is None or doubt.nodes < NODES:
                open_.append(doubt)
                continue
            cast[doubt.liar] = since[doubt.liar] = self.g
            if doubt.without:
                components, known = self._dissolved(doubt, components, known, since)
            components = [c for c in components if doubt.liar not in c.tracks]
            known = [c for c in known if doubt.liar not in c.tracks]
        if cast:
            components, known = self._with_outcasts(components, known, clusters, cast, since)
        return Placed(components, tuple(known), tuple(open_), cast, since)

    def _doubts(
        self, components: Sequence[Component], clusters: Sequence[Cluster], before: Sequence[Doubt], since: Since
    ) -> list[Doubt]:
        """Of what readings link, joined or not; of a large team in parts each is asked about in turn."""
        linked = [cluster.hypotheses[0].component for cluster in clusters]
        inside = {key for component in linked for key in component.tracks}
        wholes = [*linked, *(c for c in components if not inside & set(c.tracks))]
        known = {doubt.tracks: doubt for doubt in before}
        large = sum(len(whole.tracks) for whole in wholes) > WHOLE
        turn = int(self.g // SPACING) % len(wholes) if large else 0
        found = []
        for k, whole in enumerate(wholes):
            last = known.get(frozenset(whole.tracks))
            if large and k != turn and (last is None or not last.without):
                found += [last] if last is not None else []
                continue
            doubt = doubt_about(self.history, whole, components, since, self.g, last)
            found += [doubt] if doubt is not None else []
        return found

    def _dissolved(
        self, doubt: Doubt, components: Sequence[Component], clusters: Sequence[Cluster], since: Since
    ) -> tuple[list[Component], list[Cluster]]:
        """The same with the others as they were placed without the liar, not as it had bent them."""
        assert doubt.liar is not None
        rest = [self._alone(key, since) for key in sorted(doubt.tracks - {doubt.liar})]
        rival = [doubt.without[doubt.liar]]
        joined, known = advance(self.history, rival, rest, since, self.g, self.boundary)
        kept = [c for c in components if not doubt.tracks & set(c.tracks)]
        return [*kept, *joined], [*(c for c in clusters if not doubt.tracks & c.tracks), *known]

    def _with_outcasts(
        self,
        components: Sequence[Component],
        clusters: Sequence[Cluster],
        before: Sequence[Cluster],
        cast: dict[TrackKey, float],
        since: Since,
    ) -> tuple[list[Component], list[Cluster]]:
        """Where the outcasts are, as seen by the others, once these are known; joined to nobody.

        cast: when each last did not fit [s], brought up to date.
        """
        alone_ = [self._alone(key, since) for key in sorted(cast)]
        everybody = [*components, *alone_]
        seen: list[Cluster] = []
        if not clusters:
            last = [c for c in before if cast.keys() & c.tracks]
            nobody = frozenset(key for c in everybody for key in c.tracks)
            _, seen = advance(self.history, last, everybody, since, self.g, self.boundary, nobody)
        fitting = {key for cluster in seen for key in cluster.tracks - cluster.unfit.keys()}
        cast.update({key: self.g for key in cast if key not in fitting})
        return everybody, [*clusters, *seen]

    def _alone(self, key: TrackKey, since: Since) -> Component:
        track = next(t for t in self.history.tracks if t.key == key)
        return alone(track, max(self.low, since.get(key, self.low)), self.g)
