"""An agent's journal: what it made, heard, admitted and when it looked, in one sequence that outlives ``kill -9``.

Own bundles are on the disk before they are sent, so that a sequence number never names two contents, not even after a
power cut. All else follows in batches with them. :mod:`dgorl.logs.journal` reads it back as what the robot saw.
"""

from __future__ import annotations

import secrets
import sqlite3
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, Literal

from dgorl.measurements import RelativePose
from dgorl.team.bundles import Sealed
from dgorl.team.envelope import Rejected, unwrap
from dgorl.team.journal_entries import Entries, Entry, Memory
from dgorl.team.journal_file import opened
from dgorl.team.journal_mark import Mark, State, boot
from dgorl.team.journal_schema import LARGEST_BUNDLE, JournalError, Run, hexadecimal
from dgorl.team.keys import Roster
from dgorl.team.wire import peek

LIMIT = 256 * 2**20
"""A journal takes no more room than this [bytes], unless what must be kept needs it."""

LOG_LIMIT = 4 * 2**20
"""What SQLite's write-ahead log may keep on the disk [bytes]."""

CACHE = 256
"""Pages SQLite keeps in memory [KiB]: a journal is written at its end and read when it is opened."""

Synchronous = Literal["full", "normal"]
"""full: own bundles survive a power cut. normal: they survive ``kill -9``; after a power cut a new epoch begins."""

QUEUE = 20_000
"""While the disk refuses, so many bundles and ticks wait at most; then the oldest are lost to the journal."""

_Tick = tuple[float, tuple[Entry, ...]]


