"""Every kind of bad line, in every format, stops with its file, its line and what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import pytest

from dgorl import logs
from dgorl.errors import LogError

FOLDER = {
    "team.yaml": "robots: [r1, r2]\nradio:\n  path_loss_exponent: 3\n",
    "odometry.csv": "t,robot,v,omega\n0.0,r1,0.5,0.1\n0.0,r2,0.5,0.1\n1.0,r1,0.5,0.1\n1.0,r2,0.5,0.1\n",
    "rssi.csv": "t,from,to,rssi\n0.5,r1,r2,-60.0\n1.0,r2,r1,-61\n",
    "ranges.csv": "t,from,to,range,sigma\n0.5,r1,r2,3.0,0.1\n1.0,r2,r1,3.0,\n",
    "bearings.csv": "t,from,to,bearing,sigma\n0.5,r1,r2,1.0,0.1\n1.0,r2,r1,-1.0,\n",
    "groundtruth.csv": "t,robot,x,y,theta\n0.0,r1,0,0,0\n0.0,r2,1,0,0\n1.0,r1,0,0,0\n",
}
INTERVALS = "start,end,robot,dx,dy,dtheta\n0,1,r1,0.5,0,0\n0,1,r2,0.5,0,0\n"
MRCLAM = {
    "Barcodes.dat": "# subject barcode\n1 5\n2 14\n6 63\n",
    "Robot1_Odometry.dat": "# t v omega\n0.0 0.1 0.2\n0.1 0.1 0.2\n",
    "Robot1_Measurement.dat": "0.05 14 3.0 0.1\n0.06 63 3.0 0.1\n0.07 99 3.0 0.1\n0.08 5 3.0 0.1\n",
    "Robot1_Groundtruth.dat": "0.0 0 0 0\n0.1 0 0 0\n",
    "Robot2_Odometry.dat": "0.0 0.1 0.2\n0.1 0.1 0.2\n",
    "Robot2_Measurement.dat": "# none\n",
}
PYFG = """\
VERTEX_SE2 0.0 A0 0 0 0
VERTEX_SE2 0.5 A1 1 0 0
VERTEX_SE2 0.0 B0 0 0 0
VERTEX_SE2 0.5 B1 1 0 0
VERTEX_XY L0 2 2
EDGE_SE2 0.5 A0 A1 1 0 0 0.01 0 0 0.01 0 0.01
EDGE_SE2 0.5 B0 B1 1 0 0 0.01 0 0 0.01 0 0.01
EDGE_RANGE 0.5 A1 B1 3.0 0.01
EDGE_RANGE 0.5 A1 L0 3.0 0.01
"""


def make(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def replace_line(text: str, line: int, new: str) -> str:
    lines = text.split("\n")
    lines[line - 1] = new
    return "\n".join(lines)


def refused(path: Path, *fragments: str) -> None:
    with pytest.raises(LogError) as caught:
        logs.read(path)
    for fragment in fragments:
        assert fragment in str(caught.value)


def test_the_files_that_are_broken_below_are_whole(tmp_path: Path) -> None:
    for name, files in (
        ("dgorl", FOLDER),
        ("mrclam", MRCLAM),
        ("intervals", FOLDER | {"odometry.csv": INTERVALS}),
    ):
        (tmp_path / name).mkdir()
        assert logs.read(make(tmp_path / name, files)).measurements
    (tmp_path / "a.pyfg").write_text(PYFG)
    assert logs.read(tmp_path / "a.pyfg").measurements


@pytest.mark.parametrize(
    ("file", "line", "new", "what"),
    [
        ("odometry.csv", 4, "1.0,r1,0.5", "needs 4 columns, got 3"),
        ("odometry.csv", 4, "1.0,r1,0.5,0.1,9", "needs 4 columns, got 5"),
        ("odometry.csv", 4, "1.0,r1,fast,0.1", "`v` must be a finite number, got `fast`"),
        ("odometry.csv", 4, "1.0,r1,,0.1", "`v` must be a finite number, got ``"),
        ("odometry.csv", 4, "1.0,r1,1_0,0.1", "`v` must be a finite number"),
        ("odometry.csv", 4, "1.0,r1,nan,0.1", "`v` must be a finite number, got `nan`"),
        ("odometry.csv", 4, "1.0,r1,0.5,-inf", "`omega` must be a finite number, got `-inf`"),
        ("odometry.csv", 4, "-1.0,r1,0.5,0.1", "time runs backwards for r1: -1.0 after 0.0"),
        ("odometry.csv", 4, "0.0,r1,0.5,0.1", "time stands still for r1"),
        ("odometry.csv", 4, "1.0,r3,0.5,0.1", "unknown robot `r3`; the robots are r1, r2"),
        ("odometry.csv", 1, "t,robot,v", "the first line must be the header `t,robot,v,omega` or"),
        ("odometry.csv", 1, "0.0,r1,0.5,0.1", "the first line must be the header"),
        ("rssi.csv", 3, "1.0,r2,r1", "needs 4 columns, got 3"),
        ("rssi.csv", 3, "1.0,r2,r1,loud", "`rssi` must be a finite number, got `loud`"),
        ("rssi.csv", 3, "1.0,r2,r1,nan", "`rssi` must be a finite number"),
        ("rssi.csv", 3, "0.4,r2,r1,-60", "time runs backwards: 0.4 after 0.5"),
        ("rssi.csv", 3, "1.0,r2,world,-60", "unknown robot `world`"),
        ("rssi.csv", 3, "1.0,r2,r2,-60", "a robot cannot measure itself: r2"),
        ("rssi.csv", 1, "t,to,from,rssi", "the first line must be the header `t,from,to,rssi`"),
        ("ranges.csv", 3, "1.0,r2,r1,3.0", "needs 5 or 6 columns, got 4"),
        ("ranges.csv", 3, "1.0,r2,r1,-3.0,0.1", "range must not be negative, got -3.0"),
        ("ranges.csv", 3, "1.0,r2,r1,inf,0.1", "`range` must be a finite number, got `inf`"),
        ("ranges.csv", 3, "1.0,r2,r1,3.0,0", "sigma must be at least 1e-06"),
        ("ranges.csv", 3, "1.0,r2,r1,3.0,-1", "sigma must be at least 1e-06"),
        ("ranges.csv", 3, "1.0,r2,r1,3.0,nan", "`sigma` must be a finite number"),
        ("ranges.csv", 3, "1.0,r2,r1,3.0,0.1,first", "`exchange` must be a whole number, got `first`"),
        ("ranges.csv", 3, "0.1,r2,r1,3.0,0.1", "time runs backwards"),
        ("ranges.csv", 3, "1.0,r2,r9,3.0,0.1", "unknown robot `r9`"),
        ("bearings.csv", 3, "1.0,r2,r1", "needs 5 columns, got 3"),
        ("bearings.csv", 3, "1.0,r2,r1,left,", "`bearing` must be a finite number"),
        ("bearings.csv", 3, "1.0,r2,r1,1.0,0", "sigma must be at least 1e-06"),
        ("bearings.csv", 3, "0.1,r2,r1,1.0,0.1", "time runs backwards"),
        ("bearings.csv", 3, "1.0,r1,r1,1.0,0.1", "a robot cannot measure itself"),
        ("groundtruth.csv", 4, "1.0,r1,0,0", "needs 5 columns, got 4"),
        ("groundtruth.csv", 4, "1.0,r1,0,0,nan", "`theta` must be a finite number"),
        ("groundtruth.csv", 4, "-1.0,r1,0,0,0", "time runs backwards for r1"),
        ("groundtruth.csv", 4, "1.0,r7,0,0,0", "unknown robot `r7`"),
    ],
)
def test_dgorl_folder(tmp_path: Path, file: str, line: int, new: str, what: str) -> None:
    make(tmp_path, FOLDER | {file: replace_line(FOLDER[file], line, new)})
    refused(tmp_path, f"{file}:{line}: ", what)


@pytest.mark.parametrize(
    ("new", "what"),
    [
        ("1,2,r1,0.5,0", "needs 6 or 12 columns, got 5"),
        ("1,2,r1,0.5,0,0,1,0,0,1,0", "needs 6 or 12 columns, got 11"),
        ("2,1,r1,0.5,0,0", "odometry must end after it starts"),
        ("1,1,r1,0.5,0,0", "odometry must end after it starts"),
        ("0.5,2,r1,0.5,0,0", "time runs backwards for r1: starts at 0.5, before the last end 1.0"),
        ("1,2,r1,0.5,0,0,1,0,0,0,0,1", "covariance must be positive definite"),
        ("1,2,r1,0.5,0,0,1,0,0,nan,0,1", "`cyy` must be a finite number"),
        ("1,2,r1,0.5,0,0,1,,0,1,0,1", "`cxy` must be a finite number, got ``"),
    ],
)
def test_odometry_intervals(tmp_path: Path, new: str, what: str) -> None:
    make(tmp_path, FOLDER | {"odometry.csv": INTERVALS + new + "\n"})
    refused(tmp_path, "odometry.csv:4: ", what)


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("", ":1: ", "robots: [r1, r2]"),
        ("- r1\n", ":1: ", "got no mapping"),
        ("epochs: {}\n", ": ", "`robots` must list"),
        ("robots: []\n", ":1: ", "`robots` must list"),
        ("robots: [1, 2]\n", ":1: ", "`1` cannot be a robot's name"),
        ("robots: ['a,b', c]\n", ":1: ", "`a,b` cannot be a robot's name"),
        ("robots: [world, r2]\n", ":1: ", "`world` cannot be a robot's name"),
        ("robots: [r1, r1]\n", ":1: ", "robot `r1` is listed twice"),
        ("robots: [r1, r2]\nrobots: [r1, r2]\n", ":2: ", "`robots` stands here twice (first in line 1)"),
        ("robots: [r1, r2\nradio: {}\n", ":2: ", "not YAML"),
        ("robots: [r1, r2]\nepoch: {}\n", ":2: ", "unknown key `epoch`; did you mean `epochs`?"),
        ("robots: [r1, r2]\nepochs: {r3: [1]}\n", ":2: ", "`epochs` names an unknown robot `r3`"),
        ("robots: [r1, r2]\nepochs: {r1: 1}\n", ":2: ", "must list the times"),
        ("robots: [r1, r2]\nepochs:\n  r1: [2, 1]\n", ":3: ", "time runs backwards"),
        ("robots: [r1, r2]\nepochs:\n  r1: [.nan]\n", ":3: ", "finite numbers, got nan"),
        ("robots: [r1, r2]\nstart: [0, 0, 0]\n", ":2: ", "`start` must map robots"),
        ("robots: [r1, r2]\nstart:\n  r1: [0, 0]\n", ":3: ", "`start.r1` must be [x, y, theta]"),
        ("robots: [r1, r2]\nstart:\n  r1: [0, 0, .inf]\n", ":3: ", "finite numbers, got inf"),
        ("robots: [r1, r2]\nstart:\n  r5: [0, 0, 0]\n", ":3: ", "unknown robot `r5`"),
        ("robots: [r1, r2]\nstart_stamp: 0\n", ":2: ", "`start_stamp` needs `start`"),
        ("robots: [r1, r2]\nstart: {}\nstart_stamp: now\n", ":3: ", "finite numbers, got 'now'"),
        ("robots: [r1, r2]\nradio:\n  path_los_exponent: 3\n", ":3: ", "did you mean `path_loss_exponent`?"),
        ("robots: [r1, r2]\nradio:\n  sigma_db: loud\n", ":3: ", "`radio.sigma_db` must be a number"),
        ("robots: [r1, r2]\nranging: 3\n", ":2: ", "`ranging` must be a mapping"),
        ("robots: [r1, r2]\nradio:\n  sigma_db: -1\n", ":3: ", "radio.sigma_db must be positive"),
        ("robots: [r1, r2]\nantennas:\n  r1: [0, 0]\n", ":3: ", "`antennas.r1` must be [x, y, z]"),
        ("robots: [r1, r2]\nantennas:\n  r5: [0, 0, 0]\n", ":3: ", "unknown robot `r5`"),
        ("robots: [r1, r2]\nradio:\n  width: 0\n", ": ", "kernel widths must be positive"),
        ("robots: [r1, r2]\nmotion:\n  linear_scale: 0\n", ":2: ", "motion scales must be positive"),
        ("robots: [r1, r2]\nwindow: 30\n", ":2: ", "unknown key `window`"),
    ],
)
def test_team(tmp_path: Path, text: str, where: str, what: str) -> None:
    make(tmp_path, FOLDER | {"team.yaml": text})
    refused(tmp_path, f"team.yaml{where}", what)


@pytest.mark.parametrize(
    ("file", "line", "new", "what"),
    [
        ("Barcodes.dat", 3, "2", "needs 2 columns (subject barcode), got 1"),
        ("Barcodes.dat", 3, "2 5", "barcode 5 stands here twice"),
        ("Barcodes.dat", 3, "two 14", "`subject` must be a whole number, got `two`"),
        ("Robot1_Odometry.dat", 3, "0.1 0.1", "needs 3 columns (t v omega), got 2"),
        ("Robot1_Odometry.dat", 3, "0.1 0.1 x", "`omega` must be a finite number, got `x`"),
        ("Robot1_Odometry.dat", 3, "0.1 nan 0", "`v` must be a finite number"),
        ("Robot1_Measurement.dat", 2, "0.06 14 3.0", "needs 4 columns"),
        ("Robot1_Measurement.dat", 2, "0.06 14 -3.0 0.1", "range must not be negative"),
        ("Robot1_Measurement.dat", 2, "0.06 14 3.0 inf", "`bearing` must be a finite number"),
        ("Robot1_Measurement.dat", 2, "0.06 14 3.0 1.6", "behind the camera"),
        ("Robot1_Measurement.dat", 2, "0.06 14.5 3.0 0.1", "`barcode` must be a whole number"),
        ("Robot1_Measurement.dat", 2, "0.04 14 3.0 0.1", "time runs backwards"),
        ("Robot1_Groundtruth.dat", 2, "0.1 0 0", "needs 4 columns"),
        ("Robot1_Groundtruth.dat", 2, "0.1 0 0 nan", "`theta` must be a finite number"),
        ("Robot1_Groundtruth.dat", 2, "-0.1 0 0 0", "time runs backwards"),
    ],
)
def test_mrclam(tmp_path: Path, file: str, line: int, new: str, what: str) -> None:
    make(tmp_path, MRCLAM | {file: replace_line(MRCLAM[file], line, new)})
    refused(tmp_path, f"{file}:{line}: ", what)


@pytest.mark.parametrize(
    ("line", "new", "what"),
    [
        (1, "VERTEX_SE2 0.0 A0 0 0", "VERTEX_SE2 needs 6 columns, got 5 (theta missing)"),
        (1, "VERTEX_SE2 0.0 A0 0 0 nan", "`theta` must be a finite number"),
        (1, "VERTEX_SE2 0.0 12 0 0 0", "`pose` must be letters and a number like A12"),
        (2, "VERTEX_SE2 -0.5 A1 1 0 0", "time runs backwards for A"),
        (2, "VERTEX_SE2 0.5 A0 1 0 0", "vertex A0 stands here twice"),
        (5, "VERTEX_XYZ L0 2 2 2", "cannot use VERTEX_XYZ; did you mean `VERTEX_XY`?"),
        (5, "VERTEX_XY L0 2", "VERTEX_XY needs 4 columns, got 3 (y missing)"),
        (6, "EDGE_SE2_XYZ 0.5 A0 L0 1 0 0.01 0 0.01", "cannot use EDGE_SE2_XYZ; did you mean `EDGE_SE2_XY`?"),
        (6, "EDGE_SE2_XY 0.5 A0 L0 1 0 0.01 0", "EDGE_SE2_XY needs 9 columns, got 8 (yy missing)"),
        (6, "EDGE_SE2 0.5 A0 A1 1 0 0 0.01 0 0 0.01 0", "needs 13 columns, got 12 (tt missing)"),
        (6, "EDGE_SE2 0.5 A0 B1 1 0 0 0.01 0 0 0.01 0 0.01", "must join a vertex to the robot's next one"),
        (6, "EDGE_SE2 0.5 A1 A0 1 0 0 0.01 0 0 0.01 0 0.01", "must join a vertex to the robot's next one"),
        (6, "EDGE_SE2 0.5 A0 A7 1 0 0 0.01 0 0 0.01 0 0.01", "must join a vertex to the robot's next one"),
        (6, "EDGE_SE2 0.5 A0 A1 1 0 0 0.01 0 0 -0.01 0 0.01", "covariance must be positive definite"),
        (6, "EDGE_SE2 0.5 A0 A1 1 0 x 0.01 0 0 0.01 0 0.01", "`dtheta` must be a finite number"),
        (7, "EDGE_SE2 0.5 A0 A1 1 0 0 0.01 0 0 0.01 0 0.01", "odometry from A0 to A1 stands here twice"),
        (8, "EDGE_RANGE 0.5 A1 B1 3.0", "EDGE_RANGE needs 6 columns, got 5 (variance missing)"),
        (8, "EDGE_RANGE 0.5 A1 B1 -3.0 0.01", "range must not be negative"),
        (8, "EDGE_RANGE 0.5 A1 B1 3.0 0", "`variance` must be positive"),
        (8, "EDGE_RANGE 0.5 A1 B9 3.0 0.01", "no vertex is called B9"),
        (8, "EDGE_RANGE 0.5 A1 A0 3.0 0.01", "a robot cannot measure itself"),
        (9, "EDGE_RANGE 0.4 A1 B1 3.0 0.01", "time runs backwards for A and B"),
    ],
)
def test_pyfg(tmp_path: Path, line: int, new: str, what: str) -> None:
    file = tmp_path / "log.pyfg"
    file.write_text(replace_line(PYFG, line, new))
    refused(file, f"log.pyfg:{line}: ", what)


@pytest.mark.parametrize("name", FOLDER)
def test_not_utf8(tmp_path: Path, name: str) -> None:
    make(tmp_path, FOLDER)
    (tmp_path / name).write_bytes(FOLDER[name].encode() + b"\xff\xfe\n")
    refused(tmp_path, f"{name}:{FOLDER[name].count(chr(10)) + 1}: not UTF-8")


@pytest.mark.parametrize("name", ["rssi.csv", "ranges.csv", "bearings.csv", "odometry.csv", "groundtruth.csv"])
def test_empty_file(tmp_path: Path, name: str) -> None:
    make(tmp_path, FOLDER | {name: ""})
    refused(tmp_path, f"{name}:1: the first line must be the header", "it is empty")


def test_nothing_there(tmp_path: Path) -> None:
    refused(tmp_path / "nowhere", "nowhere: no such file or folder")
    refused(tmp_path, "an empty folder: a dgorl log has a team.yaml")
    (tmp_path / "notes.txt").write_text("hello")
    refused(tmp_path, "not a log: a dgorl log has a team.yaml")
    refused(tmp_path / "notes.txt", "notes.txt: not a log")


def test_no_odometry(tmp_path: Path) -> None:
    make(tmp_path, FOLDER | {"odometry.csv": "t,robot,v,omega\n0.0,r1,0.5,0.1\n"})
    refused(tmp_path, "odometry.csv: holds no odometry")
    (tmp_path / "odometry.csv").unlink()
    refused(tmp_path, "odometry.csv: no such file; the log needs it")
    (tmp_path / "empty.pyfg").write_text("")
    refused(tmp_path / "empty.pyfg", "empty.pyfg: holds no odometry")


def test_no_odometry_in_mrclam(tmp_path: Path) -> None:
    make(tmp_path, {"Barcodes.dat": "1 5\n"})
    refused(tmp_path, "holds no RobotN_Odometry.dat")
    make(tmp_path, {"Robot1_Odometry.dat": "# none\n", "Robot1_Measurement.dat": "# none\n"})
    refused(tmp_path, "holds no odometry")
    (tmp_path / "Robot1_Measurement.dat").unlink()
    refused(tmp_path, "Robot1_Measurement.dat: no such file; the log needs it")


def test_nothing_between_robots(tmp_path: Path) -> None:
    make(tmp_path, {name: FOLDER[name] for name in ("team.yaml", "odometry.csv")})
    refused(tmp_path, "needs one of rssi.csv, ranges.csv, bearings.csv")


def test_odometry_of_pyfg_runs_backwards(tmp_path: Path) -> None:
    edges = "EDGE_SE2 0.5 A0 A1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 0.45 A1 A2 1 0 0 1 0 0 1 0 1\n"
    vertices = "".join(f"VERTEX_SE2 {0.5 * k} A{k} 0 0 0\n" for k in range(3))
    (tmp_path / "a.pyfg").write_text(vertices + edges)
    refused(tmp_path / "a.pyfg", "a.pyfg:5: odometry must end after it starts, got 0.5 to 0.45")


def test_landmark_and_robot_share_a_letter(tmp_path: Path) -> None:
    (tmp_path / "a.pyfg").write_text(PYFG.replace("L0", "A7"))
    refused(tmp_path / "a.pyfg", "landmark A7 and robot A share a letter")
