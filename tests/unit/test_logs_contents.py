"""What readers make of whole logs: values, frames, epochs, starts, order; and what truth may not touch."""

from __future__ import annotations

from itertools import pairwise
from math import cos, hypot, pi
from pathlib import Path

import numpy as np
import pytest

from dgorl import logs, se2
from dgorl.errors import LogError
from dgorl.logs import Log, Start
from dgorl.measurements import Bearing, Displacement, Odometry, Range, Rssi, known_at
from dgorl.terrain import Altitude

ODOMETRY = "t,robot,v,omega\n0,r1,0.5,0.1\n0.5,r2,0.4,0.2\n1,r1,0.6,0\n2.5,r2,0,0\n9,r1,0,0\n"


def folder(path: Path, **files: str) -> Path:
    files = {
        "team.yaml": "robots: [r1, r2]\n",
        "odometry.csv": ODOMETRY,
        "rssi.csv": "t,from,to,rssi\n",
    } | files
    for name, text in files.items():
        (path / name).write_text(text)
    return path


def same_for_the_estimator(a: Log, b: Log) -> bool:
    return (a.robots, a.measurements, a.starts, a.configuration) == (
        b.robots,
        b.measurements,
        b.starts,
        b.configuration,
    )


def test_a_twist_is_held_until_the_robots_next_row(tmp_path: Path) -> None:
    """... for 1 s at most, and reported every 0.1 s meanwhile, so that a robot is not late while it goes on as told."""
    measurements = logs.read(folder(tmp_path)).measurements
    assert {(m.robot, m.v, m.omega) for m in measurements} == {("r1", 0.5, 0.1), ("r1", 0.6, 0.0), ("r2", 0.4, 0.2)}
    for robot, begin, turn, end in (("r1", 0.0, 1.0, 2.0), ("r2", 0.5, 1.5, 1.5)):
        own = [m for m in measurements if m.robot == robot]
        assert (own[0].start, own[-1].end) == (begin, end)
        assert all(a.end == b.start for a, b in pairwise(own))
        assert all(m.end - m.start < 0.1001 for m in own)
        assert all((m.v == own[0].v) == (m.end <= turn) for m in own)


def test_all_kinds_in_the_order_they_are_known(tmp_path: Path) -> None:
    log = logs.read(
        folder(
            tmp_path,
            **{
                "odometry.csv": "start,end,robot,dx,dy,dtheta,cxx,cxy,cxt,cyy,cyt,ctt\r\n0,1,r1,1,2,3\r\n"
                "1,2,r1,1,2,3,1,0.1,0.2,2,0.3,3\n\n",
                "rssi.csv": "t,from,to,rssi\n1,r1,r2,-50\n",
                "ranges.csv": "t,from,to,range,sigma,exchange\n0.5,r1,r2,3,\n1,r1,r2,3,0.2\n1,r2,r1,4,,7\n",
                "bearings.csv": "t, from, to, bearing, sigma\n 1, r1, r2, 3, \n",
            },
        )
    )
    assert log.measurements == (
        Range("r1", "r2", 0.5, 3.0),
        Displacement("r1", 0.0, 1.0, 1.0, 2.0, 3.0),
        Rssi("r1", "r2", 1.0, -50.0),
        Range("r1", "r2", 1.0, 3.0, 0.2),
        Range("r2", "r1", 1.0, 4.0, None, 7),
        Bearing("r1", "r2", 1.0, 3.0),
        Displacement("r1", 1.0, 2.0, 1.0, 2.0, 3.0, (1.0, 0.1, 0.2, 2.0, 0.3, 3.0)),
    )
    assert [known_at(m) for m in log.measurements] == sorted(known_at(m) for m in log.measurements)


def test_epochs_begin_when_a_robot_was_carried(tmp_path: Path) -> None:
    log = logs.read(folder(tmp_path, **{"team.yaml": "robots: [r1, r2]\nepochs: {r1: [1.0], r2: [1.0]}\n"}))
    odometry = [m for m in log.measurements if isinstance(m, Odometry)]
    assert all(m.epoch == (m.start >= 1.0) for m in odometry)
    assert {(m.robot, m.epoch) for m in odometry} == {("r1", 0), ("r1", 1), ("r2", 0), ("r2", 1)}


