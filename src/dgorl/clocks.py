"""The clocks of a team: which is the reference, and where every other stands on it. METHOD §1, "Clocks".

``Clocks`` is a memo of a pure function: equal readings give equal maps, bit for bit, in whatever order they came. A
first chain of nodes takes the own clock for the reference; it tells who can be placed and who began first. The second
chain, which counts, takes the oldest clock.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from math import floor, inf

from dgorl.clock_lines import Pair, pair_point
from dgorl.clock_nodes import LAG, MEMORY, ClockNode, Pairs, Placed, following
from dgorl.expansion.step import SPACING
from dgorl.measurements import LARGEST, ClockKey, ClockReading

COEVAL = 7.3
"""Of clocks that began within this time [s] of the oldest, the first by name is the reference."""

WAITING = 20_000
"""So many readings between clocks not yet placed are kept, the newest."""

JUMP = 0.05
"""A wall clock that moves farther [s] than this between two looks has jumped."""

Piece = tuple[float, Placed]
"""A map and its node's stamp [s]."""


class SteadyClock:
    """The wall clock as it was at the start, carried on by a monotonic one: a local clock that never jumps.

    wall, monotonic: both clocks, read together [s]. ``jumps`` counts the wall clock's, ``difference`` is wall − steady.
    """

    def __init__(self, wall: float, monotonic: float) -> None:
        self._anchor = wall - monotonic
        self.difference = 0.0
        self.jumps = 0

    def now(self, monotonic: float) -> float:
        """The steady time [s]."""
        return self._anchor + monotonic

    def look(self, wall: float, monotonic: float) -> float:
        """Compare the clocks; by how much the wall clock jumped since the last look [s], 0 if it did not."""
        difference = wall - self.now(monotonic)
        step, self.difference = difference - self.difference, difference
        if abs(step) <= JUMP:
            return 0.0
        self.jumps += 1
        return step

    def steady(self, wall_stamp: float) -> float:
        """A stamp of the wall clock as it runs now, on the steady one [s]."""
        return wall_stamp - self.difference


class Chain:
    """The nodes of one choice of reference, computed when asked for and forgotten when their readings change."""

    def __init__(self, reference: ClockKey) -> None:
        self.reference = reference
        own = Placed(-LARGEST, SPACING - LARGEST, 0.0, 0.0, 0.0, -inf, -inf)
        self._nodes = [ClockNode(-LARGEST, {reference: own})]
        self.pieces: dict[ClockKey, list[Piece]] = {}
        self._latest: dict[ClockKey, float] = {}
        self._leaps: list[int] = []

    def invalidate(self, stamps: Sequence[tuple[ClockKey, float]]) -> None:
        """Forget the nodes that a reading with these stamps changes; the first one stays."""
        nodes = self._nodes
        if any(stamp <= self._latest.get(key, -inf) for key, stamp in stamps):
            keep = next((k for k, node in enumerate(nodes) if node.knows(stamps)), len(nodes))
            del nodes[max(keep, 1) :]
        for k in self._leaps:
            if k < len(nodes) and nodes[k - 1].tells(stamps, nodes[k].stamp):
                del nodes[k:]

    def advance(self, g: float, pairs: Pairs) -> None:
        """Compute all nodes up to ``g`` [s]."""
        node: ClockNode | None = self._nodes[-1]
        while node is not None:
            node = following(node, pairs, g)
            self._nodes += [node] if node is not None else []
        self.pieces, self._latest = {}, {}
        stamps = [known.stamp for known in self._nodes]
        self._leaps = [k for k, (a, b) in enumerate(pairwise(stamps), 1) if b > a + SPACING]
        for node in self._nodes:
            for key, seen in node.seen.items():
                self._latest[key] = max(seen.latest, self._latest.get(key, -inf))
            for key, placed in node.placed.items():
                self.pieces.setdefault(key, []).append((node.stamp, placed))

    def team(self, key: ClockKey, local: float) -> float | None:
        """Team time of a local stamp [s]; None if the clock is not placed."""
        pieces = self.pieces.get(key)
        if not pieces:
            return None
        k = len(pieces) - 1
        while k > 0 and local <= (pieces[k][1].begin if pieces[k][1].since == -inf else pieces[k][1].since):
            k -= 1
        g, placed = pieces[k]
        return placed.team(g, local)

    def local(self, key: ClockKey, team: float) -> float | None:
        """What a clock shows at a team time [s]; None if it is not placed."""
        pieces = self.pieces.get(key)
        if not pieces:
            return None
        g, placed = pieces[max(bisect_right(pieces, team, key=lambda piece: piece[0]) - 1, 0)]
        return placed.local(g, team)

    def forget(self, before: float) -> None:
        """Drop nodes older than ``before`` [s], but the newest of them."""
        old = bisect_right(self._nodes, before, key=lambda node: node.stamp) - 1
        if old > 0:
            del self._nodes[:old]


