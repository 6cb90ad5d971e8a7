"""Nodes of the clocks: an affine map from each clock to team time, every 5 s. METHOD §1, "Clocks".

node(g) = F(node(g − 5), readings that old): lines between pairs of clocks, and over the graph of these pairs the maps
that agree with them best. A map serves the stamps from g to g + 5 and begins where the last one ended, so that team
time never jumps; it ends on the estimate. Team time is the reference's clock; where the reference is out of reach,
whoever has been there longest carries it on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import floor, hypot, inf, sqrt
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from dgorl.clock_lines import WANDER, Line, Pair, fitted
from dgorl.expansion.step import SPACING
from dgorl.measurements import LARGEST, ClockKey

LAG = 10.0
"""A map uses readings this much older than it [s], so that late ones cost no rewind ..."""

ENTRY_LAG = 2.0
"""... but those of a clock's first seconds this late [s], so that it enters soon."""

MEMORY = 120.0
"""Readings older than this [s] say nothing of a clock now."""

ENTRY_SIGMA = 0.02
"""A clock enters when it is placed as well as this [s]."""

BENT = (0.5, 2.0)
"""A map's rate while it is led to the estimate; beyond, the clock jumped and its map begins anew."""

Pairs = Mapping[ClockKey, Mapping[ClockKey, Pair]]
"""Readings by clock a and clock b > a, under both names."""


Drawn = tuple[tuple[ClockKey, ClockKey], Line]
"""The line of clock b over clock a, under (a, b)."""


class Placed(NamedTuple):
    """A clock's map at one node g: it shows ``begin`` at g and ``end`` at g + 5 [s].

    drift: estimated team time per own time − 1; sigma of the end [s] and of the drift [s/s]. entered: the node at which
    the clock came in [s], and what it showed then. since: what it showed first after it jumped, if it did.
    """

    begin: float
    end: float
    drift: float
    sigma: float
    sigma_drift: float
    entered: float
    shown: float
    since: float = -inf

    def team(self, g: float, local: float) -> float:
        """Team time of a local stamp [s]."""
        return local + (g - self.begin) + (SPACING / (self.end - self.begin) - 1.0) * (local - self.begin)

    def local(self, g: float, team: float) -> float:
        """What the clock shows at a team time, from g + 5 on by its estimated drift [s]."""
        if team > g + SPACING:
            return self.end + (team - g - SPACING) / (1.0 + self.drift)
        return self.begin + (team - g) * ((self.end - self.begin) / SPACING)


class Seen(NamedTuple):
    """A clock before its node is solved: what it shows at g + 5 (``at``), its rate, σ of both, its cut in team time.

    known: whether it was placed before.
    """

    at: float
    drift: float
    sigma: float
    sigma_drift: float
    cut: float
    known: bool

    def local(self, until: float) -> float:
        """What the clock shows ``until`` s before g + 5."""
        return self.at - until / (1.0 + self.drift)

    @property
    def latest(self) -> float:
        """Nothing stamped later on this clock is looked at."""
        return self.local(SPACING + ENTRY_LAG)


@dataclass(frozen=True)
class ClockNode:
    """All maps at ``stamp`` [s]; seen: the clocks whose readings were looked at, placed or not."""

    stamp: float
    placed: Mapping[ClockKey, Placed]
    seen: Mapping[ClockKey, Seen] = field(default_factory=lambda: MappingProxyType({}))

    def knows(self, stamps: Iterable[tuple[ClockKey, float]]) -> bool:
        """Whether a reading with these stamps can have had a part in this node."""
        both = [(seen, stamp) for key, stamp in stamps if (seen := self.seen.get(key)) is not None]
        end = self.stamp + SPACING
        if len(both) == 2 and all(seen.known for seen, _ in both):
            cut = max(seen.cut for seen, _ in both)
            return any(stamp <= seen.local(end - cut) for seen, stamp in both)
        return any(stamp <= seen.latest for seen, stamp in both)

    def tells(self, stamps: Iterable[tuple[ClockKey, float]], g: float) -> bool:
        """Whether a reading with these stamps was made before ``g`` [s]: there is a node before it then."""
        times = [placed.team(self.stamp, t) for key, t in stamps if (placed := self.placed.get(key)) is not None]
        return any(time < g for time in times)