class Journal:
    """One robot's journal, open and locked. Only one agent can have it.

    epoch: 64 random bits, made when the journal is new. next_sequence: the first number no own bundle has had. known:
    signed bytes of the bundles, own and received, that came in the last ``keep`` seconds before, in the order they
    came. admitted: (robot, epoch) of those the estimate was given then. last: the last tick before [s], or None.
    newest: number of its newest entry on the disk. born: cut of the epoch's first bundle [s], if there is
    one. notices: what a person should hear about how it was opened.
    """

    epoch: int
    next_sequence: int
    known: tuple[bytes, ...]
    admitted: frozenset[tuple[str, int]]
    last: float | None
    newest: int
    born: float | None
    notices: tuple[str, ...]
    _run: Run

    def __init__(
        self, path: Path, mark: Mark, robot: str, roster: Roster, keep: float, limit: int, synchronous: Synchronous
    ) -> None:
        """Use :meth:`open`."""
        self.path, self.robot = path, robot
        self._mark, self._keep, self._limit, self._synchronous = mark, keep, limit, synchronous
        self._queue: deque[Entry | _Tick] = deque(maxlen=QUEUE)
        state = mark.read()
        epoch = secrets.randbits(64)
        facts = {"team": roster.team, "robot": robot, "epoch": hexadecimal(epoch)}
        self._database, memory, aside = opened(path, facts, keep, marked=state is not None)
        try:
            self._database.execute(f"PRAGMA journal_size_limit = {LOG_LIMIT}")
            self._database.execute(f"PRAGMA cache_size = -{CACHE}")
            self._entries = Entries(self._database)
            self._now = self.last = memory.last
            self.known, self.admitted = memory.known, memory.admitted
            notices = [f"{path}: cannot be read, set aside as {aside.name}"] if aside else []
            self.notices = (*notices, *self._resume(state, memory, roster.team, epoch))
            self.born = self._born(roster)
        except BaseException:
            self._database.close()
            raise

    @classmethod
    def open(
        cls,
        path: str | Path,
        robot: str,
        roster: Roster,
        *,
        settings: Mapping[str, Any],
        keep: float,
        starts: Sequence[RelativePose] = (),
        limit: int = LIMIT,
        synchronous: Synchronous = "full",
    ) -> Journal:
        """Continue the journal at a path, or begin it.

        settings, starts: the nested configuration the robot's estimate is made under, the known starts it is given
        before all bundles. keep: what the estimate may still need [s], history + window + 10 s; nothing younger is
        dropped, whatever ``limit`` [bytes] says.
        Raises JournalError: in use, another robot's, not a journal, not writable. A damaged one is set aside, and
        ``notices`` say so.
        """
        path = Path(path)
        mark = Mark(path)
        try:
            journal = cls(path, mark, robot, roster, keep, limit, synchronous)
            journal._run = Run(settings, tuple(starts), roster.robots, journal.epoch)
            with journal._committed("full"):
                journal._entries.add_run(journal._run)
        except BaseException:
            mark.close()
            raise
        return journal

    def commit_own(self, *bundles: Sealed) -> None:
        """Commit own bundles, and all that is queued: on return they may be sent.

        Their numbers rise, from ``next_sequence`` on; some may be left out. Raises JournalError when they do not or the
        disk refuses; then they must not be sent, and may be committed later.
        """
        following = self.next_sequence
        for sealed in bundles:
            robot, epoch, sequence = sealed.bundle.name
            if (robot, epoch) != (self.robot, self.epoch) or sequence < following:
                raise JournalError(
                    f"{self.path}: expected {self.robot}'s bundle {following} of epoch {hexadecimal(self.epoch)} "
                    f"or a later one, got {robot}'s {sequence} of {hexadecimal(epoch)}"
                )
            following = sequence + 1
        with self._committed(self._synchronous):
            for sealed in bundles:
                self._entries.put(sealed)  # one of that name was never sent: its mark could not be written
        self._write_mark(following)
        self.next_sequence = following

    def receive(self, sealed: Sealed) -> None:
        """Queue a bundle that came from another robot."""
        self._queue.append(Entry(sealed.name, sealed.data))

    def tick(self, now: float, admitted: Sequence[Sealed]) -> None:
        """Queue an update at ``now`` [s], before which the estimate was given ``admitted`` in that order."""
        self._queue.append((now, tuple(Entry(sealed.name, sealed.data) for sealed in admitted)))
        self._now = now

    def flush(self) -> None:
        """Write what is queued as far as the system, which survives ``kill -9``; drop what is old if there is too much.

        Raises JournalError when the disk refuses; what is queued stays so.
        """
        with self._committed("normal"):
            if self._now is not None and self._entries.size() > self._limit:
                self._entries.rotate(self._now - self._keep)

    def begin_anew(self, since: float) -> tuple[bytes, ...]:
        """The estimate begins anew, as after a restart: signed bytes of the bundles that came after ``since`` [s].

        Raises JournalError when the disk refuses.
        """
        with self._committed("normal"):
            self._entries.add_run(replace(self._run, since=since))
            known, _ = self._entries.recall(since)
        return known

    def renew(self) -> None:
        """A new epoch begins; what is known stays, ``known`` and ``admitted`` as after opening.

        Raises JournalError when the disk refuses: then the epoch that was goes on.
        """
        epoch = secrets.randbits(64)
        self._mark.write(State(epoch, 0), force=True)  # first: a mark that fits no journal is safe
        run = replace(self._run, epoch=epoch)
        with self._committed("full"):
            self._entries.set_epoch(epoch)
            self._entries.add_run(run)
            self.known, self.admitted = self._entries.recall(-inf if self._now is None else self._now - self._keep)
        self._run, self.epoch, self.next_sequence, self.born = run, epoch, 0, None
        self._write_mark(0)

    def close(self) -> None:
        """Write what is queued and let go of the journal. Raises JournalError when the disk refuses."""
        try:
            with self._committed("full"):
                pass
            self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._mark.write(State(self.epoch, self.next_sequence), force=True)
        finally:
            self._database.close()
            self._mark.close()

    def _resume(self, state: State | None, memory: Memory, team: str, new: int) -> list[str]:
        """Epoch and next number, from the database and its mark; what to say about them. ``new``: of a new epoch."""
        for what, theirs, ours in (("robot", memory.robot, self.robot), ("team", memory.team, team)):
            if theirs != ours:
                raise JournalError(
                    f"{self.path}: the journal of {what} `{theirs}`, not `{ours}`; give another file name"
                )
        broken = _broken(state, memory.epoch)
        if memory.epoch == new or state is None or broken:
            self.epoch, self.next_sequence = new, 0
            notices = [f"{self.path}: {broken}"] if broken and memory.epoch != new else []
            notices += [f"{self.path}: a new epoch begins, {hexadecimal(new)}"]
            with self._committed("full"):
                self._entries.set_epoch(new)
        else:
            self.epoch, self.next_sequence = memory.epoch, max(memory.written, state.next)
            lost = (
                f"has lost its end; own bundles up to {state.next - 1} were sent, up to {memory.written - 1} are here"
            )
            notices = [f"{self.path}: {lost}"] if memory.written < state.next else []
        self._write_mark(self.next_sequence, force=True)
        return notices

    def _born(self, roster: Roster) -> float | None:
        first = self._entries.first(self.robot, self.epoch)
        try:
            return None if first is None else float(peek(unwrap(first, LARGEST_BUNDLE)[1], roster).cut)
        except Rejected:
            return None

    def _write_mark(self, following: int, *, force: bool = False) -> None:
        since = boot() if self._synchronous == "normal" else ""
        self._mark.write(State(self.epoch, following, since), force=force)

    @contextmanager
    def _committed(self, synchronous: Synchronous) -> Iterator[None]:
        """One transaction that takes what is queued along. Raises JournalError, all undone, when the disk refuses."""
        try:
            self._database.execute(f"PRAGMA synchronous = {synchronous}")
            self._database.execute("BEGIN IMMEDIATE")
            try:
                for item in self._queue:
                    if isinstance(item, Entry):
                        self._entries.number(item)
                    else:
                        self._entries.add_tick(*item)
                yield
                newest = self._entries.newest()
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise
        except sqlite3.Error as error:
            raise JournalError(f"{self.path}: cannot be written: {error}") from error
        self._queue.clear()
        self.newest = newest


def _broken(state: State | None, epoch: int) -> str:
    """Why the epoch cannot go on, empty if it can: it must be certain which numbers were sent."""
    if state is None:
        return "its mark is missing or damaged"
    if state.epoch != epoch:
        return "its mark belongs to another epoch"
    if state.boot and state.boot != boot():
        return "the machine was switched off before all was on the disk"
    return ""
