"""Whether a robot's journal is sound, looked at without disturbing the agent that may be writing it."""

from __future__ import annotations

import fcntl
import os
import shutil
import sqlite3
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path

from dgorl.errors import LogError
from dgorl.findings import Finding, note, ok, problem
from dgorl.team.journal import LIMIT
from dgorl.team.journal_read import Contents, contents
from dgorl.team.journal_schema import connect, hexadecimal, is_journal
from dgorl.team.ranges import Ranges

AREA = "journal"
ROOM = 2 * LIMIT
"""Less room on the disk than this [bytes] is little."""


def journal_checkup(path: Path) -> tuple[Finding, ...]:
    """Look at everything in a journal."""
    return tuple(_all(path))


def _all(path: Path) -> Iterator[Finding]:
    if not path.is_file():
        yield problem(AREA, f"{path}: no such file", "an agent makes it when it starts; see its --journal")
        return
    if not is_journal(path):
        yield problem(AREA, f"{path}: not a journal", "give the file an agent's --journal names")
        return
    try:
        with closing(connect(path, "ro")) as database:
            said = [str(row[0]) for row in database.execute("PRAGMA quick_check(3)")]
        if said != ["ok"]:
            raise sqlite3.DatabaseError("; ".join(" ".join(line.split()) for line in said))
        found = contents(path)
    except (sqlite3.Error, LogError) as error:
        what = str(error).removeprefix(f"{path}: ")
        yield problem(AREA, f"{path}: damaged: {what}", "its agent sets it aside when it starts, and begins a new one")
        return
    size = sum(_size(path.with_name(path.name + suffix)) for suffix in ("", "-wal"))
    used = "in use by an agent" if _locked(path) else "no agent has it open"
    yield ok(AREA, f"{path}: of {found.robot} in team {found.team}, {size / 2**20:.1f} MiB, {used}")
    yield from _ticks(found)
    yield from _bundles(found)
    if not path.with_name(path.name + "-mark").is_file():
        yield note(AREA, f"{path}-mark is missing: its agent will begin a new epoch", "copy it along with the journal")
    free = shutil.disk_usage(path.parent).free
    if free < ROOM:
        yield problem(AREA, f"{free / 2**20:.0f} MiB are left on its disk", "make room: without it nothing is sent")


def _ticks(found: Contents) -> Iterator[Finding]:
    runs = len(found.stories)
    ticks = [tick.now for story in found.stories for tick in story.ticks]
    if not ticks:
        yield note(AREA, f"its agent was started {runs} times and never came to an estimate")
        return
    yield ok(AREA, f"{len(ticks)} estimates in {runs} runs, from {ticks[0]:.1f} to {ticks[-1]:.1f} s of its clock")
    if found.dropped:
        yield ok(AREA, f"{found.dropped} older entries were dropped to save room")
    back = [a for a, b in pairwise(ticks) if b < a]
    if back:
        what = f"its clock went back {len(back)} times, first at {back[0]:.1f} s"
        yield note(AREA, what, "set the clock before the agent starts")


def _bundles(found: Contents) -> Iterator[Finding]:
    held: dict[tuple[str, int], Ranges] = defaultdict(Ranges)
    for robot, epoch, sequence in found.bundles:
        held[robot, epoch].add(sequence)
    for (robot, epoch), ranges in sorted(held.items()):
        total = sum(last - first + 1 for first, last in ranges)
        missing = ranges.high - ranges.low + 1 - total
        what = f"{robot}:{hexadecimal(epoch)}: {total} bundles, {ranges.low} to {ranges.high}"
        if missing:
            yield note(AREA, f"{what}, {missing} of these missing")
        else:
            yield ok(AREA, what)


def _locked(path: Path) -> bool:
    """Whether an agent holds the journal's mark."""
    try:
        mark = os.open(path.with_name(path.name + "-mark"), os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(mark, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(mark)
    return False


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