def test_odometry_is_left_out_while_a_robot_was_carried(tmp_path: Path) -> None:
    rows = "start,end,robot,v,omega\n0,1,r1,1,0\n1,2,r1,1,0\n"
    team = "robots: [r1, r2]\nepochs: {r1: [1.5]}\n"
    log = logs.read(folder(tmp_path, **{"team.yaml": team, "odometry.csv": rows}))
    assert [m for m in log.measurements if isinstance(m, Odometry)] == [Odometry("r1", 0.0, 1.0, 1.0, 0.0)]
    assert log.skipped == {"odometry while the robot was carried": 1}


def test_starts_of_the_team_come_before_those_of_truth(tmp_path: Path) -> None:
    truth = "t,robot,x,y,theta\n-1,r1,1,1,1\n0,r1,2,2,2\n0.7,r2,3,3,3\n9,r2,4,4,4\n"
    log = logs.read(folder(tmp_path, **{"groundtruth.csv": truth}))
    assert log.starts == {"r1": Start(0.0, (2.0, 2.0, 2.0)), "r2": Start(0.7, (3.0, 3.0, 3.0))}
    team = "robots: [r1, r2]\nstart: {r1: [7, 8, 9]}\n"
    assert logs.read(folder(tmp_path, **{"team.yaml": team})).starts == {"r1": Start(0.0, (7.0, 8.0, 9.0))}
    team += "start_stamp: 0.25\n"
    assert logs.read(folder(tmp_path, **{"team.yaml": team})).starts == {"r1": Start(0.25, (7.0, 8.0, 9.0))}


def test_altitudes_are_no_measurements_of_the_team(tmp_path: Path) -> None:
    folder(tmp_path)
    without = logs.read(tmp_path)
    log = logs.read(folder(tmp_path, **{"altitude.csv": "t,robot,height,sigma\n0,r1,-1.5,1\n1,r2,1,0.5\n"}))
    assert log.altitudes == (Altitude("r1", 0.0, -1.5, 1.0), Altitude("r2", 1.0, 1.0, 0.5))
    assert (log.measurements, log.skipped, log.terrain) == (without.measurements, without.skipped, None)


def test_settings_of_the_log(tmp_path: Path) -> None:
    team = "robots: [r1, r2]\nradio: {sigma_db: 4}\nantennas: {r1: [0.1, 0, 0.2]}\n"
    log = logs.read(folder(tmp_path, **{"team.yaml": team}))
    assert log.configuration == {"radio": {"sigma_db": 4}, "antennas": {"r1": [0.1, 0, 0.2]}}


def test_read_truth_takes_the_last_row_of_a_stamp(tmp_path: Path) -> None:
    file = tmp_path / "truth.csv"
    file.write_text("t,robot,x,y,theta\n0,r1,1,2,3\n0,r1,4,5,6\n1,r1,7,8,9\n0.5,r2,0,0,0\n")
    truth = logs.read_truth(file, ("r1", "r2", "r3"))
    assert sorted(truth) == ["r1", "r2"]
    np.testing.assert_array_equal(truth["r1"], [[0, 4, 5, 6], [1, 7, 8, 9]])
    with pytest.raises(LogError, match=r"truth\.csv:5: unknown robot `r2`"):
        logs.read_truth(file, ("r1",))


def test_select_keeps_odometry_and_the_named_kinds(tmp_path: Path) -> None:
    folder(
        tmp_path,
        **{"rssi.csv": "t,from,to,rssi\n1,r1,r2,-50\n", "ranges.csv": "t,from,to,range,sigma\n1,r1,r2,3,\n"},
    )
    log = logs.read(tmp_path)
    assert {type(m) for m in logs.select(log, {"range"}).measurements} == {Odometry, Range}
    assert logs.read(tmp_path, {"rssi", "range"}).measurements == log.measurements
    assert {type(m) for m in logs.select(log, set()).measurements} == {Odometry}
    with pytest.raises(LogError, match="has no bearing measurements; it has range, rssi"):
        logs.select(log, {"range", "bearing"})
    with pytest.raises(LogError, match="no measurements are called `ranges`; did you mean `range`"):
        logs.select(log, {"ranges"})


def test_truth_after_the_start_reaches_nothing_the_estimator_gets(tmp_path: Path) -> None:
    truth = "t,robot,x,y,theta\n0,r1,2,2,2\n0.5,r1,9,9,9\n0.7,r2,3,3,3\n0.9,r2,9,9,9\n"
    whole = logs.read(folder(tmp_path, **{"groundtruth.csv": truth}))
    corrupt = logs.read(folder(tmp_path, **{"groundtruth.csv": truth.replace("9,9,9", "-1,77,3")}))
    assert same_for_the_estimator(whole, corrupt)
    assert not np.array_equal(whole.truth["r1"], corrupt.truth["r1"])


