"""Stamps that do not belong together, in every file of every format, are refused by file and line."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from dgorl import logs
from dgorl.errors import QUOTED, LogError
from dgorl.logs.stamps import APART
from dgorl.measurements import Displacement, Odometry
from tests.recordings import case
from tests.unit.test_logs_strict import FOLDER, MRCLAM, PYFG, make, refused, replace_line

UNIX = 1_650_000_000.0
ALTITUDE = "t,robot,height,sigma\n0.5,r1,1,1\n1.0,r2,1,1\n"
TWISTS = "start,end,robot,v,omega\n0.0,0.5,r1,0.5,0\n0.0,0.5,r2,0.5,0\n0.5,1.0,r1,0.5,0\n0.5,1.0,r2,0.5,0\n"
STEPS = "start,end,robot,dx,dy,dtheta\n0.0,0.5,r1,0.5,0,0\n0.0,0.5,r2,0.5,0,0\n0.5,1.0,r1,0.5,0,0\n"
WHOLE = {**FOLDER, "altitude.csv": ALTITUDE}


def later(text: str, by: float, columns: int = 1) -> str:
    """A table whose stamps are all later by so much; ``columns`` of them in a row."""
    header, *rows = text.rstrip("\n").split("\n")
    moved = []
    for row in rows:
        fields = row.split(",")
        moved.append(",".join([*(repr(float(f) + by) for f in fields[:columns]), *fields[columns:]]))
    return "\n".join([header, *moved]) + "\n"


def on_unix_time(files: dict[str, str]) -> dict[str, str]:
    return {n: later(t, UNIX, 1 + t.startswith("start")) if n.endswith(".csv") else t for n, t in files.items()}


def test_all_on_unix_time_is_read(tmp_path: Path) -> None:
    assert logs.read(make(tmp_path, on_unix_time(WHOLE))).measurements


@pytest.mark.parametrize("name", ["odometry.csv", "rssi.csv", "ranges.csv", "bearings.csv", "altitude.csv"])
@pytest.mark.parametrize("stamp", [0.0, 12.5, UNIX - 1.01 * APART, -5e8])
@pytest.mark.parametrize("odometry", [FOLDER["odometry.csv"], TWISTS, STEPS], ids=["held", "twists", "steps"])
def test_one_row_of_a_folder(tmp_path: Path, name: str, stamp: float, odometry: str) -> None:
    files = on_unix_time({**WHOLE, "odometry.csv": odometry})
    fields = files[name].split("\n")[1].split(",")
    width = 2 if fields[1][0].isdigit() else 1
    row = ",".join([*(repr(stamp + 0.5 * k) for k in range(width)), *fields[width:]])
    make(tmp_path, files | {name: replace_line(files[name], 2, row)})
    refused(
        tmp_path, f"{name}:2: ", f" {stamp!r} lies ", "from the rest (odometry 16500000", "put all files on one clock"
    )


@pytest.mark.parametrize("name", ["rssi.csv", "ranges.csv", "bearings.csv", "altitude.csv"])
@pytest.mark.parametrize("by", [UNIX, 1.5 * APART, -1e6])
def test_a_whole_file_of_a_folder(tmp_path: Path, name: str, by: float) -> None:
    make(tmp_path, WHOLE | {name: later(WHOLE[name], by)})
    refused(tmp_path, f"{name}:2: t {0.5 + by!r} lies ", "from the rest (odometry 0 to 1)")


def test_the_odd_one_out_is_named_not_the_rest(tmp_path: Path) -> None:
    """Odometry that is alone on its clock is what has to be put right."""
    others = on_unix_time({name: text for name, text in WHOLE.items() if name != "odometry.csv"})
    make(tmp_path, {**WHOLE, **others})
    refused(tmp_path, "odometry.csv:2: t 0.0 lies 1.7e9 s from the rest (rssi 1650000000.5 to 1650000001)")


def test_a_pause_of_hours_is_a_pause(tmp_path: Path) -> None:
    odometry = FOLDER["odometry.csv"] + "80000.0,r1,0.5,0.1\n80000.5,r1,0.5,0.1\n"
    log = logs.read(make(tmp_path, FOLDER | {"odometry.csv": odometry}))
    ends = [m.end for m in log.measurements if isinstance(m, Odometry) and m.robot == "r1" and m.end < 80000]
    assert max(ends) == 2.0
    assert len(log.measurements) < 60


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        (f"start: {{r1: [0, 0, 0]}}\nstart_stamp: {UNIX}\n", 3, "`start_stamp.r1` 1650000000.0 lies"),
        (f"start: {{r1: [0, 0, 0]}}\nstart_stamp:\n  r1: {-UNIX}\n", 4, "`start_stamp.r1` -1650000000.0 lies"),
        (f"epochs:\n  r1: [0.5]\n  r2: [0.5, {UNIX}]\n", 4, "`epochs.r2` 1650000000.0 lies"),
    ],
)
def test_times_of_the_team(tmp_path: Path, text: str, line: int, what: str) -> None:
    make(tmp_path, FOLDER | {"team.yaml": "robots: [r1, r2]\n" + text})
    refused(tmp_path, f"team.yaml:{line}: ", what, "from the odometry (0 to 1)")


@pytest.mark.parametrize("by", [UNIX, -3600.0, 7200.0, 1e18])
def test_truth_of_another_clock(tmp_path: Path, by: float) -> None:
    """That of a whole file and that of one robot; a file given beside the log as well."""
    truth = later(FOLDER["groundtruth.csv"], by)
    refused(
        make(tmp_path, FOLDER | {"groundtruth.csv": truth}), "groundtruth.csv:2: ground truth of r1 from ", "does not"
    )
    lines = FOLDER["groundtruth.csv"].split("\n")
    of_one = "\n".join([*lines[:2], f"{by!r},r2,1,0,0", lines[3]]) + "\n"
    refused(make(tmp_path, {"groundtruth.csv": of_one}), "groundtruth.csv:3: ground truth of r2", "does not overlap")
    with pytest.raises(LogError, match="does not overlap the odometry"):
        logs.read_truth(tmp_path / "groundtruth.csv", ("r1", "r2"), (0.0, 1.0))


def test_one_stray_row_of_truth(tmp_path: Path) -> None:
    stray = FOLDER["groundtruth.csv"].replace("0.0,r1", f"{-UNIX!r},r1", 1)
    refused(make(tmp_path, FOLDER | {"groundtruth.csv": stray}), "groundtruth.csv:2: t -1650000000.0 lies")


def test_truth_of_the_start_alone(tmp_path: Path) -> None:
    truth = "t,robot,x,y,theta\n-8,r1,1,2,0\n-8,r2,3,4,0\n"
    assert logs.read(make(tmp_path, FOLDER | {"groundtruth.csv": truth})).starts["r2"].pose == (3.0, 4.0, 0.0)


@pytest.mark.parametrize(
    ("file", "line", "row"),
    [
        ("Robot1_Odometry.dat", 2, f"{-UNIX} 0.1 0.2"),
        ("Robot2_Odometry.dat", 2, f"{UNIX} 0.1 0.2"),
        ("Robot1_Measurement.dat", 4, f"{UNIX} 14 3.0 0.1"),
        ("Robot1_Measurement.dat", 4, f"{UNIX} 63 3.0 0.1"),
    ],
)
def test_mrclam(tmp_path: Path, file: str, line: int, row: str) -> None:
    make(tmp_path, MRCLAM | {file: replace_line(MRCLAM[file], line, row)})
    refused(tmp_path, f"{file}:{line}: t ", "lies 1.6e9 s from the rest (odometry 0 to 0.1)")


def test_mrclam_truth(tmp_path: Path) -> None:
    make(tmp_path, MRCLAM | {"Robot1_Groundtruth.dat": f"{UNIX} 0 0 0\n{UNIX + 1} 0 0 0\n"})
    refused(tmp_path, "Robot1_Groundtruth.dat:1: ground truth from", "does not overlap the odometry")


@pytest.mark.parametrize("line", [2, 6, 8, 9])
def test_pyfg(tmp_path: Path, line: int) -> None:
    """A vertex, an edge of odometry, ranges between robots and to a landmark, which reports as long as the log is."""
    fields = PYFG.split("\n")[line - 1].split()
    fields[1] = repr(UNIX)
    file = tmp_path / "log.pyfg"
    file.write_text(replace_line(PYFG, line, " ".join(fields)))
    refused(file, f"log.pyfg:{line}: t 1650000000.0 lies")


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("stamp0_range", "ranges.csv:2: t 0.0 lies 1.7e9 s from the rest (odometry 1700000000 to 170000000"),
        ("stamp0_held", "odometry.csv:2: t 0.0 lies 1.7e9 s from the rest (odometry 1700000000 to"),
        ("two_timebases", "ranges.csv:2: t 1700000000.5 lies 1.7e9 s from the rest (odometry 0 to"),
        ("truth_ns", "groundtruth.csv:2: ground truth of a"),
        ("truth_other_clock", "groundtruth.csv:2: ground truth of a from 0 to 80 s does not overlap the odometry"),
        (
            "zero_covariance",
            "odometry.csv:2: covariance must be positive definite; leave the six empty if it is unknown",
        ),
    ],
)
def test_cases(name: str, what: str) -> None:
    refused(case(name), what)


@pytest.mark.parametrize("begin", [0.0, 1_234_567_890.0, 9.9e9])
@pytest.mark.parametrize("period", [0.1, 1 / 3, 0.2, 0.7])
def test_overlaps_of_rounding_size_are_none(tmp_path: Path, begin: float, period: float) -> None:
    """``start = k*p``, ``end = start + p``: a row may begin one rounding step before the last one's end."""
    rows = [(begin + k * period, begin + k * period + period) for k in range(200)]
    assert begin > 1e6 or any(b[0] < a[1] for a, b in pairwise(rows))
    text = "start,end,robot,v,omega\n" + "".join(f"{a!r},{b!r},r1,0.5,0.1\n" for a, b in rows)
    ranges = f"t,from,to,range,sigma\n{begin + 1},r1,r2,3,\n"
    files = {"team.yaml": "robots: [r1, r2]\n", "odometry.csv": text, "ranges.csv": ranges}
    read = [m for m in logs.read(make(tmp_path, files)).measurements if isinstance(m, Odometry)]
    assert [(m.start, m.end) for m in read] == rows


