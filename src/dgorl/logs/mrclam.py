"""UTIAS MRCLAM folders: Barcodes.dat, RobotN_Odometry.dat, RobotN_Measurement.dat, RobotN_Groundtruth.dat.

Robots are ``r1``..``rN``. The camera sees barcodes: those of robots become a range and a bearing, those of
landmarks are left out. Its "range" is the depth z along the optical axis; the distance is z / cos(bearing).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from math import cos, pi
from pathlib import Path

import numpy as np

from dgorl.errors import LogError
from dgorl.logs.log import Log, in_order
from dgorl.logs.stamps import Stamps, odometry_span, overlapping
from dgorl.logs.text import Columns, Forward, Row, dat_rows, held_twist
from dgorl.logs.truth import first_odometry, rising, starts_from
from dgorl.measurements import Bearing, Measurement, Odometry, Range
from dgorl.se2 import Array

LATE = 1.0
"""Rows in a row that lie farther back in time than this [s] are a clock that was set, not a slip of the stamps."""

_ODOMETRY: Columns = ("t", "v", "omega")
_MEASUREMENT: Columns = ("t", "barcode", "range", "bearing")
_GROUNDTRUTH: Columns = ("t", "x", "y", "theta")


def read_mrclam(path: Path) -> Log:
    """A folder of the UTIAS multi-robot data set. Raises LogError."""
    numbers = sorted(
        int(match[1]) for file in path.iterdir() if (match := re.fullmatch(r"Robot(\d+)_Odometry\.dat", file.name))
    )
    if not numbers:
        raise LogError(path, None, "holds no RobotN_Odometry.dat; unpack the whole data set into one folder")
    robots = {number: f"r{number}" for number in numbers}
    subjects = _barcodes(path / "Barcodes.dat")
    measurements: list[Measurement] = []
    skipped: Counter[str] = Counter()
    stamps, rows = Stamps(), Counter[str]()
    for number, robot in robots.items():
        twists = list(_odometry(path / f"Robot{number}_Odometry.dat", stamps, skipped))
        rows[robot] = len(twists)
        measurements += _held(twists, robot)
    for number in robots:
        measurements += _sightings(path / f"Robot{number}_Measurement.dat", number, robots, subjects, stamps, skipped)
    if not any(isinstance(m, Odometry) for m in measurements):
        raise LogError(path, None, "holds no odometry: nothing tells how the robots move")
    stamps.check()
    span = odometry_span(measurements)
    files = {robot: path / f"Robot{number}_Groundtruth.dat" for number, robot in robots.items()}
    truth = {robot: _truth(file, span) for robot, file in files.items() if file.exists()}
    starts = starts_from(truth, first_odometry(measurements))
    return Log(path, tuple(robots.values()), in_order(measurements), truth, starts, {}, dict(skipped), dict(rows))


def _barcodes(path: Path) -> Mapping[int, int]:
    """Barcode → subject."""
    subjects: dict[int, int] = {}
    for row in dat_rows(path, ("subject", "barcode")):
        barcode = row.whole(1)
        if barcode in subjects:
            raise row.error(f"barcode {barcode} stands here twice; give each subject its own")
        subjects[barcode] = row.whole(0)
    return subjects


def _odometry(path: Path, stamps: Stamps, skipped: Counter[str]) -> Iterator[tuple[Row, float, float, float]]:
    """Rows with stamp, v and omega, in order; of rows with the same stamp the last one counts.

    A row stamped before the one it follows is left out, as data sets hold a few; more than one in a row that lie
    ``LATE`` back mean that time runs backwards.
    """
    last: tuple[Row, float, float, float] | None = None
    back, left_out = False, list[int]()
    for row in dat_rows(path, _ODOMETRY):
        stamp, v, omega = row.numbers(0, 3)
        stamps.take(row, stamp, "odometry")
        if last is not None and stamp < last[1]:
            if back and last[1] - stamp > LATE:
                raise row.error(f"time runs backwards: {stamp!r} after {last[1]!r}; sort the rows by time")
            back = True
            left_out.append(row.line)
            continue
        back = False
        if last is not None and stamp > last[1]:
            yield last
        last = (row, stamp, v, omega)
    if last is not None:
        yield last
    if left_out:
        first = f"{path.name}:{left_out[0]}" + (" and after" if len(left_out) > 1 else "")
        skipped[f"odometry stamped before the row it follows ({first})"] += len(left_out)


def _held(twists: Sequence[tuple[Row, float, float, float]], robot: str) -> Iterator[Odometry]:
    """Each twist from its row to the robot's next, for ``HOLD`` at most; the last row only ends the one before."""
    for (row, stamp, v, omega), (_, until, _, _) in pairwise(twists):
        yield from held_twist(row, robot, stamp, until, v, omega)


def _sightings(
    path: Path,
    observer: int,
    robots: Mapping[int, str],
    subjects: Mapping[int, int],
    stamps: Stamps,
    skipped: Counter[str],
) -> Iterator[Range | Bearing]:
    forward = Forward()
    robot = robots[observer]
    for row in dat_rows(path, _MEASUREMENT):
        stamp, depth, bearing = row.number(0), row.number(2), row.number(3)
        forward.check(row, stamp)
        stamps.take(row, stamp, "measurements")
        subject = subjects.get(row.whole(1))
        if subject is None:
            skipped["unknown barcode"] += 1
        elif subject == observer:
            skipped["own barcode"] += 1
        elif subject not in robots:
            skipped["landmark"] += 1
        elif abs(bearing) >= pi / 2:
            raise row.error(f"bearing {bearing} is behind the camera; it must be within ±π/2")
        else:
            yield row.make(Range, robot, robots[subject], stamp, depth / cos(bearing))
            yield row.make(Bearing, robot, robots[subject], stamp, bearing)


def _truth(path: Path, span: tuple[float, float]) -> Array:
    forward = Forward()
    rows, lines = [], []
    for row in dat_rows(path, _GROUNDTRUTH):
        forward.check(row, row.number(0))
        rows.append(row.numbers(0, 4))
        lines.append(row.line)
    if not rows:
        raise LogError(path, None, "holds no ground truth; leave the file out if there is none")
    overlapping(path, lines, np.array(rows)[:, 0], span)
    return rising(rows)
