"""UTIAS MRCLAM folders: Barcodes.dat, RobotN_Odometry.dat, RobotN_Measurement.dat, RobotN_Groundtruth.dat.

Robots are ``r1``..``rN``. The camera sees barcodes: those of robots become a range and a bearing, those of
landmarks are left out. Its "range" is the depth z along the optical axis; the distance is z / cos(bearing).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from math import cos, pi
from pathlib import Path

from dgorl.errors import LogError
from dgorl.logs.log import Log, in_order
from dgorl.logs.text import Columns, Forward, dat_rows, held_twist
from dgorl.logs.truth import first_odometry, rising, starts_from
from dgorl.measurements import Bearing, Measurement, Odometry, Range
from dgorl.se2 import Array

HOLD = 1.0
"""A twist is held until the robot's next row, at most this long [s]; a longer silence is a gap. METHOD §1."""

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
    truth: dict[str, Array] = {}
    for number, robot in robots.items():
        measurements += _odometry(path / f"Robot{number}_Odometry.dat", robot)
        measurements += _sightings(path / f"Robot{number}_Measurement.dat", number, robots, subjects, skipped)
        file = path / f"Robot{number}_Groundtruth.dat"
        if file.exists():
            truth[robot] = _truth(file)
    if not any(isinstance(m, Odometry) for m in measurements):
        raise LogError(path, None, "holds no odometry: nothing tells how the robots move")
    starts = starts_from(truth, first_odometry(measurements))
    return Log(path, tuple(robots.values()), in_order(measurements), truth, starts, {}, dict(skipped))


def _barcodes(path: Path) -> Mapping[int, int]:
    """Barcode → subject."""
    subjects: dict[int, int] = {}
    for row in dat_rows(path, ("subject", "barcode")):
        barcode = row.whole(1)
        if barcode in subjects:
            raise row.error(f"barcode {barcode} stands here twice; give each subject its own")
        subjects[barcode] = row.whole(0)
    return subjects


def _odometry(path: Path, robot: str) -> Iterator[Odometry]:
    """Each twist from its row to the robot's next; of rows with the same stamp the last one counts."""
    forward = Forward()
    held: tuple[float, float, float] | None = None
    for row in dat_rows(path, _ODOMETRY):
        stamp, v, omega = row.numbers(0, 3)
        forward.check(row, stamp)
        if held is not None and stamp > held[0]:
            yield from held_twist(row, robot, held[0], min(stamp, held[0] + HOLD), held[1], held[2])
        held = (stamp, v, omega)


def _sightings(
    path: Path, observer: int, robots: Mapping[int, str], subjects: Mapping[int, int], skipped: Counter[str]
) -> Iterator[Range | Bearing]:
    forward = Forward()
    robot = robots[observer]
    for row in dat_rows(path, _MEASUREMENT):
        stamp, depth, bearing = row.number(0), row.number(2), row.number(3)
        forward.check(row, stamp)
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


def _truth(path: Path) -> Array:
    forward = Forward()
    rows = []
    for row in dat_rows(path, _GROUNDTRUTH):
        forward.check(row, row.number(0))
        rows.append(row.numbers(0, 4))
    if not rows:
        raise LogError(path, None, "holds no ground truth; leave the file out if there is none")
    return rising(rows)
