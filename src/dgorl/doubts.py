"""Who lies, where no optimum of the whole team can be trusted: the team is placed anew without each of its members.

METHOD §4, break: the robot goes whose removal makes the others fit. A lie from the start bends all that is joined, its
past and its hypotheses, so that tests of one window blame the wrong ones. Without a world nothing but readings holds
the team together: the others are found as if the liar had never been there, and take the place of what it bent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp

from dgorl.consistency import CLIP, chi2_limit, recent_squares
from dgorl.contradictions import OUTLIERS
from dgorl.expansion.beam import expanded
from dgorl.expansion.hypotheses import CERTAIN, Cluster
from dgorl.expansion.step import SPACING, WHOLE, Step
from dgorl.history import History
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component, alone, assemble

FEWEST = 4
"""Without one of fewer members the others always fit."""

TRIED = 5
"""So many members, those that fit worst, are tried."""

MEMORY, LONGEST, SHORTEST = 30.0, 60.0, 5.0
"""The others are placed by what was measured in this last time [s]; in a doubt that lasts it becomes more, up to so
much, and is never less."""

PAUSE = 60.0
"""When nobody's absence helps, it is tried again after this [s]: lacking lines of sight are a reason that stays."""

WELL = 0.05
"""The others fit well when chance makes honest readings fit worse than theirs as often as this."""

EXCESS = OUTLIERS * CLIP + 1 - OUTLIERS
"""A liar's readings account for more than this, squared residuals each; less may have had no line of sight."""


@dataclass(frozen=True)
class Doubt:
    """At ``stamp`` [s] a set of tracks does not fit; without: who may be why, and the others placed without it.

    base: all by what was measured since then [s]: only so are their masses comparable.
    liar: the one of whom that is certain, and for how many nodes in a row; others that it has not bent have no cluster.
    """

    stamp: float
    tracks: frozenset[TrackKey]
    without: Mapping[TrackKey, Cluster]
    base: float
    liar: TrackKey | None = None
    nodes: int = 0

    @property
    def others(self) -> Component | None:
        """What the others are without the liar, when that is certain too."""
        if self.liar is None or self.liar not in self.without:
            return None
        best = self.without[self.liar].hypotheses[0]
        return best.component if best.probability >= CERTAIN else None


def doubt_about(
    history: History,
    whole: Component,
    joined: Sequence[Component],
    since: Mapping[TrackKey, float],
    g: float,
    before: Doubt | None,
) -> Doubt | None:
    """Who is why ``whole``, a component or the best hypothesis of a cluster, does not fit at node g [s].

    joined: the components. since: from when on tracks count [s]. before: what was said of these tracks last.
    """
    keys = frozenset(whole.tracks)
    if not FEWEST <= len(keys) <= WHOLE or whole.has_world:
        return None
    fit = _fit(history, whole, g)
    if fit.good:
        return None
    if before is not None and before.liar is None and not before.without and g < before.stamp + PAUSE:
        return before
    for component in joined:
        rest = frozenset(component.tracks)
        if len(keys - rest) == 1 and rest < keys and (left := _fit(history, component, g)).good:
            (liar,) = keys - rest
            return _again(Doubt(g, keys, {}, g, liar, 1), before) if left.explained_by_absence(fit) else None
    base = max(_base(before, g), *(max(key.begin, since.get(key, key.begin)) for key in keys))
    here = frozenset(key for key in keys if _end(whole, key) > base)  # an earlier epoch of a robot may have ended
    if g - base < SHORTEST or len(here) < FEWEST:
        return None
    masses: dict[TrackKey, float] = {}
    found: dict[TrackKey, Cluster] = {}
    for key in sorted(here, key=lambda key: (-fit.members[key], key))[:TRIED]:
        known = before.without.get(key) if before is not None and base == before.base else None
        cluster = _placed(history, here - {key}, since, g, base, known)
        if cluster is None:
            continue
        best = cluster.hypotheses[0]
        left = _fit(history, best.component, g)
        if left.good:
            masses[key] = best.mass + _count(history, best.component, base, g) / 2
            if left.explained_by_absence(fit):
                found[key] = cluster
    best_mass = max(masses.values(), default=0.0)
    certain = sum(exp(mass - best_mass) for mass in masses.values()) <= 1 / CERTAIN
    liars = [key for key in found if certain and masses[key] >= best_mass]
    return _again(Doubt(g, keys, found, base, liars[0], 1), before) if liars else Doubt(g, keys, found, base)


def _end(whole: Component, key: TrackKey) -> float:
    """Until when a track reaches [s]."""
    stretch = whole.stretches[key]
    return (stretch.first + len(stretch.poses) - 1) / KEYFRAMES_PER_SECOND


def _again(doubt: Doubt, before: Doubt | None) -> Doubt:
    """The same, counted on if the node before said so too."""
    if before is None or before.liar != doubt.liar or before.stamp < doubt.stamp - SPACING:
        return doubt
    return replace(doubt, nodes=before.nodes + 1)


def _base(before: Doubt | None, g: float) -> float:
    """From when on the others are placed [s], if nobody's track begins later."""
    if before is not None and before.without and g - before.base <= LONGEST:
        return before.base
    return g - MEMORY


def _placed(
    history: History,
    rest: frozenset[TrackKey],
    since: Mapping[TrackKey, float],
    g: float,
    base: float,
    known: Cluster | None,
) -> Cluster | None:
    """These tracks placed anew by what was measured since ``base`` [s], as if nothing had been joined."""
    tracks = {track.key: track for track in history.tracks if track.key in rest}
    try:
        singles = [alone(track, base, g) for _, track in sorted(tracks.items())]
        return expanded(Step(history, tracks, g, since), known, singles, base, sweeps=1)
    except ValueError:  # the graph leaves a pose undetermined
        return None


@dataclass(frozen=True)
class _Fit:
    """Clipped squared residuals of the last 5 s: sum, count, each member's mean."""

    total: float
    count: int
    members: Mapping[TrackKey, float]

    @property
    def good(self) -> bool:
        return self.total <= chi2_limit(max(self.count, 1))

    def explained_by_absence(self, whole: _Fit) -> bool:
        """Whether this fits well, and what ``whole`` has beyond it is more than readings without line of sight."""
        if not 0 < self.count < whole.count or self.total > chi2_limit(self.count, WELL):
            return False
        return whole.total - self.total > EXCESS * (whole.count - self.count)


def _fit(history: History, component: Component, g: float) -> _Fit:
    """How a component fits where it stands."""
    window = assemble(history, Component(component.stretches), g - SPACING, g, None)
    i, j, square = recent_squares(window, window.problem.initial, g)
    mine = {key: square[(i == k) | (j == k)] for k, key in enumerate(window.layout)}
    means = {key: float(squares.mean()) if len(squares) else 0.0 for key, squares in mine.items()}
    return _Fit(float(square.sum()), len(square), means)


def _count(history: History, component: Component, base: float, g: float) -> int:
    """Readings between its members since ``base`` [s]: what a good fit costs, twice."""
    window = assemble(history, Component(component.stretches), base, g, None)
    return sum(len(scalars.value) for scalars in window.problem.scalars)
