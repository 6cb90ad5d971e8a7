"""How many readings count of what one robot says of another in one second: enough for any sensor, few enough to carry.

Who may say something may say a thousand times as much, and every reading costs each robot the same. Which count is a
function of the readings known, not of the order they came in: a bottom-k sample (E. Cohen, H. Kaplan, "Summarizing
data using bottom-k sketches", PODC 2007) by a hash of the stamp. Who was left out stays out, whatever comes later: only
more readings can precede it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from math import ceil
from struct import pack
from typing import TypeVar
from zlib import crc32

PER_PAIR = 50
"""Readings of a kind a second that count of one robot about another ..."""

PER_ROBOT = 200
"""... and about all others."""

Order = tuple[float, str, str, float, float]
"""Stamp [s], the two robots, value and σ of a reading: what it is sorted by."""

T = TypeVar("T")


def second(stamp: float) -> int:
    """Which second a stamp [s] is in: open on the left and closed on the right, so that node times fall between."""
    return ceil(stamp)


def crowded_out(orders: Iterable[Order]) -> list[Order]:
    """Those that do not count of one robot's readings of a kind within one second."""
    pairs: Counter[tuple[str, str]] = Counter()
    out = []
    for order in sorted(orders, key=_rank):
        if pairs[order[1:3]] < PER_PAIR and pairs.total() < PER_ROBOT:
            pairs[order[1:3]] += 1
        else:
            out.append(order)
    return out


def sampled(items: Sequence[T], order: Callable[[T], Order], author: int) -> list[T]:
    """The items whose readings count among themselves. author: 1 or 2, which robot of ``order`` measured."""
    if len(items) <= PER_PAIR:
        return list(items)
    groups: defaultdict[tuple[int, str], list[Order]] = defaultdict(list)
    for item in items:
        key = order(item)
        groups[second(key[0]), str(key[author])].append(key)
    out = {key for group in groups.values() if len(group) > PER_PAIR for key in crowded_out(group)}
    return [item for item in items if order(item) not in out]


def _rank(order: Order) -> tuple[int, Order]:
    return crc32(pack("<d", order[0])), order
