"""Opening a journal's file: a whole one is continued, a damaged one set aside under a new name, never deleted."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec

from dgorl.team.journal_entries import Entries, Memory
from dgorl.team.journal_schema import JournalError, connect, create, is_journal

SUFFIXES = ("", "-wal", "-shm", "-journal")
"""What SQLite keeps beside a database."""

NOT_DAMAGE = frozenset(
    {
        sqlite3.SQLITE_BUSY,
        sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_FULL,
        sqlite3.SQLITE_LOCKED,
        sqlite3.SQLITE_NOMEM,
        sqlite3.SQLITE_PERM,
        sqlite3.SQLITE_READONLY,
    }
)
"""Errors of the surroundings: the file may well be whole."""


class _DamagedError(Exception):
    """Not readable as a journal."""


DAMAGE = (
    _DamagedError,
    sqlite3.DatabaseError,
    msgspec.MsgspecError,
    ArithmeticError,
    LookupError,
    TypeError,
    ValueError,
)
"""What reading damaged rows leads to."""


class Opened(NamedTuple):
    """A journal's database, what it remembers, and where one that could not be read was put, if there was one."""

    database: sqlite3.Connection
    memory: Memory
    aside: Path | None


def opened(path: Path, facts: Mapping[str, str], keep: float, *, marked: bool) -> Opened:
    """The journal at a path, made with ``facts`` if there is none that can be read.

    keep: as in Entries.memory. marked: its mark says that a journal was here, whatever the file looks like now.
    Raises JournalError for a file that never was a journal, and for one that cannot be opened or moved.
    """
    aside = None
    try:
        whole = _whole(path, keep)
    except JournalError as error:
        raise JournalError(f"{path}: {error}") from error
    except DAMAGE as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in NOT_DAMAGE:
            raise JournalError(f"{path}: cannot be opened: {error}") from error
        if not (marked or is_journal(path)):
            raise JournalError(f"{path}: not a journal; give another file name") from error
        whole, aside = None, set_aside(path)
    if whole is None:
        try:
            create(path, facts)
            whole = _whole(path, keep)
        except sqlite3.Error as error:
            raise JournalError(f"{path}: cannot be made: {error}") from error
        assert whole is not None
    return Opened(*whole, aside)


def _whole(path: Path, keep: float) -> tuple[sqlite3.Connection, Memory] | None:
    """The journal, its every page checked; None when there is nothing. Raises DAMAGE, JournalError for a newer one."""
    if not path.exists() or path.stat().st_size == 0:
        if any(_beside(path, suffix).exists() for suffix in SUFFIXES[1:]):
            raise _DamagedError  # opened, SQLite would delete them
        return None
    database = connect(path, "rw")
    try:
        if database.execute("PRAGMA page_count").fetchone() == (0,):
            database.close()  # cut off while it was being made
            return None
        if not is_journal(path) or database.execute("PRAGMA quick_check(1)").fetchone() != ("ok",):
            raise _DamagedError
        return database, Entries(database).memory(keep)
    except BaseException:
        database.close()
        raise


def set_aside(path: Path) -> Path:
    """Rename a journal with all that belongs to it to NAME.unreadable-1, or the next number that is free.

    Raises JournalError when that fails.
    """
    number = 1
    while any(_beside(_numbered(path, number), suffix).exists() for suffix in SUFFIXES):
        number += 1
    target = _numbered(path, number)
    try:
        for suffix in SUFFIXES:
            if _beside(path, suffix).exists():
                _beside(path, suffix).rename(_beside(target, suffix))
    except OSError as error:
        raise JournalError(f"{path}: cannot be read, nor set aside: {error.strerror}; move it away") from error
    return target


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.unreadable-{number}")


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
