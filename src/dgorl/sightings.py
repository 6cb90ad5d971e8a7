"""Tables of what robots measured of one another, in canonical order, placed on the robots' tracks.

One row per measurement that counts: exchanges reported by both ends count once, and thinning keeps the reading
nearest the centre of each bin (METHOD §1, §2). A bin is open on the left and closed on the right, so that node times
fall between bins.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dgorl import _core
from dgorl.columns import Column
from dgorl.crowds import PER_PAIR, PER_ROBOT, Order, crowded_out, sampled, second
from dgorl.exchanges import Exchanges, Reading
from dgorl.se2 import Array

UNPLACED = -1

EACH = ("each",)
"""What readings compete for that all count."""


class Rows(NamedTuple):
    """Rows of a table: stamps, values and σ (M,), where both ends stand on their tracks."""

    stamp: Array
    value: Array
    sigma: Array
    track_a: NDArray[np.int64]
    track_b: NDArray[np.int64]
    keyframe_a: NDArray[np.int64]
    keyframe_b: NDArray[np.int64]
    offset_a: Array
    offset_b: Array


class Table:
    """All readings of one kind.

    directed: whether a→b and b→a are thinned apart. placed rows name tracks by the integer ``number`` gives them.
    """

    def __init__(self, kind: str, thinning: float, directed: bool) -> None:
        self.kind = kind
        self._thinning, self._directed = thinning and max(thinning, 1.0 / PER_PAIR), directed
        self._author = 2 if kind == "rssi" else 1  # which robot of an order measured
        self._called: dict[int, str] = {}
        self._best: dict[tuple[object, ...], tuple[tuple[object, ...], Reading]] = {}
        self._exchanges = Exchanges()
        numbers = [Column((), np.int64) for _ in range(4)]
        self._columns = (Column(), Column(), Column(), *numbers, Column((3,)), Column((3,)))  # as in Rows
        self._robots = (Column((), np.int64), Column((), np.int64))
        self._unplaced: set[int] = set()

    def __len__(self) -> int:
        return len(self._columns[0])

    @property
    def newest(self) -> float:
        """Stamp of the last row [s], minus infinity if there is none."""
        return self._columns[0].view[-1].item() if len(self) else -np.inf

    def has(self, reading: Reading) -> bool:
        """Whether a reading that competes with none is here."""
        if self._slot(reading)[0] != EACH:
            return False
        stamps, values, sigmas = (column.view for column in self._columns[:3])
        first, last = (int(np.searchsorted(stamps, reading.stamp, side)) for side in ("left", "right"))
        if first == last:
            return False
        a, b = (column.view[first:last] for column in self._robots)
        same = (a == reading.robot_a) & (b == reading.robot_b)
        same &= (values[first:last] == reading.value) & (sigmas[first:last] == reading.sigma)
        rivals = self._exchanges.counts(reading.order) if same.any() else 0
        return int(np.count_nonzero(same)) > rivals

    def add(self, readings: Sequence[Reading]) -> float:
        """Take readings; the earliest stamp [s] from which rows changed, infinity if none did."""
        if self._thinning > 0:
            return self._take(readings)
        readings = sampled(list(readings), lambda reading: reading.order, self._author)
        if all(reading.exchange is None for reading in readings):
            if readings:
                self._insert(sorted(set(readings)))
            dirty = min((reading.stamp for reading in readings), default=np.inf)
        else:
            dirty = self._take(readings)
        return min(
            dirty, *(self._thin_out(number) for number in {second(reading.stamp) for reading in readings}), np.inf
        )

    def _take(self, readings: Sequence[Reading]) -> float:
        """Take readings that compete with others; returns what :meth:`add` does."""
        dirty = np.inf
        fresh: dict[tuple[object, ...], Reading] = {}
        removed = []
        for reading in readings:
            slot, merit = self._slot(reading)
            wins, loser = self._compete(slot, merit, reading)
            if loser is not None:
                if fresh.pop((loser, slot), None) is None:
                    removed.append(loser)
                dirty = min(dirty, loser[0])
            if wins:
                fresh[reading.order, slot] = reading
                dirty = min(dirty, reading.stamp)
        if removed:
            self._remove(removed)
        if fresh:
            self._insert(sorted(fresh.values(), key=lambda reading: reading.order))
        return dirty

    def place(self, trails: list[_core.Trail | None]) -> None:
        """Find keyframe and offset of both ends of every row that has none yet, on the robots' trails by number."""
        if not self._unplaced:
            return
        rows = np.array(sorted(self._unplaced), dtype=np.int64)
        stamps = self._columns[0].view[rows]
        for end in (0, 1):
            located = _core.locate(trails, self._robots[end].view[rows], stamps)
            for column, found in zip((3, 5, 7), located, strict=True):
                self._columns[column + end].view[rows] = found
        done = (self._columns[3].view[rows] != UNPLACED) & (self._columns[4].view[rows] != UNPLACED)
        self._unplaced.difference_update(rows[done].tolist())

    def displace(self, robot: str, since: float = -np.inf) -> None:
        """The tracks of ``robot`` are others from ``since`` [s] on: place its rows anew."""
        first = int(np.searchsorted(self._columns[0].view, since, "left"))
        for number, name in self._called.items():
            if name == robot:
                a, b = (column.view[first:] == number for column in self._robots)
                self._unplaced.update((first + np.flatnonzero(a | b)).tolist())

    def between(self, low: float, high: float) -> Rows:
        """Views of the rows with low ≤ stamp ≤ high."""
        stamps = self._columns[0].view
        first, last = int(np.searchsorted(stamps, low, "left")), int(np.searchsorted(stamps, high, "right"))
        return Rows(*[column.view[first:last] for column in self._columns])

    def forget(self, before: float) -> None:
        """Drop rows stamped before ``before`` [s]."""
        first = int(np.searchsorted(self._columns[0].view, before, "left"))
        if first:
            for column in (*self._columns, *self._robots):
                column.drop(first)
            self._unplaced = {row - first for row in self._unplaced if row >= first}
            self._best = {slot: best for slot, best in self._best.items() if best[1].stamp >= before}
            self._exchanges.keep(lambda stamp: stamp >= before)

    def rewind(self, since: float) -> None:
        """Drop rows stamped after ``since`` [s]."""
        first = int(np.searchsorted(self._columns[0].view, since, "right"))
        if first < len(self):
            self._rearrange(first, [])
            self._best = {slot: best for slot, best in self._best.items() if best[1].stamp <= since}
        self._exchanges.keep(lambda stamp: stamp <= since)

    def _slot(self, reading: Reading) -> tuple[tuple[object, ...], tuple[object, ...]]:
        """What the reading competes for, and its merit there (smallest wins)."""
        stamp, a, b = reading.stamp, reading.a, reading.b
        pair = (a, b) if self._directed or a < b else (b, a)
        if self._thinning > 0:
            index = np.ceil(stamp / self._thinning) - 1
            distance = abs(stamp - (index + 0.5) * self._thinning)
            return ("bin", pair, index), (distance, reading.order)
        if reading.exchange is not None:
            return ("exchange", pair, reading.exchange), ()
        return EACH, ()

    def _compete(
        self, slot: tuple[object, ...], merit: tuple[object, ...], reading: Reading
    ) -> tuple[bool, Order | None]:
        """Whether a reading wins its slot, and the row that loses it."""
        if slot[0] == "exchange":
            return self._exchanges.take(slot, reading)
        rival = self._best.get(slot)
        if rival is not None and rival[0] <= merit:
            return False, None
        if slot != EACH:
            self._best[slot] = (merit, reading)
        return True, rival[1].order if rival is not None else None

    def _thin_out(self, number: int) -> float:
        """Remove the readings of a second that are too many; the earliest stamp [s] at which rows changed."""
        first, last = (int(np.searchsorted(self._columns[0].view, t, "right")) for t in (number - 1, number))
        numbered = self._exchanges.within(number)
        if not self._crowded(first, last, [reading for _, reading in numbered.values()]):
            return np.inf
        orders = {*self._keys(first, last), *numbered}
        removed, promoted = [], dict[Order, Reading]()
        for author in sorted({order[self._author] for order in orders}):
            for order in crowded_out(order for order in orders if order[self._author] == author):
                counted, follower = self._exchanges.withdraw(*numbered[order]) if order in numbered else (True, None)
                if counted and promoted.pop(order, None) is None:
                    removed.append(order)
                if follower is not None:
                    promoted[follower.order] = follower
        if removed:
            self._remove(removed)
        if promoted:
            self._insert(sorted(promoted.values(), key=lambda reading: reading.order))
        return min((order[0] for order in (*removed, *promoted)), default=np.inf)

    def _keys(self, first: int, last: int) -> Iterator[Order]:
        """By which the rows from ``first`` to ``last`` are sorted."""
        stamps, values, sigmas = (column.view[first:last].tolist() for column in self._columns[:3])
        a, b = (map(self._called.__getitem__, column.view[first:last].tolist()) for column in self._robots)
        return zip(stamps, a, b, values, sigmas, strict=True)

    def _crowded(self, first: int, last: int, numbered: Sequence[Reading]) -> bool:
        """Whether rows from ``first`` to ``last`` and readings of exchanges may be more than count of a robot."""
        if last - first + len(numbered) <= PER_PAIR:
            return False
        named = [(reading.robot_a, reading.robot_b) for reading in numbered]
        a, b = (np.append(column.view[first:last], [pair[k] for pair in named]).astype(np.int64)
                for k, column in enumerate(self._robots))  # fmt: skip
        most = np.bincount(b if self._author == 2 else a).max()
        _, pairs = np.unique(a * (max(a.max(), b.max()) + 1) + b, return_counts=True)
        return bool(most > PER_ROBOT or pairs.max() > PER_PAIR)

    def _insert(self, readings: list[Reading]) -> None:
        base = len(self)
        count = len(readings)
        in_order = not base or readings[0].order >= self._key(base - 1)
        for r in readings:
            self._called[r.robot_a], self._called[r.robot_b] = r.a, r.b
        numbers = np.array([(r.stamp, r.value, r.sigma, r.robot_a, r.robot_b) for r in readings])
        for k, column in enumerate((*self._columns[:3], *self._robots)):
            column.extend(numbers[:, k])
        for column in self._columns[3:5]:
            column.extend(np.full(count, UNPLACED))
        for column in self._columns[5:7]:
            column.extend(np.zeros(count, np.int64))
        for column in self._columns[7:]:
            column.extend(np.zeros((count, 3)))
        self._unplaced.update(range(base, base + count))
        if not in_order:
            first = self._find(readings[0].order, base)
            self._rearrange(first, self._sorted(first))

    def _sorted(self, first: int) -> list[int]:
        """The rows from ``first`` on in the order of their keys."""
        rank = np.zeros(max(self._called, default=-1) + 1, np.int64)
        rank[sorted(self._called, key=self._called.__getitem__)] = np.arange(len(self._called))
        stamps, values, sigmas = (column.view[first:] for column in self._columns[:3])
        a, b = (rank[column.view[first:]] for column in self._robots)
        rows: list[int] = (first + np.lexsort((sigmas, values, b, a, stamps))).tolist()
        return rows

    def _remove(self, orders: list[Order]) -> None:
        gone = {self._find(order) for order in orders}
        first = min(gone)
        self._rearrange(first, [row for row in range(first, len(self)) if row not in gone])

    def _find(self, order: Order, end: int | None = None) -> int:
        """The first row of the first ``end`` that is not before ``order``."""
        stamps = self._columns[0].view[:end]
        first, last = (int(np.searchsorted(stamps, order[0], side)) for side in ("left", "right"))
        return first + bisect_left(range(first, last), order, key=self._key)

    def _key(self, row: int) -> Order:
        """By which a row is sorted."""
        stamp, value, sigma = (column.view[row].item() for column in self._columns[:3])
        a, b = (self._called[column.view[row].item()] for column in self._robots)
        return stamp, a, b, value, sigma

    def _rearrange(self, first: int, rows: list[int]) -> None:
        """Replace everything from row ``first`` on by the given rows, in the given order."""
        for column in (*self._columns, *self._robots):
            column.rearrange(first, np.array(rows, dtype=np.int64))
        moved = {old: first + k for k, old in enumerate(rows) if old in self._unplaced}
        self._unplaced = {row for row in self._unplaced if row < first} | set(moved.values())