MRCLAM = {
    "Barcodes.dat": "# subject barcode\n1 5\n2 14\n6 63\n",
    "Robot1_Odometry.dat": "0.0 0.1 0.2\n0.1 0.3 0.4\n0.1 0.5 0.6\n3.0 0.7 0.8\n3.1 0 0\n",
    "Robot1_Measurement.dat": "0.05 14 3.0 0.5\n0.06 63 3.0 0.1\n0.07 99 3.0 0.1\n0.08 5 3.0 0.1\n",
    "Robot2_Odometry.dat": "0.2 0.1 0.2\n0.3 0.1 0.2\n",
    "Robot2_Measurement.dat": "# nothing seen\n",
    "Robot2_Groundtruth.dat": "0.0 1 1 1\n0.1 2 2 2\n0.25 9 9 9\n0.4 9 9 9\n",
}


def test_mrclam_holds_twists_for_a_second_and_turns_depth_into_range(tmp_path: Path) -> None:
    for name, text in MRCLAM.items():
        (tmp_path / name).write_text(text)
    log = logs.read(tmp_path)
    assert log.robots == ("r1", "r2")
    held = [m for m in log.measurements if isinstance(m, Odometry) and m.robot == "r1" and m.v == 0.5]
    assert (held[0].start, held[-1].end) == (0.1, 1.1)
    assert all(m.end - m.start < 0.1001 for m in held)
    assert tuple(m for m in log.measurements if m not in held) == (
        Range("r1", "r2", 0.05, 3.0 / cos(0.5)),
        Bearing("r1", "r2", 0.05, 0.5),
        Odometry("r1", 0.0, 0.1, 0.1, 0.2),
        Odometry("r2", 0.2, 0.3, 0.1, 0.2),
        Odometry("r1", 3.0, 3.1, 0.7, 0.8),
    )
    assert log.skipped == {"landmark": 1, "unknown barcode": 1, "own barcode": 1}
    assert log.starts == {"r2": Start(0.1, (2.0, 2.0, 2.0))}
    (tmp_path / "Robot2_Groundtruth.dat").write_text(MRCLAM["Robot2_Groundtruth.dat"].replace("9 9 9", "7 7 7"))
    assert same_for_the_estimator(log, logs.read(tmp_path))


PYFG = """\
VERTEX_SE2 10.0 A100 1 2 3
VERTEX_SE2 10.4 A101 9 9 9
VERTEX_SE2 10.4 A102 9 9 9
VERTEX_SE2 10.0 B0 4 5 6
VERTEX_SE2 10.6 B1 9 9 9
VERTEX_XY L0 7 8
EDGE_SE2 10.5 A100 A101 1 0.5 1.5707963267948966 0.01 0 0.001 0.04 0.002 0.09
EDGE_SE2 11.0 A101 A102 1 0 0 0.01 0 0 0.01 0 0.01
EDGE_SE2 10.5 B0 B1 1 0 0 0.01 0 0 0.01 0 0.01
EDGE_RANGE 10.7 A101 L0 3.0 0.04
EDGE_RANGE 10.2 B1 A101 3.0 0.01
"""


def test_pyfg(tmp_path: Path) -> None:
    file = tmp_path / "log.pyfg"
    file.write_text(PYFG)
    log = logs.read(file)
    assert log.robots == ("A", "B", "L")
    steps = [m for m in log.measurements if isinstance(m, Displacement) and m.robot != "L"]
    assert [(m.robot, m.start, m.end) for m in steps] == [
        ("A", 10.0, 10.5),
        ("B", 10.0, 10.5),
        ("A", 10.5, 11.0),
    ]
    assert steps[0].covariance == pytest.approx((0.04, 0.0, -0.002, 0.01, 0.001, 0.09))
    ranges = [m for m in log.measurements if isinstance(m, Range)]
    assert ranges == [Range("B", "A", 10.2, 3.0, 0.1), Range("A", "L", 10.7, 3.0, 0.2)]
    standing = [m for m in log.measurements if isinstance(m, Displacement) and m.robot == "L"]
    assert [(m.start, m.end) for m in standing] == [(10.0, 10.5), (10.5, 11.0)]
    assert all(m.dx == m.dy == m.dtheta == 0 and m.covariance is not None for m in standing)
    np.testing.assert_array_equal(log.truth["L"], [[10, 7, 8, 0], [10.5, 7, 8, 0], [11, 7, 8, 0]])
    assert log.starts["A"] == Start(10.0, (1.0, 2.0, 3.0))
    assert log.skipped == {"ground truth of a repeated stamp": 1}
    file.write_text(PYFG.replace("9 9 9", "-1 77 3"))
    assert same_for_the_estimator(log, logs.read(file))


