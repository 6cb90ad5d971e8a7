"""The small file beside a journal: its lock, and how far its own sequence numbers have gone.

A database that loses its end, by a cut-off copy or a failing card, looks whole, only shorter. The mark, written before
every send, tells: a number that was sent is never used for other contents.
"""

from __future__ import annotations

import fcntl
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

from dgorl.team.journal_schema import JournalError

SIZE = 128
"""Bytes of a mark: within one sector, so that it is written whole or not at all."""

BOOT = Path("/proc/sys/kernel/random/boot_id")
"""Tells whether the machine was switched off meanwhile (Linux)."""


@dataclass(frozen=True)
class State:
    """What a mark says. ``next``: the first sequence number of ``epoch`` that was never sent.

    boot: since which start of the machine numbers were committed without being forced to disk; empty: they were forced.
    """

    epoch: int
    next: int
    boot: str = ""


class Mark:
    """The open, locked mark of a journal. ``close`` it to let others in; the system does when the process dies."""

    def __init__(self, journal: Path) -> None:
        """Raises JournalError when another process, or this one, has the journal open, or it cannot be written."""
        self.path = journal.with_name(journal.name + "-mark")
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise JournalError(f"{self.path}: cannot be opened: {error.strerror}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._file)
            raise JournalError(f"{journal}: in use by another agent; give every agent a journal of its own") from error

    def read(self) -> State | None:
        """What it says; None when it is new or damaged."""
        text, _, check = os.pread(self._file, SIZE, 0).rstrip(b"\n ").rpartition(b" ")
        try:
            if not text or int(check, 16) != zlib.crc32(text):
                return None
            epoch, following, boot = text.decode("ascii").split(" ")
            return State(int(epoch, 16), int(following), boot.strip("-"))
        except ValueError:
            return None

    def write(self, state: State, *, force: bool = False) -> None:
        """Replace what it says; ``force``: onto the disk, else as far as the system, which survives ``kill -9``.

        Raises JournalError when it cannot be written.
        """
        text = f"{state.epoch:016x} {state.next} {state.boot or '-'}".encode("ascii")
        try:
            os.pwrite(self._file, (text + b" %08x" % zlib.crc32(text)).ljust(SIZE - 1) + b"\n", 0)
            if force:
                os.fsync(self._file)
                sync_folder(self.path.parent)
        except OSError as error:
            raise JournalError(f"{self.path}: cannot be written: {error.strerror}; nothing was sent") from error

    def close(self) -> None:
        """Let go of the journal."""
        os.close(self._file)


def sync_folder(folder: Path) -> None:
    """Force names made in a folder onto the disk."""
    file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def boot() -> str:
    """This start of the machine, without blanks or dashes at its ends; `unknown` where the system does not say."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return "unknown"
