"""Strict reading of text tables: every bad line becomes a LogError with its file, its line and what to do."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, isfinite, ulp
from pathlib import Path
from typing import TypeVar

from dgorl.configuration import nearest
from dgorl.errors import LogError, MeasurementError, quoted
from dgorl.measurements import Odometry

Columns = tuple[str, ...]
T = TypeVar("T")


def text_of(path: Path) -> str:
    """The whole file. Raises LogError when it is missing, not readable or not UTF-8 (naming the line)."""
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise LogError(path, None, "no such file; the log needs it") from error
    except OSError as error:
        raise LogError(path, None, f"cannot be read: {error.strerror}") from error
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise LogError(path, line, "not UTF-8 text; save the file as UTF-8") from error


def number_of(field: str) -> float | None:
    """The finite number a field holds, or None."""
    try:
        value = float(field)
    except ValueError:
        return None
    return value if isfinite(value) and "_" not in field else None


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table, its fields by position; ``columns`` names them in errors."""

    path: Path
    line: int
    columns: Columns
    fields: list[str]

    def error(self, what: str) -> LogError:
        return LogError(self.path, self.line, what)

    def number(self, index: int) -> float:
        value = number_of(self.fields[index])
        if value is None:
            got = quoted(self.fields[index].strip())
            raise self.error(f"`{self.columns[index]}` must be a finite number, got {got}")
        return value

    def numbers(self, first: int, last: int) -> list[float]:
        return [self.number(index) for index in range(first, last)]

    def optional(self, index: int) -> float | None:
        """A number, or None for an empty or missing field."""
        return self.number(index) if self.given(index) else None

    def whole(self, index: int) -> int:
        try:
            return int(self.fields[index])
        except ValueError:
            got = quoted(self.fields[index].strip())
            raise self.error(f"`{self.columns[index]}` must be a whole number, got {got}") from None

    def given(self, index: int) -> bool:
        return index < len(self.fields) and bool(self.fields[index].strip())

    def robot(self, index: int, robots: Collection[str]) -> str:
        name = self.fields[index].strip()
        if name not in robots:
            known = ", ".join(robots)
            raise self.error(f"unknown robot {quoted(name)}{nearest(name, robots)}; the robots are {known}")
        return name

    def make(self, kind: Callable[..., T], *values: object, advice: str = "") -> T:
        """A measurement of these values, its complaint turned into a LogError that ends with ``advice``."""
        try:
            return kind(*values)
        except MeasurementError as error:
            raise self.error(f"{error}{advice}") from error


def rounding(stamp: float) -> float:
    """By so much [s] stamps of one instant may differ, computed in different ways."""
    return max(1e-6, 4 * ulp(stamp))


class Forward:
    """Refuses time that runs backwards, in a file or in each of several series (``who``)."""

    def __init__(self, strictly: bool = False) -> None:
        self._last: dict[str, float] = {}
        self._strictly = strictly

    def check(self, row: Row, stamp: float, who: str = "") -> None:
        last = self._last.get(who)
        if last is not None and (stamp < last or (self._strictly and stamp == last)):
            what = "time stands still" if stamp == last else "time runs backwards"
            of = f" for {who}" if who else ""
            advice = "sort the rows by time, or leave this one out if its clock was set"
            raise row.error(f"{what}{of}: {stamp!r} after {last!r}; {advice}")
        self._last[who] = stamp


def csv_rows(path: Path, families: Sequence[Sequence[Columns]]) -> tuple[int, Iterator[Row]]:
    """Which family of headers a CSV file has, and its rows, as wide as any header of that family.

    Raises LogError for a missing or unknown header and, while iterating, for a row of another width.
    """
    lines = text_of(path).split("\n")
    header = tuple(name.strip() for name in lines[0].split(","))
    for index, family in enumerate(families):
        if header in family:
            return index, _rows(path, lines, family)
    wanted = " or ".join(f"`{','.join(columns)}`" for family in families for columns in family)
    got = f"got {quoted(lines[0].strip())}" if lines[0].strip() else "it is empty"
    if "\r" in lines[0].strip():
        got += "; its lines end with CR alone: save it with LF or CRLF"
    raise LogError(path, 1, f"the first line must be the header {wanted}; {got}")


def _rows(path: Path, lines: list[str], family: Sequence[Columns]) -> Iterator[Row]:
    widths = sorted({len(columns) for columns in family})
    columns = max(family, key=len)
    for number, line in enumerate(lines[1:], start=2):
        fields = line.split(",")
        if len(fields) not in widths:
            if not line.strip():
                continue
            needed = " or ".join(str(width) for width in widths)
            what = f"needs {needed} columns, got {len(fields)} (the columns are {','.join(columns)})"
            raise LogError(path, number, what)
        yield Row(path, number, columns, fields)


def dat_rows(path: Path, columns: Columns) -> Iterator[Row]:
    """Rows of a table separated by blanks, `#` starts a comment line."""
    for number, line in enumerate(text_of(path).split("\n"), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) != len(columns):
            what = f"needs {len(columns)} columns ({' '.join(columns)}), got {len(fields)}"
            raise LogError(path, number, what)
        yield Row(path, number, columns, fields)


HOLD = 1.0
"""A twist is held until the robot's next row, at most this long [s]; a longer silence is a gap. METHOD §1."""
REPORT = 0.1
"""A robot that holds its twist says so at least this often [s]: what it does is known before its next command."""


def held_twist(
    row: Row,
    robot: str,
    start: float,
    until: float,
    v: float,
    omega: float,
    epoch: Callable[[float], int] = lambda _: 0,
) -> Iterator[Odometry]:
    """A twist held from ``start`` until ``until`` [s] or for ``HOLD``, as the robot reports it meanwhile.

    epoch: of a stamp.
    """
    end = min(until, start + HOLD)
    count = max(ceil((end - start) / REPORT - 1e-6), 1)
    stamps = [start + k * REPORT for k in range(count)] + [end]
    for begin, stop in pairwise(stamps):
        yield row.make(Odometry, robot, begin, stop, v, omega, epoch(begin))
