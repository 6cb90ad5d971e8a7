"""The public recordings, where they are at hand: what is in them, and that they are read quickly."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from dgorl import logs
from dgorl.logs import Log
from dgorl.measurements import Bearing, Displacement, Odometry, Range
from tests.recordings import recording


@pytest.fixture(scope="module")
def mrclam() -> Log:
    return logs.read(recording("mrclam6"))


@pytest.fixture(scope="module")
def tiers() -> Log:
    return logs.read(recording("tiers/tiers.pyfg"))


def test_mrclam(mrclam: Log) -> None:
    counts = Counter(type(m) for m in mrclam.measurements)
    assert mrclam.robots == ("r1", "r2", "r3", "r4", "r5")
    # 301431 odometry rows: the last of each robot and 23 of a repeated stamp begin nothing.
    rows = {(m.robot, m.v, m.omega, m.start) for m in mrclam.measurements if isinstance(m, Odometry)}
    assert counts == {Odometry: len(rows), Range: 3988, Bearing: 3988}
    assert 301431 - 5 - 23 <= len(rows) <= 1.02 * 301431  # a twist held for long is reported every 0.1 s
    assert mrclam.skipped == {"landmark": 15383, "unknown barcode": 6}
    assert max(m.end - m.start for m in mrclam.measurements if isinstance(m, Odometry)) <= 1.0 + 1e-6
    assert sorted(mrclam.truth) == sorted(mrclam.starts) == list(mrclam.robots)


def test_mrclam_ranges_fit_the_motion_capture(mrclam: Log) -> None:
    """Depth over cos(bearing) is long by about 2.5 %, 0.05 m less: the camera's known trait."""
    errors = [error for m in mrclam.measurements if isinstance(m, Range) if (error := _error(mrclam, m)) is not None]
    assert len(errors) > 3900
    assert abs(np.median(errors)) < 0.03


def _error(log: Log, m: Range) -> float | None:
    ends = []
    for robot in (m.robot, m.peer):
        rows = log.truth[robot]
        k = int(np.searchsorted(rows[:, 0], m.stamp))
        if k in (0, len(rows)) or rows[k, 0] - rows[k - 1, 0] > 0.5:
            return None
        ends.append([np.interp(m.stamp, rows[k - 1 : k + 1, 0], rows[k - 1 : k + 1, c]) for c in (1, 2)])
    return 0.975 * m.range - 0.05 - float(np.linalg.norm(np.subtract(*ends)))


def test_tiers(tiers: Log) -> None:
    counts = Counter(type(m) for m in tiers.measurements)
    assert tiers.robots == ("A", "B", "C", "D", "L")
    assert counts[Range] == 7789
    steps = [m for m in tiers.measurements if isinstance(m, Displacement)]
    assert sum(m.robot != "L" for m in steps) == 9764
    assert Counter(m.robot for m in steps)["L"] == len(steps) - 9764 > 240
    # 20 Hz odometry, none of it squeezed into or stretched over a gap of the motion capture.
    lengths = [m.end - m.start for m in steps if m.robot != "L"]
    assert 0.025 < min(lengths) < max(lengths) < 0.075
    assert tiers.skipped == {"ground truth of a repeated stamp": 66}
    truth = logs.read_truth(recording("tiers/tiers_truth.csv"), tiers.robots)
    assert sorted(truth) == ["A", "B", "C", "D"]


def test_tiers_ranges_fit_the_truth(tiers: Log) -> None:
    errors = [error for m in tiers.measurements if isinstance(m, Range) if (error := _residual(tiers, m)) is not None]
    assert len(errors) > 7000
    assert abs(np.median(errors)) < 0.02
    assert np.median(np.abs(errors)) < 0.05


def _residual(log: Log, m: Range) -> float | None:
    ends = []
    for robot in (m.robot, m.peer):
        rows = log.truth[robot]
        if not rows[0, 0] < m.stamp < rows[-1, 0]:
            return None
        ends.append([np.interp(m.stamp, rows[:, 0], rows[:, c]) for c in (1, 2)])
    return m.range - float(np.linalg.norm(np.subtract(*ends)))


def test_a_recording_with_landmarks_of_unknown_place() -> None:
    log = logs.read(recording("mrclam5a.pyfg"))
    assert log.robots == ("A", "B", "C", "D", "E")
    assert log.skipped == {"EDGE_SE2_XY: where a landmark was seen": 1127}
    assert max(m.end - m.start for m in log.measurements if isinstance(m, Displacement)) > 8.0
    assert Counter(type(m) for m in log.measurements)[Range] == 316


@pytest.mark.parametrize("name", ["mrclam6", "tiers/tiers.pyfg"])
def test_truth_reaches_nothing_the_estimator_gets(name: str, tmp_path: Path) -> None:
    """True poses after the start replaced by nonsense: measurements, starts and settings stay the same."""
    source = recording(name)
    whole = logs.read(source)
    copy = tmp_path / source.name
    if source.is_dir():
        copy.mkdir()
        for file in source.iterdir():
            text = file.read_text()
            (copy / file.name).write_text(_corrupt_dat(text) if "_Groundtruth" in file.name else text)
    else:
        copy.write_text(_corrupt_pyfg(source.read_text()))
    corrupt = logs.read(copy)
    assert corrupt.measurements == whole.measurements
    assert corrupt.starts == whole.starts
    assert corrupt.configuration == whole.configuration
    robot = whole.robots[0]
    assert not np.array_equal(corrupt.truth[robot][-1], whole.truth[robot][-1])


def _corrupt_dat(text: str) -> str:
    """Rows more than 20 s after the first, by when every robot's odometry has begun."""
    rows = text.split("\n")
    begin = float(next(row for row in rows if row[:1] not in ("#", "")).split()[0])
    late = (row.startswith("#") or not row or float(row.split()[0]) < begin + 20 for row in rows)
    return "\n".join(row if keep else f"{row.split()[0]} 77 -77 1" for row, keep in zip(rows, late, strict=True))


def _corrupt_pyfg(text: str) -> str:
    rows, seen = [], set()
    for row in text.split("\n"):
        fields = row.split()
        if fields and fields[0] == "VERTEX_SE2":
            if fields[2][0] in seen:
                row = " ".join([*fields[:3], "77", "-77", "1"])
            seen.add(fields[2][0])
        rows.append(row)
    return "\n".join(rows)
