"""The table of a journal: what is written into it, what is found again, what is dropped."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import msgspec

from dgorl.team.bundles import Name, Sealed
from dgorl.team.journal_schema import Kind, Run, facts_of, hexadecimal

BATCH = 500
"""At most so many entries are dropped at once: rotation must not make an agent late."""

NAMED = f"WHERE kind = {Kind.BUNDLE} AND robot = ? AND epoch = ? AND sequence = ?"


class Memory(NamedTuple):
    """What a journal knows of the time before it was opened.

    last: the newest tick [s]. known: signed bytes of the bundles that came in the time that is kept before it, in their
    order; admitted: (robot, epoch) of those that were. written: own bundles of the epoch have numbers below this.
    """

    team: str
    robot: str
    epoch: int
    last: float | None
    known: tuple[bytes, ...]
    admitted: frozenset[tuple[str, int]]
    written: int


class Entry(NamedTuple):
    """A bundle as it waits to be written: signed bytes, as opened it takes 25 times the room."""

    name: Name
    data: bytes


class Entries:
    """Rows of the table ``entries``; when they are committed is the caller's. Every method may raise sqlite3.Error."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database

    def add_run(self, run: Run) -> None:
        """A start of the agent."""
        body = msgspec.json.encode(run)
        self._database.execute(f"INSERT INTO entries (kind, body) VALUES ({Kind.RUN}, ?)", (body,))

    def set_epoch(self, epoch: int) -> None:
        """Own bundles are of this epoch from now on."""
        self._database.execute("UPDATE facts SET value = ? WHERE name = 'epoch'", (hexadecimal(epoch),))

    def add_tick(self, now: float, admitted: Sequence[Entry]) -> None:
        """An update at ``now`` [s] after bundles were admitted."""
        body = msgspec.msgpack.encode([self.number(sealed) for sealed in admitted])
        self._database.execute(f"INSERT INTO entries (kind, now, body) VALUES ({Kind.TICK}, ?, ?)", (now, body))

    def number(self, sealed: Entry | Sealed) -> int:
        """The number of a bundle's entry, which is made if there is none. The first contents of a name are kept."""
        row = self._database.execute(f"SELECT number FROM entries {NAMED}", _name(sealed)).fetchone()
        return row[0] if row else self._insert(sealed)

    def put(self, sealed: Entry | Sealed) -> None:
        """A bundle in place of another that has its name."""
        self._database.execute(f"DELETE FROM entries {NAMED}", _name(sealed))
        self._insert(sealed)

    def memory(self, keep: float) -> Memory:
        """All that is remembered; ``keep`` [s] before the newest tick. Raises whatever damaged rows lead to."""
        facts = facts_of(self._database)
        epoch = int(facts["epoch"], 16)
        row = self._database.execute(
            f"SELECT now FROM entries WHERE kind = {Kind.TICK} ORDER BY number DESC LIMIT 1"
        ).fetchone()
        last = float(row[0]) if row else None
        known, admitted = self.recall(-inf if last is None else last - keep)
        (largest,) = self._database.execute(
            f"SELECT max(sequence) FROM entries WHERE kind = {Kind.BUNDLE} AND robot = ? AND epoch = ?",
            (facts["robot"], facts["epoch"]),
        ).fetchone()
        written = 0 if largest is None else int(largest) + 1
        return Memory(facts["team"], facts["robot"], epoch, last, known, admitted, written)

    def size(self) -> int:
        """Bytes in use, without the write-ahead log."""
        page, pages, free = (
            self._database.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_size", "page_count", "freelist_count")
        )
        return int(page * (pages - free))

    def rotate(self, since: float) -> None:
        """Drop some of the oldest entries, but none after the last tick at or before ``since`` [s], nor its run."""
        settled = self._settled(since)
        self._database.execute(
            "DELETE FROM entries WHERE number IN (SELECT number FROM entries WHERE number < ? AND number != "
            f"(SELECT coalesce(max(number), 0) FROM entries WHERE kind = {Kind.RUN} AND number < ?) "
            "ORDER BY number LIMIT ?)",
            (settled, settled, BATCH),
        )

    def recall(self, since: float) -> tuple[tuple[bytes, ...], frozenset[tuple[str, int]]]:
        """What came after the last tick at or before ``since`` [s]: known and admitted, as in Memory."""
        rows = self._database.execute(
            f"SELECT number, kind, robot, epoch, body FROM entries WHERE number > ? AND kind != {Kind.RUN} "
            "ORDER BY number",
            (self._settled(since),),
        )
        known: list[bytes] = []
        origins: dict[int, tuple[str, int]] = {}
        admitted: set[tuple[str, int]] = set()
        for number, kind, robot, epoch, body in rows:
            if kind == Kind.BUNDLE:
                known.append(bytes(body))
                origins[number] = (robot, int(epoch, 16))
            else:
                admitted.update(origins[n] for n in msgspec.msgpack.decode(body, type=list[int]) if n in origins)
        return tuple(known), frozenset(admitted)

    def first(self, robot: str, epoch: int) -> bytes | None:
        """The bundle of an epoch with the smallest number."""
        row = self._database.execute(
            f"SELECT body FROM entries WHERE kind = {Kind.BUNDLE} AND robot = ? AND epoch = ? "
            "ORDER BY sequence LIMIT 1",
            (robot, hexadecimal(epoch)),
        ).fetchone()
        return None if row is None else bytes(row[0])

    def newest(self) -> int:
        """Number of the newest entry, 0 where there is none."""
        (number,) = self._database.execute("SELECT coalesce(max(number), 0) FROM entries").fetchone()
        return int(number)

    def _settled(self, since: float) -> int:
        row = self._database.execute(
            f"SELECT number FROM entries WHERE kind = {Kind.TICK} AND now <= ? ORDER BY number DESC LIMIT 1", (since,)
        ).fetchone()
        return row[0] if row else 0

    def _insert(self, sealed: Entry | Sealed) -> int:
        number = self._database.execute(
            f"INSERT INTO entries (kind, robot, epoch, sequence, body) VALUES ({Kind.BUNDLE}, ?, ?, ?, ?)",
            (*_name(sealed), sealed.data),
        ).lastrowid
        assert number is not None
        return number


def _name(sealed: Entry | Sealed) -> tuple[str, str, int]:
    """What finds a bundle's entry. SQLite's integers end at 2^63: epochs are text."""
    robot, epoch, sequence = sealed.name
    return robot, hexadecimal(epoch), sequence
