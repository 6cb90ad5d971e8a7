"""Readings of numbered two-way exchanges: both ends report one, and it counts once. METHOD §2."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable
from typing import NamedTuple

from dgorl.crowds import Order, second

EXCHANGE = 5.0
"""Readings of one exchange follow one another within this [s]; later, its number is that of another one."""


class Reading(NamedTuple):
    """One scalar measurement: sorts canonically. ``a`` measured or transmits as the kind says, ``b`` is the other.

    robot_a, robot_b: the history's numbers of both.
    """

    stamp: float
    a: str
    b: str
    value: float
    sigma: float
    robot_a: int
    robot_b: int
    exchange: int | None = None

    @property
    def order(self) -> Order:
        return self[:5]


Slot = tuple[object, ...]


class Exchanges:
    """All readings known of each exchange: in whatever order they come, the first of those that follow on counts."""

    def __init__(self) -> None:
        self._known: defaultdict[Slot, list[Reading]] = defaultdict(list)
        self._within: defaultdict[int, dict[Order, tuple[Slot, Reading]]] = defaultdict(dict)

    def within(self, number: int) -> dict[Order, tuple[Slot, Reading]]:
        """The readings of a second, whether they count or not, and what exchange each is of."""
        return self._within.get(number, {})

    def take(self, slot: Slot, reading: Reading) -> tuple[bool, Order | None]:
        """Take a reading of an exchange: whether it counts, and the reading that no longer does."""
        known = self._known[slot]
        k = bisect_left(known, reading)
        if known[k : k + 1] == [reading]:
            return False, None
        counted = known[k].order if _begins(known, k) else None
        known.insert(k, reading)
        self._within[second(reading.stamp)][reading.order] = slot, reading
        return _begins(known, k), None if _begins(known, k + 1) else counted

    def withdraw(self, slot: Slot, reading: Reading) -> tuple[bool, Reading | None]:
        """Let go of a reading, as if it had never come: whether it counted, and the one that now does in its place."""
        known = self._known[slot]
        k = bisect_left(known, reading)
        counted, follower = _begins(known, k), _begins(known, k + 1)
        del known[k]
        del self._within[second(reading.stamp)][reading.order]
        return counted, known[k] if not follower and _begins(known, k) else None

    def counts(self, order: Order) -> int:
        """How many exchanges a reading of that order counts for."""
        return sum(_counts(known, order) for known in self._known.values())

    def keep(self, kept: Callable[[float], bool]) -> None:
        """Keep the readings with such stamps [s]."""
        left = ((slot, [reading for reading in known if kept(reading.stamp)]) for slot, known in self._known.items())
        self._known = defaultdict(list, {slot: known for slot, known in left if known})
        self._within.clear()
        for slot, known in self._known.items():
            for reading in known:
                self._within[second(reading.stamp)][reading.order] = slot, reading


def _begins(known: list[Reading], k: int) -> bool:
    """Whether an exchange begins with the k-th of the readings known of its number."""
    return k < len(known) and (k == 0 or known[k].stamp - known[k - 1].stamp > EXCHANGE)


def _counts(known: list[Reading], order: Order) -> bool:
    """Whether a reading is among those known of an exchange's number, and counts."""
    k = bisect_left(known, order)
    return k < len(known) and known[k].order == order and _begins(known, k)