def test_real_overlaps_are_refused(tmp_path: Path) -> None:
    text = f"start,end,robot,v,omega\n{UNIX},{UNIX + 1},r1,0.5,0\n{UNIX + 0.99},{UNIX + 2},r1,0.5,0\n"
    refused(make(tmp_path, FOLDER | {"odometry.csv": text}), "odometry.csv:3: time runs backwards for r1")


@pytest.mark.parametrize(("overlap", "fine"), [(0.0003, True), (0.001, True), (0.004, False)])
def test_stamps_in_whole_milliseconds_overlap_by_one(tmp_path: Path, overlap: float, fine: bool) -> None:
    """Nothing of a row is cut off: its displacement is that of all of it."""
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "team.yaml").write_text("robots: [a, b]\n")
    rows = [f"{0.1 * k - (overlap if k else 0.0):.4f},{0.1 * (k + 1):.4f},a,0.05,0,0.01" for k in range(20)]
    (folder / "odometry.csv").write_text("\n".join(["start,end,robot,dx,dy,dtheta", *rows]) + "\n")
    (folder / "ranges.csv").write_text("t,from,to,range,sigma\n1.0,a,b,3.0,0.1\n")
    if not fine:
        with pytest.raises(LogError, match=r"odometry.csv:3: time runs backwards for a"):
            logs.read(folder)
        return
    found = [m for m in logs.read(folder).measurements if isinstance(m, Displacement)]
    assert [m.dx for m in found] == [0.05] * 20
    assert [m.start for m in found[1:]] == [m.end for m in found[:-1]]