def following(node: ClockNode, pairs: Pairs, until: float) -> ClockNode | None:
    """The next node at which there is anything to tell, None if none is up to ``until`` [s]."""
    earliest = inf
    for key, placed in node.placed.items():
        low = placed.local(node.stamp, node.stamp - LAG - MEMORY)
        for other, pair in pairs.get(key, {}).items():
            if earliest < node.stamp:
                break
            if key < other or other not in node.placed:
                earliest = min(earliest, placed.team(node.stamp, pair.next(low, 0 if key < other else 1)))
    if until < node.stamp + SPACING or earliest == inf:
        return None
    g = max(floor(min(earliest, until) / SPACING) * SPACING, node.stamp + SPACING)
    return _advanced(node, pairs, g) if g <= until else None


def _advanced(node: ClockNode, pairs: Pairs, g: float) -> ClockNode:
    guesses = {key: _predicted(placed, node.stamp, g) for key, placed in node.placed.items()}
    _reach(guesses, pairs, g)
    lines: dict[tuple[ClockKey, ClockKey], Line] = {}
    for a in sorted(guesses):
        for b in sorted(other for other in pairs.get(a, {}) if a < other and other in guesses):
            line = _line(pairs[a][b], guesses[a], guesses[b], g)
            if line is not None:
                lines[a, b] = line
    placed = {}
    for part in _parts(guesses, lines):
        placed.update(_solved(part, guesses, lines, node, g))
    return ClockNode(g, placed, guesses)


def _predicted(placed: Placed, before: float, g: float) -> Seen:
    ahead = g - before
    sigma = placed.sigma + ahead * placed.sigma_drift  # not independent: each node errs as the last one did
    cut = max(g - LAG, placed.entered - ENTRY_LAG)
    return Seen(placed.local(before, g + SPACING), placed.drift, sigma, placed.sigma_drift, cut, True)


def _reach(guesses: dict[ClockKey, Seen], pairs: Pairs, g: float) -> None:
    """Add the clocks that are linked with those known by readings both ways, one after another."""
    waiting = sorted(guesses)
    for key in waiting:
        late = guesses[key].latest
        early = late - MEMORY
        for other in sorted(pairs.get(key, {})):
            if other in guesses:
                continue
            pair, axis = pairs[key][other], 0 if key < other else 1
            points = [[p for p in some if early < p[axis] <= late] for some in (pair.there, pair.back)]
            if all(points):
                newest = max((p[axis], p[1 - axis]) for some in points for p in some)
                guesses[other] = Seen(newest[1] + guesses[key].at - newest[0], 0.0, inf, inf, g - ENTRY_LAG, False)
                waiting.append(other)


def _line(pair: Pair, a: Seen, b: Seen, g: float) -> Line | None:
    cut = g + SPACING - max(a.cut, b.cut)
    there, back = pair.between(a.local(cut + MEMORY), a.local(cut), b.local(cut))
    return fitted(there, back, a.at, b.at)


def _parts(keys: Iterable[ClockKey], links: Iterable[tuple[ClockKey, ClockKey]]) -> list[list[ClockKey]]:
    """Connected parts of a graph, sorted."""
    part = {key: [key] for key in keys}
    for a, b in links:
        if part[a] is not part[b]:
            part[a].extend(part[b])
            for key in part[b]:
                part[key] = part[a]
    return sorted({id(some): sorted(some) for some in part.values()}.values())


