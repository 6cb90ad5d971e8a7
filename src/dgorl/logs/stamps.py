"""Stamps of a whole log, before anything is made of them: those on another clock are refused by file and line."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dgorl.errors import LogError
from dgorl.logs.text import Row
from dgorl.measurements import Displacement, Measurement, Odometry
from dgorl.se2 import Array

APART = 86_400.0
"""No log is silent for longer [s]: what is farther from the rest is on another clock, or no stamp at all."""
BEYOND = 60.0
"""Ground truth may stand this much [s] before or after the odometry: that of a start, say."""
ADVICE = "put all files on one clock, in seconds"


@dataclass
class _File:
    path: Path
    what: str
    column: str
    stamps: array[float] = field(default_factory=lambda: array("d"))
    lines: array[int] = field(default_factory=lambda: array("q"))


class Stamps:
    """The stamps of odometry and readings, file by file in the order of reading, odometry first."""

    def __init__(self) -> None:
        self._files: dict[Path, _File] = {}

    def take(self, row: Row, stamp: float, what: str, column: str = "t") -> None:
        """Note a row's stamp [s]; ``what`` the rows of its file are, ``column`` where it stands."""
        file = self._files.get(row.path)
        if file is None:
            file = self._files[row.path] = _File(row.path, what, column)
        file.stamps.append(stamp)
        file.lines.append(row.line)

    def check(self) -> None:
        """Raises LogError naming the first row more than ``APART`` from the rest, which are the most rows."""
        files = list(self._files.values())
        if not files:
            return
        stamps = np.concatenate([np.frombuffer(file.stamps) for file in files])
        group = _groups(stamps)
        counts = np.bincount(group)
        if len(counts) == 1:
            return
        in_rest = group == group[np.argmax(counts[group])]  # of groups with as many rows, the first
        odd, rest = int(np.argmin(in_rest)), int(np.argmax(in_rest))
        span = float(stamps[in_rest].min()), float(stamps[in_rest].max())
        file, line = _place(files, odd)
        what = f"the rest ({_place(files, rest)[0].what} {_number(span[0])} to {_number(span[1])})"
        raise LogError(file.path, line, f"{_lies(file.column, float(stamps[odd]), span)} from {what}: {ADVICE}")


def within(path: Path, line: int | None, name: str, stamp: float, span: tuple[float, float]) -> None:
    """Raises LogError for a single stamp, called ``name``, that lies more than ``APART`` from a log's ``span`` [s]."""
    if not span[0] - APART <= stamp <= span[1] + APART:
        between = f"the odometry ({_number(span[0])} to {_number(span[1])})"
        raise LogError(path, line, f"{_lies(name, stamp, span)} from {between}: {ADVICE}")


def overlapping(path: Path, lines: Iterable[int], stamps: Array, span: tuple[float, float], robot: str = "") -> None:
    """Raises LogError unless ground truth, rows of rising ``stamps`` (T,) [s] on ``lines``, belongs to the odometry.

    span: of the odometry [s]. It must overlap, give or take ``BEYOND``, and no row may be far away.
    """
    lines = list(lines)
    if stamps[-1] < span[0] - BEYOND or stamps[0] > span[1] + BEYOND:
        truth = f"ground truth{f' of {robot}' if robot else ''} from {_number(stamps[0])} to {_number(stamps[-1])} s"
        odometry = f"the odometry ({_number(span[0])} to {_number(span[1])})"
        raise LogError(path, lines[0], f"{truth} does not overlap {odometry}: {ADVICE}")
    for at in (0, len(lines) - 1):
        within(path, lines[at], "t", float(stamps[at]), span)


def odometry_span(measurements: Iterable[Measurement]) -> tuple[float, float]:
    """From when to when there is odometry [s]; there must be some."""
    rows = [m for m in measurements if isinstance(m, Odometry | Displacement)]
    return min(m.start for m in rows), max(m.end for m in rows)


def _groups(stamps: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.int_]]:
    """(N,) which rows belong together: none of a group is ``APART`` from all others of it."""
    order = np.argsort(stamps, kind="stable")
    group = np.empty(len(stamps), dtype=int)
    group[order] = np.cumsum(np.append(0, np.diff(stamps[order]) > APART))
    return group


def _place(files: list[_File], index: int) -> tuple[_File, int]:
    """File and line of a stamp, by its place among those of all files."""
    for file in files:
        if index < len(file.stamps):
            return file, file.lines[index]
        index -= len(file.stamps)
    raise IndexError(index)


def _lies(column: str, stamp: float, span: tuple[float, float]) -> str:
    """How far a stamp is from a span that it is outside of, in words."""
    away = span[0] - stamp if stamp < span[0] else stamp - span[1]
    mantissa, _, exponent = f"{away:.1e}".partition("e")
    far = f"{away:.0f}" if away < 1e6 else f"{mantissa}e{int(exponent)}"
    return f"{column} {stamp!r} lies {far} s"


def _number(stamp: float) -> str:
    return f"{stamp:.12g}"