class Clocks:
    """The maps as one robot knows them; ``home``: its own clock.

    history: readings later than this are too late [s].
    """

    def __init__(self, home: ClockKey, history: float) -> None:
        self.home = home
        self.rejected: Counter[str] = Counter()
        self._history = history
        self._inbox: dict[ClockReading, None] = {}
        self._pairs: dict[ClockKey, dict[ClockKey, Pair]] = {}
        self._births: dict[ClockKey, float] = {}
        self._own = self.chain = Chain(home)
        self._last = -inf
        self._last_own = -inf

    def add(self, reading: ClockReading) -> None:
        """Take a reading, in any order, twice without harm."""
        self._inbox[reading] = None

    def add_birth(self, clock: ClockKey, stamp: float) -> None:
        """Say when a clock began, on that clock [s]; unsaid, it is when it was first read."""
        self._births[clock] = min(stamp, self._births.get(clock, inf))

    def advance(self, local: float) -> bool:
        """Admit what is known when the own clock shows ``local`` [s], and bring the maps up to then; whether they may
        have changed."""
        own, team = _node(local), _node(self.chain.team(self.home, local))
        if own <= self._last_own and team <= self._last:
            return False
        self._own.advance(own, self._pairs)
        while self._admit(local):
            self._own.advance(own, self._pairs)
        self._choose(local)
        self._last_own, self._last = own, _node(self.chain.team(self.home, local))
        self._forget(local)
        return True

    def _admit(self, local: float) -> bool:
        """Admit the readings known by now of which one clock at least is placed; whether there were any."""
        waiting: dict[ClockReading, None] = {}
        admitted = False
        for reading in self._inbox:
            a, b, point, sent_by_a = pair_point(reading)
            stamps = ((a, point[0]), (b, point[1]))
            times = [time for key, stamp in stamps if (time := self._own.team(key, stamp)) is not None]
            if not times or min(times) > local:
                waiting[reading] = None
            elif max(times) < local - self._history:
                self.rejected["clock reading too late"] += 1
            else:
                pair = self._pairs.setdefault(a, {}).setdefault(b, Pair())
                self._pairs.setdefault(b, {})[a] = pair
                if pair.add(point, sent_by_a):
                    admitted = True
                    for key, stamp in stamps:
                        self.add_birth(key, stamp)
                    for chain in (self._own, self.chain):
                        chain.invalidate(stamps)
        self._inbox = dict(list(waiting.items())[-WAITING:])
        return admitted

    def _choose(self, local: float) -> None:
        """Take the chain of the oldest clock that places us."""
        first = {key: pieces[-1][1] for key, pieces in self._own.pieces.items()}
        births = {
            key: placed.entered + self._births.get(key, placed.shown) - placed.shown for key, placed in first.items()
        }
        births[self.home] = self._births.get(self.home, local)
        eldest = min(births.values())
        for key in sorted(births, key=lambda key: (max(births[key], eldest + COEVAL), key)):
            chain = self._own if key == self.home else self.chain if key == self.chain.reference else Chain(key)
            if chain is not self._own:
                team = self.chain.team(self.home, local) if chain is self.chain else self._own.local(key, local)
                chain.advance(_node(team), self._pairs)
            if self.home in chain.pieces:
                self.chain = chain
                return

    def _forget(self, local: float) -> None:
        """Drop readings and nodes that nothing admitted from now on asks for."""
        before = local - self._history - LAG - MEMORY - 3 * SPACING
        for a, others in self._pairs.items():
            for b, pair in others.items():
                for axis, key in enumerate((a, b)):
                    stamp = self._own.local(key, before)
                    if a < b and stamp is not None:
                        pair.forget(stamp, axis)
                        break
        self._own.forget(before)
        if self.chain is not self._own:
            team = self.chain.team(self.home, before)
            self.chain.forget(-inf if team is None else team)


def _node(time: float | None) -> float:
    """The node that serves a time [s]."""
    return -inf if time is None else floor(time / SPACING) * SPACING
