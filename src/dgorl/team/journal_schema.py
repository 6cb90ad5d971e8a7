"""How a journal looks: one SQLite table of everything that happened to an agent, in one sequence.

``entries.number`` is that sequence. A *run* is a start of the agent (body: JSON of :class:`Run`), a *bundle* one made
or received (body: its signed bytes), a *tick* an update of the estimate (body: MessagePack list of the numbers of the
bundles admitted since the tick before, in that order). ``facts`` says whose journal it is.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any
from urllib.parse import quote

from dgorl.errors import DgorlError
from dgorl.measurements import RelativePose

APPLICATION = 0x4447_4F52
"""SQLite's application_id of a journal: `DGOR`."""

VERSION = 1
"""Of the tables; SQLite's user_version."""

LARGEST_BUNDLE = 2**20
"""Bundles are read back whatever the agent's limit was [bytes]."""

LARGEST_BUNDLE = 2**20
"""Bundles are read back whatever the agent's limit was [bytes]."""

HEADER = 100
"""Bytes of SQLite's file header."""

MAGIC = b"SQLite format 3\x00"

SCHEMA = """
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE entries (
  number INTEGER PRIMARY KEY,
  kind INTEGER NOT NULL,
  now REAL,
  robot TEXT, epoch TEXT, sequence INTEGER,
  body BLOB NOT NULL
);
CREATE UNIQUE INDEX bundles ON entries (robot, epoch, sequence) WHERE kind = 1;
CREATE INDEX ticks ON entries (number, now) WHERE kind = 2;
CREATE INDEX runs ON entries (number) WHERE kind = 0;
"""


class Kind(IntEnum):
    """What an entry is."""

    RUN = 0
    BUNDLE = 1
    TICK = 2


@dataclass(frozen=True)
class Run:
    """How an agent began: its settings, the known starts it was given, who was in the team, its own epoch.

    since: where its estimate was made anew, of what came after that [s]; known starts before it were left out.
    """

    settings: Mapping[str, Any]
    starts: tuple[RelativePose, ...]
    robots: tuple[str, ...]
    epoch: int
    since: float | None = None

    @property
    def given(self) -> tuple[RelativePose, ...]:
        """The known starts that the estimate was given."""
        return self.starts if self.since is None else tuple(s for s in self.starts if s.stamp >= self.since)


class JournalError(DgorlError):
    """A journal that cannot be used: in use, another robot's, not writable."""


def is_journal(path: Path) -> bool:
    """Whether a file is a journal, by its header alone: its tables may be damaged all the same."""
    head = _header(path)
    return head.startswith(MAGIC) and int.from_bytes(head[68:72], "big") == APPLICATION


def _header(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(HEADER)
    except OSError:
        return b""


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """A connection in SQLite's ``mode`` (ro, rw, rwc), transactions begun by hand."""
    return sqlite3.connect(f"file:{quote(str(path))}?mode={mode}", uri=True, isolation_level=None, timeout=5.0)


def create(path: Path, facts: Mapping[str, str]) -> None:
    """A new, empty journal, forced onto the disk before anything goes into its write-ahead log."""
    connection = connect(path, "rwc")
    try:
        connection.execute("PRAGMA synchronous = FULL")
        rows = ", ".join(f"({_quoted(name)}, {_quoted(value)})" for name, value in facts.items())
        connection.executescript(
            f"BEGIN IMMEDIATE; PRAGMA application_id = {APPLICATION}; PRAGMA user_version = {VERSION};"
            f"{SCHEMA} INSERT INTO facts VALUES {rows}; COMMIT;"
        )
        connection.execute("PRAGMA journal_mode = WAL")
    finally:
        connection.close()


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def facts_of(connection: sqlite3.Connection) -> dict[str, str]:
    """Whose journal it is: team, robot, epoch. Raises JournalError when a newer dgorl wrote it."""
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version > VERSION:
        raise JournalError(f"written by a newer dgorl (journal version {version}); update this one")
    return dict(connection.execute("SELECT name, value FROM facts"))


def hexadecimal(epoch: int) -> str:
    """An epoch as journals and ``data`` columns write it."""
    return f"{epoch:016x}"