@pytest.mark.parametrize("name", ["ulp_overlap", "ulp_overlap_epoch"])
def test_cases_of_rounding(name: str) -> None:
    assert len([m for m in logs.read(case(name)).measurements if isinstance(m, Odometry)]) == 40


LONG = "x\x1b[31m" * 4000


@pytest.mark.parametrize(
    ("file", "line", "new"),
    [
        ("odometry.csv", 1, LONG),
        ("odometry.csv", 3, f"0.0,{LONG},0.5,0.1"),
        ("odometry.csv", 3, f"0.0,r2,{LONG},0.1"),
        ("ranges.csv", 2, f"0.5,r1,r2,3.0,0.1,{LONG}"),
        ("rssi.csv", 2, f"0.5,r1,r2,{LONG}"),
        ("groundtruth.csv", 2, f"0.0,{LONG},0,0,0"),
        ("team.yaml", 1, f"robots: [r1, '{'y' * 20000}\\e[31m']"),
        ("team.yaml", 1, f'robots: [r1, "\\e{"y" * 20000}"]'),
        ("team.yaml", 2, f"? {'z' * 20000}\n: 3\nradio:"),
        ("team.yaml", 3, f"  path_loss_exponent: {'z' * 20000}"),
        ("team.yaml", 3, f"  {'z' * 2000}: 3"),
    ],
)
def test_what_is_quoted_is_short_and_escaped(tmp_path: Path, file: str, line: int, new: str) -> None:
    make(tmp_path, FOLDER | {file: replace_line(FOLDER[file], line, new)})
    with pytest.raises(LogError) as caught:
        logs.read(tmp_path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(tmp_path)) + 320 + QUOTED


