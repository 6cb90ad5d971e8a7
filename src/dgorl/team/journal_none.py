"""In place of a journal that the disk does not take: nothing is kept, so nothing of one's own may be sent."""

from __future__ import annotations

import errno
import secrets
import sqlite3
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from dgorl.team.bundles import Sealed
from dgorl.team.journal import Journal
from dgorl.team.journal_place import make_folder
from dgorl.team.journal_schema import JournalError

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}
"""What a disk says that is full, broken, or turned read-only after it broke."""
LEAST = 256 * 2**10
"""A journal and its write-ahead log begin with less [bytes]."""
SQLITE_FULL = {sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR}


class NoJournal(Journal):
    """Lets an agent hear, answer and estimate, and refuses whatever must be kept before it is sent.

    Its epoch names the robot to those it hears for as long as it lasts; no bundle is ever of it. why: the disk's words.
    """

    def __init__(self, path: Path, robot: str, why: JournalError) -> None:
        self.path, self.robot, self._why = path, robot, why
        self.epoch, self.next_sequence = secrets.randbits(64), 0
        self.known, self.admitted, self.last, self.newest, self.notices = (), frozenset(), None, 0, ()
        self.born = None

    @property
    def why(self) -> str:
        """What is wrong."""
        return str(self._why)

    def commit_own(self, *bundles: Sealed) -> None:
        """Raises JournalError."""
        raise self._why

    def receive(self, sealed: Sealed) -> None:
        """Forgets it."""

    def tick(self, now: float, admitted: Sequence[Sealed]) -> None:
        """Forgets it."""

    def flush(self) -> None:
        """Raises JournalError."""
        raise self._why

    def renew(self) -> None:
        """Raises JournalError."""
        raise self._why

    def begin_anew(self, since: float) -> tuple[bytes, ...]:
        """Knows nothing of before."""
        return ()

    def close(self) -> None:
        """Has nothing to let go of."""


def room(journal: Path) -> bool:
    """Whether the disk takes as much as a journal needs to begin."""
    probe = journal.with_name(journal.name + "-probe")
    try:
        make_folder(journal)
        probe.write_bytes(bytes(LEAST))
        return True
    except (JournalError, OSError):
        return False
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)


def refused_by_disk(error: JournalError) -> bool:
    """Whether the disk is at fault, which may be mended while the robot runs, and not who named the file."""
    cause = error.__cause__
    if isinstance(cause, sqlite3.Error):
        return getattr(cause, "sqlite_errorcode", 0) & 0xFF in SQLITE_FULL
    return isinstance(cause, OSError) and cause.errno in FULL
