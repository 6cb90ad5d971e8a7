"""The bundles of one epoch of one robot that are kept to be passed on."""

from __future__ import annotations

from dataclasses import dataclass

from dgorl.team.bundles import Sealed
from dgorl.team.ranges import Ranges

BYTES = 4_000_000
"""An epoch keeps at most this much [bytes] ..."""

COUNT = 4096
"""... and at most so many bundles."""

SET_BACK = 2.0
"""So much [s] a robot's clock may be set back while its program does not run."""


@dataclass(slots=True)
class _Kept:
    data: bytes
    cut: float
    sent: float


class Shelf:
    """``had``: the numbers that need not come again; ``kept``: those that can be passed on.

    retention: bundles cut this much [s] before the newest are let go; both cuts are on their origin's clock.
    """

    def __init__(self, retention: float) -> None:
        self.had, self.kept = Ranges(), Ranges()
        self.newest = -float("inf")
        """cut of the newest bundle [s], its origin's clock"""
        self.changed = -float("inf")
        """when the last one came [s], local clock"""
        self.last: bytes | None = None
        """the one of the largest number, kept when all others are let go: it proves that there was this epoch"""
        self._last_cut = -float("inf")
        self._retention = retention
        self._bundles: dict[int, _Kept] = {}
        self._bytes = 0

    def add(self, sealed: Sealed, now: float) -> bool:
        """Keep a bundle; False if it was here before."""
        number = sealed.bundle.sequence
        if number in self.had:
            return False
        if number > self.had.high:
            self.last, self._last_cut = sealed.data, sealed.bundle.cut
        self.had.add(number)
        self.changed = max(self.changed, now)
        self.newest = max(self.newest, sealed.bundle.cut)
        self.kept.add(number)
        self._bundles[number] = _Kept(sealed.data, sealed.bundle.cut, -float("inf"))
        self._bytes += len(sealed.data)
        while self.kept and (
            self._bundles[self.kept.low].cut < self.newest - self._retention
            or self._bytes > BYTES
            or len(self._bundles) > COUNT
        ):
            self._let_go(self.kept.low)
        return True

    def contradicted(self, number: int, cut: float) -> bool:
        """Whether numbers and cuts [s] do not rise together: of one life of an epoch they do."""
        later, earlier = cut > self.newest + SET_BACK, cut < self._last_cut - SET_BACK
        return (number < self.had.high and later) or (number > self.had.high and earlier)

    def data(self, number: int) -> bytes | None:
        """The sealed bytes, if they are kept."""
        kept = self._bundles.get(number)
        return kept.data if kept else None

    def sent(self, number: int) -> float:
        """When it was last sent from here [s]."""
        return self._bundles[number].sent

    def mark_sent(self, number: int, now: float) -> None:
        """It is sent from here at ``now`` [s]."""
        self._bundles[number].sent = now

    def clear(self) -> None:
        """Keep none; all that was here need not come again."""
        while self.kept:
            self._let_go(self.kept.low)

    def _let_go(self, number: int) -> None:
        self._bytes -= len(self._bundles.pop(number).data)
        self.kept.drop_below(number + 1)
        self.had.add(0, number)