def test_what_pyfg_and_mrclam_quote(tmp_path: Path) -> None:
    for text in (
        f"{'V' * 9000}\x07 1 2\n",
        f"VERTEX_SE2 0 {'A' * 9000} 0 0 0\n",
        f"EDGE_SE2 {'9' * 9000}x A0 A1" + " 1" * 9,
    ):
        (tmp_path / "a.pyfg").write_text(text)
        with pytest.raises(LogError) as caught:
            logs.read(tmp_path / "a.pyfg")
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < len(str(tmp_path)) + 200 + QUOTED
    make(tmp_path, MRCLAM | {"Robot1_Odometry.dat": f"0.0 {LONG} 0\n"})
    with pytest.raises(LogError) as caught:
        logs.read(tmp_path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(tmp_path)) + 200 + QUOTED


def test_lines_that_end_with_cr_alone() -> None:
    with pytest.raises(LogError, match=r"odometry.csv:1: .*save it with LF or CRLF") as caught:
        logs.read(case("cr_only"))
    assert len(str(caught.value)) < 500


def test_a_backward_stamp_of_mrclam_is_one_row_less(tmp_path: Path) -> None:
    """As the data set has it: single rows, or several within the time that a twist is held."""
    stamps = [5.0, 5.1, 4.0, 5.2, 5.3, 5.25, 5.28, 5.4, 5.5]
    rows = "# t v omega\n" + "".join(f"{t} {k} 0\n" for k, t in enumerate(stamps))
    log = logs.read(make(tmp_path, MRCLAM | {"Robot1_Odometry.dat": rows}))
    own = [(m.start, m.v) for m in log.measurements if isinstance(m, Odometry) and m.robot == "r1"]
    assert own == [(5.0, 0.0), (5.1, 1.0), (5.2, 3.0), (5.3, 4.0), (5.4, 7.0)]
    reason = "odometry stamped before the row it follows (Robot1_Odometry.dat:4 and after)"
    assert log.skipped == {"landmark": 1, "own barcode": 1, "unknown barcode": 1, reason: 3}
    assert log.rows == {"r1": 6, "r2": 2}


def test_a_clock_that_was_set_back_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"{t} 0.1 0\n" for t in (5.0, 5.1, 3.0, 3.1, 3.2))
    refused(make(tmp_path, MRCLAM | {"Robot1_Odometry.dat": rows}), "Robot1_Odometry.dat:4: time runs backwards: 3.1")


def test_rows_of_the_other_files_of_mrclam_stay_in_order(tmp_path: Path) -> None:
    rows = "0.08 14 3.0 0.1\n0.07 14 3.0 0.1\n"
    refused(make(tmp_path, MRCLAM | {"Robot1_Measurement.dat": rows}), "Robot1_Measurement.dat:2: time runs backwards")


def test_long_odometry_of_pyfg_is_a_gap(tmp_path: Path) -> None:
    text = PYFG.replace("VERTEX_SE2 0.5 A1", "VERTEX_SE2 61.5 A1").replace("EDGE_SE2 0.5 A0 A1", "EDGE_SE2 61.5 A0 A1")
    text += "VERTEX_SE2 62 A2 1 0 0\nEDGE_SE2 62 A1 A2 1 0 0 0.01 0 0 0.01 0 0.01\n"
    file = tmp_path / "log.pyfg"
    file.write_text(text)
    log = logs.read(file)
    steps = [(m.start, m.end) for m in log.measurements if isinstance(m, Displacement) and m.robot == "A"]
    assert steps == [(61.5, 62.0)]
    assert log.skipped == {"odometry over more than 60 s at once: a gap": 1}


def test_landmarks_that_are_only_seen_are_left_out(tmp_path: Path) -> None:
    text = PYFG + "VERTEX_XY M1 3 3\nEDGE_SE2_XY 0.5 A1 M1 1 1 0.01 0 0.01\nEDGE_SE2_XY 0.5 A1 L0 1 1 0.01 0 0.01\n"
    file = tmp_path / "log.pyfg"
    file.write_text(text)
    log = logs.read(file)
    assert log.robots == ("A", "B", "L")
    assert log.skipped == {"EDGE_SE2_XY: where a landmark was seen": 2}
