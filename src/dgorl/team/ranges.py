"""Sets of whole numbers as a few intervals, ends included."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator

Interval = tuple[int, int]


class Ranges:
    """A set of whole numbers, small where they follow on."""

    __slots__ = ("_high", "_low")

    def __init__(self, intervals: Iterable[Interval] = ()) -> None:
        self._low: list[int] = []
        self._high: list[int] = []
        for low, high in intervals:
            self.add(low, high)

    def add(self, low: int, high: int | None = None) -> None:
        """Add low..high, or low alone."""
        high = low if high is None else high
        if high < low:
            return
        first = bisect_left(self._high, low - 1)
        last = bisect_right(self._low, high + 1)
        if first < last:
            low, high = min(low, self._low[first]), max(high, self._high[last - 1])
        self._low[first:last] = [low]
        self._high[first:last] = [high]

    def drop_below(self, least: int) -> None:
        """Remove all numbers below ``least``."""
        first = bisect_left(self._high, least)
        del self._low[:first], self._high[:first]
        if self._low:
            self._low[0] = max(self._low[0], least)

    def __contains__(self, number: int) -> bool:
        index = bisect_left(self._high, number)
        return index < len(self._high) and self._low[index] <= number

    def __iter__(self) -> Iterator[Interval]:
        return zip(self._low, self._high, strict=True)

    def __bool__(self) -> bool:
        return bool(self._low)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Ranges) and self._low == other._low and self._high == other._high

    def __len__(self) -> int:
        """How many intervals."""
        return len(self._low)

    def __repr__(self) -> str:
        return f"Ranges({list(self)})"

    @property
    def low(self) -> int:
        """The smallest number; −1 for none."""
        return self._low[0] if self._low else -1

    @property
    def high(self) -> int:
        """The largest number; −1 for none."""
        return self._high[-1] if self._high else -1

    def count(self) -> int:
        """How many numbers."""
        return sum(high - low + 1 for low, high in self)

    def both(self, other: Ranges) -> Ranges:
        """What is here and there."""
        return self.minus(self.minus(other))

    def within(self, low: int, high: int) -> Ranges:
        """What is here from ``low`` to ``high``."""
        return self.both(Ranges([(low, high)]))

    def minus(self, other: Ranges) -> Ranges:
        """What is here and not there."""
        if not self._low or (len(other) == 1 and other._low[0] <= self._low[0] and other._high[0] >= self._high[-1]):
            return Ranges()
        left: list[Interval] = []
        theirs = list(other)
        k = 0
        for low, high in self:
            while k < len(theirs) and theirs[k][1] < low:
                k += 1
            at = low
            for a, b in theirs[k:]:
                if a > high:
                    break
                if a > at:
                    left.append((at, a - 1))
                at = max(at, b + 1)
            if at <= high:
                left.append((at, high))
        return Ranges(left)

    def newest(self, count: int) -> Iterator[int]:
        """The largest ``count`` numbers, from the largest down."""
        for low, high in zip(reversed(self._low), reversed(self._high), strict=True):
            for number in range(high, low - 1, -1):
                if count <= 0:
                    return
                count -= 1
                yield number