def test_pyfg_covariance_describes_the_same_pose(tmp_path: Path) -> None:
    """Samples T·Exp(ξ) have, in the frame at the start, the covariance the reader gives."""
    dtheta, spread = 0.7, np.array([[4.0, 1.0, 0.5], [1.0, 2.0, -0.3], [0.5, -0.3, 1.0]]) * 1e-6
    upper = " ".join(str(value) for value in spread[np.triu_indices(3)])
    (tmp_path / "a.pyfg").write_text(
        f"VERTEX_SE2 0 A0 0 0 0\nVERTEX_SE2 1 A1 0 0 0\nEDGE_SE2 1 A0 A1 1 2 {dtheta} {upper}\n"
    )
    (step,) = logs.read(tmp_path / "a.pyfg").measurements
    assert isinstance(step, Displacement)
    xi = np.random.default_rng(0).multivariate_normal(np.zeros(3), spread, 200_000)
    sampled = np.cov(se2.compose([1.0, 2.0, dtheta], se2.exp(xi)).T)
    np.testing.assert_allclose(sampled[np.triu_indices(3)], step.covariance, atol=5e-8)


def test_pyfg_of_edges_stamped_at_their_start(tmp_path: Path) -> None:
    (tmp_path / "a.pyfg").write_text(
        "VERTEX_SE2 0 A0 0 0 0\nVERTEX_SE2 1 A1 0 0 0\nVERTEX_SE2 2 A2 0 0 0\n"
        "EDGE_SE2 0 A0 A1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 A1 A2 1 0 0 1 0 0 1 0 1\n"
    )
    steps = logs.read(tmp_path / "a.pyfg").measurements
    assert [(m.start, m.end) for m in steps if isinstance(m, Displacement)] == [(0.0, 1.0), (1.0, 2.0)]


def test_pyfg_gap_and_several_landmarks(tmp_path: Path) -> None:
    (tmp_path / "a.pyfg").write_text(
        "VERTEX_SE2 0 A0 0 0 0\nVERTEX_SE2 1 A1 0 0 0\nVERTEX_SE2 2 A2 0 0 0\nVERTEX_SE2 3 A3 0 0 0\n"
        "VERTEX_XY L0 1 1\nVERTEX_XY L1 2 2\n# a comment\n"
        "EDGE_SE2 1 A0 A1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 3 A2 A3 1 0 0 1 0 0 1 0 1\n"
    )
    log = logs.read(tmp_path / "a.pyfg")
    assert log.robots == ("A", "L0", "L1")
    steps = [m for m in log.measurements if isinstance(m, Displacement) and m.robot == "A"]
    assert [(m.start, m.end) for m in steps] == [(0.0, 1.0), (2.0, 3.0)]


def test_pyfg_odometry_never_overlaps(tmp_path: Path) -> None:
    """After a gap it begins at the vertex's own stamp, but not before its last end."""
    (tmp_path / "a.pyfg").write_text(
        "VERTEX_SE2 0 A0 0 0 0\nVERTEX_SE2 1 A1 0 0 0\nVERTEX_SE2 1.01 A2 0 0 0\nVERTEX_SE2 2 A3 0 0 0\n"
        "EDGE_SE2 1.02 A0 A1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 2.02 A2 A3 1 0 0 1 0 0 1 0 1\n"
    )
    steps = logs.read(tmp_path / "a.pyfg").measurements
    assert [(m.start, m.end) for m in steps if isinstance(m, Displacement)] == [(0.0, 1.02), (1.02, 2.02)]


def test_a_landmark_wanders_less_than_a_centimetre_in_ten_minutes() -> None:
    from dgorl.logs.pyfg import STANDING_PERIOD, STANDING_SIGMA

    steps = 600 / STANDING_PERIOD
    assert STANDING_SIGMA * hypot(1, 0) * steps**0.5 < 0.01
    assert STANDING_SIGMA * steps**0.5 < pi / 180
