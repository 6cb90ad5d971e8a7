"""Ground truth, kept apart from the measurements: a groundtruth.csv, and the start poses taken from truth."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dgorl.errors import LogError
from dgorl.logs.log import Start
from dgorl.logs.stamps import overlapping
from dgorl.logs.text import Forward, csv_rows
from dgorl.measurements import Displacement, Measurement, Odometry
from dgorl.se2 import Array

COLUMNS = ("t", "robot", "x", "y", "theta")


def read_truth(path: str | Path, robots: Collection[str], span: tuple[float, float] | None = None) -> dict[str, Array]:
    """Truth of a CSV file ``t,robot,x,y,theta``: robot → (T, 4) of t, x, y, theta [s, m, m, rad], rising t.

    span: from when to when there is odometry [s], which each robot's truth must overlap. Raises LogError for a bad
    line, a robot not in ``robots``, time running backwards for a robot, a file without rows or on another clock.
    """
    path = Path(path)
    rows: dict[str, list[list[float]]] = {}
    lines: dict[str, list[int]] = {}
    forward = Forward()
    for row in csv_rows(path, [[COLUMNS]])[1]:
        robot = row.robot(1, robots)
        stamp = row.number(0)
        forward.check(row, stamp, robot)
        rows.setdefault(robot, []).append([stamp, *row.numbers(2, 5)])
        lines.setdefault(robot, []).append(row.line)
    if not rows:
        raise LogError(path, None, "holds no ground truth; leave the file out if there is none")
    if span is not None:
        for robot in sorted(rows, key=lambda robot: lines[robot][0]):
            overlapping(path, lines[robot], np.array(rows[robot])[:, 0], span, robot)
    return {robot: rising(values) for robot, values in sorted(rows.items())}


def rising(rows: Sequence[Sequence[float]]) -> Array:
    """Rows as an array (T, 4) of rising time; of rows with the same stamp the last one counts."""
    values = np.array(rows, dtype=float)
    return np.asarray(values[np.append(values[1:, 0] > values[:-1, 0], True)])


def first_odometry(measurements: Iterable[Measurement]) -> dict[str, float]:
    """Robot → stamp at which its odometry begins [s]."""
    first: dict[str, float] = {}
    for measurement in measurements:
        if isinstance(measurement, Odometry | Displacement):
            first[measurement.robot] = min(first.get(measurement.robot, measurement.start), measurement.start)
    return first


def starts_from(truth: Mapping[str, Array], first: Mapping[str, float]) -> dict[str, Start]:
    """Each robot's start: its last truth row at or before its first odometry stamp, else the first row after.

    No other row of the truth has any influence.
    """
    starts = {}
    for robot, rows in truth.items():
        if robot in first and len(rows):
            index = max(int(np.searchsorted(rows[:, 0], first[robot], side="right")) - 1, 0)
            stamp, x, y, theta = (float(value) for value in rows[index])
            starts[robot] = Start(stamp, (x, y, theta))
    return starts