def _solved(
    part: list[ClockKey],
    guesses: Mapping[ClockKey, Seen],
    lines: Mapping[tuple[ClockKey, ClockKey], Line],
    node: ClockNode,
    g: float,
) -> dict[ClockKey, Placed]:
    """The maps of connected clocks. Least squares over their lines; whoever entered first is carried on."""
    members = [key for key in part if key in node.placed]
    if not members:
        return {}
    pinned = min(members, key=lambda key: (node.placed[key].entered, key))
    others = {key: 2 * k for k, key in enumerate(key for key in part if key != pinned)}
    own = [((a, b), line) for (a, b), line in lines.items() if a in guesses and a in part and b in part]
    solution, covariance = _least_squares(others, pinned, guesses[pinned].drift, own)
    found = {pinned: _carried(guesses[pinned], node, pinned, g)}
    for key, k in others.items():
        error, drift = float(solution[k]), float(solution[k + 1])
        sigma = hypot(sqrt(covariance[k, k]), guesses[pinned].sigma)
        guess = guesses[key]
        if key not in node.placed:
            if sigma < ENTRY_SIGMA:
                end = guess.at - error / (1.0 + drift)
                begin = end - SPACING / (1.0 + drift)
                found[key] = Placed(begin, end, drift, sigma, sqrt(covariance[k + 1, k + 1]), g, begin)
        elif sigma > guess.sigma and abs(error) <= 3.0 * (sigma + guess.sigma):  # it was known better before
            found[key] = _carried(guess, node, key, g)
        else:
            end = guess.at - error / (1.0 + drift)
            found[key] = _led(
                node, key, g, end, drift, sigma, sqrt(covariance[k + 1, k + 1]), _since(key, own, guesses)
            )
    return found


def _least_squares(
    others: Mapping[ClockKey, int],
    pinned: ClockKey,
    pinned_drift: float,
    lines: Iterable[Drawn],
) -> tuple[np.ndarray, np.ndarray]:
    """Error at its origin and drift of every clock but the pinned one, (2 n,), and their covariance.

    A line b = a + o + r a between clocks of errors θ and drifts ρ: θ_a − θ_b = o (1 + ρ_b), ρ_a − (1 + r) ρ_b = r.
    """
    size = 2 * len(others)
    information, vector = np.zeros((size, size)), np.zeros(size)
    for (a, b), line in lines:
        jacobian, target = np.zeros((2, size)), np.array([line.offset, line.drift])
        for key, block in (
            (a, np.eye(2)),
            (b, -np.array([[1.0, line.offset], [0.0, 1.0 + line.drift]])),
        ):
            if key == pinned:
                target -= block[:, 1] * pinned_drift
            else:
                jacobian[:, others[key] : others[key] + 2] = block
        oo, od, dd = line.covariance
        weight = np.linalg.inv(np.array([[oo, od], [od, dd]]))
        information += jacobian.T @ weight @ jacobian
        vector += jacobian.T @ weight @ target
    covariance = np.linalg.inv(information) if size else information
    return covariance @ vector, covariance


def _since(
    key: ClockKey, lines: Iterable[tuple[tuple[ClockKey, ClockKey], Line]], seen: Mapping[ClockKey, Seen]
) -> float:
    """What a clock showed first after it jumped, as its lines say."""
    stamps = [-inf]
    for (a, b), line in lines:
        if key == a:
            stamps.append(seen[a].at + line.since)
        elif key == b and line.since > -inf:
            stamps.append(seen[b].at + line.offset + (1.0 + line.drift) * line.since)
    return max(stamps)


def _carried(guess: Seen, node: ClockNode, key: ClockKey, g: float) -> Placed:
    sigma_drift = guess.sigma_drift if node.placed[key].entered == -inf else hypot(guess.sigma_drift, WANDER)
    return _led(node, key, g, guess.at, guess.drift, guess.sigma, sigma_drift)


def _led(
    node: ClockNode,
    key: ClockKey,
    g: float,
    end: float,
    drift: float,
    sigma: float,
    sigma_drift: float,
    since: float = -inf,
) -> Placed:
    """The map that goes on where the last one ended, to ``end`` at g + 5; a new one where that is too far off."""
    before = node.placed[key]
    begin = before.local(node.stamp, g)
    if BENT[0] * SPACING <= end - begin <= BENT[1] * SPACING:
        return Placed(begin, end, drift, sigma, sigma_drift, before.entered, before.shown)
    begin = end - SPACING / (1.0 + drift)
    return Placed(begin, end, drift, sigma, sigma_drift, before.entered, before.shown, max(since, -LARGEST))
