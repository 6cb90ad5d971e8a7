"""What ``dgorl run`` writes: formats, round trips, sameness, and what is in the way."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dgorl.configuration import Configuration, as_dict
from dgorl.errors import DgorlError
from dgorl.estimate import PeerHypothesis, Status
from dgorl.evaluation import output
from dgorl.evaluation.records import PairRecord, Records

HEADER = "t,x,y,theta,var_xx,var_xy,var_xt,var_yy,var_yt,var_tt,status,probability,age,reason,resolve_by"
TANGENT = ",".join(f"var_tangent_{name}" for name in ("xx", "xy", "xt", "yy", "yt", "tt"))
STATUS = (Status.ISOLATED, Status.AMBIGUOUS, Status.POSITION, Status.TRACKED)


@pytest.fixture
def record() -> PairRecord:
    rng = np.random.default_rng(3)
    pose = rng.normal(size=(4, 3))
    root = rng.normal(size=(4, 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    pose[0], covariance[0] = np.nan, np.nan
    truth = pose + 0.1
    truth[3] = np.nan
    return PairRecord(
        ego="r1", peer="r2", t=np.array([0.1, 0.6, 1.1, 1.6]), pose=pose, covariance=covariance,
        status=STATUS, probability=np.array([0.0, 0.4, 1.0, 1.0]),
        age=np.array([np.inf, 0.1, 0.1, 0.2]),
        reason=("nothing heard", 'two places, "left" or right', "", ""),
        resolve_by=("", "turn, then go on", "", ""),
        truth=truth, tangent=2.0 * covariance,
    )  # fmt: skip


def records(record: PairRecord) -> Records:
    return Records(("r1",), record.t, {"r1": np.full(4, 0.001)}, {("r1", "r2"): record})


def write(record: PairRecord, folder: Path) -> dict[str, object]:
    return output.write(records(record), Configuration(), {"log": "x", "robots": ["r1", "r2"]}, folder)


def test_csv_reads_back_to_the_last_bit(record: PairRecord, tmp_path: Path) -> None:
    write(record, tmp_path)
    text = (tmp_path / "relative/r1/r2.csv").read_text(encoding="utf-8")
    assert text.splitlines()[0] == f"{HEADER},{TANGENT}"
    rows = list(csv.DictReader(text.splitlines()))
    assert [r["status"] for r in rows] == ["isolated", "ambiguous", "position", "tracked"]
    assert [r["reason"] for r in rows] == list(record.reason)
    assert [r["resolve_by"] for r in rows] == list(record.resolve_by)
    numbers = HEADER.split(",")[:10]
    assert rows[0]["t"] == "0.1"
    tangent = TANGENT.split(",")
    assert all(rows[0][name] == "" for name in (*numbers[1:], *tangent))
    for k in (1, 2, 3):
        upper = record.covariance[k][np.triu_indices(3)]
        assert [float(rows[k][name]) for name in numbers] == [record.t[k], *record.pose[k], *upper]
        assert [float(rows[k][name]) for name in tangent] == (2.0 * upper).tolist()
        assert float(rows[k]["probability"]) == record.probability[k]
        assert float(rows[k]["age"]) == record.age[k]


def test_hypotheses_read_back_by_rank(record: PairRecord, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(2, 3, 3))
    alive = tuple(
        PeerHypothesis(p, rng.normal(size=3), r @ r.T, 3.0 * (r @ r.T))
        for p, r in zip((0.6, 0.1 + 0.2), root, strict=True)
    )
    write(replace(record, hypotheses={1: alive}), tmp_path)
    text = (tmp_path / "hypotheses/r1/r2.csv").read_text(encoding="utf-8")
    header = "t,rank,probability,x,y,theta,var_xx,var_xy,var_xt,var_yy,var_yt,var_tt"
    assert text.splitlines()[0] == f"{header},{TANGENT}"
    rows = np.loadtxt(text.splitlines()[1:], delimiter=",")
    for rank, (row, hypothesis) in enumerate(zip(rows, alive, strict=True), 1):
        assert hypothesis.tangent_covariance is not None
        upper, tangent = (c[np.triu_indices(3)] for c in (hypothesis.covariance, hypothesis.tangent_covariance))
        assert row.tolist() == [record.t[1], rank, hypothesis.probability, *hypothesis.pose, *upper, *tangent]
    write(record, tmp_path)
    assert not (tmp_path / "hypotheses").exists()


def test_tum_holds_located_poses_as_quaternions(record: PairRecord, tmp_path: Path) -> None:
    write(record, tmp_path)
    rows = np.loadtxt(tmp_path / "relative/r1/r2.tum")
    assert rows.shape == (2, 8)
    assert rows[:, 0].tolist() == [1.1, 1.6]
    assert (rows[:, 1:3] == record.pose[2:, :2]).all()
    assert (rows[:, 3:6] == 0).all()
    assert 2 * np.arctan2(rows[:, 6], rows[:, 7]) == pytest.approx(record.pose[2:, 2])
    truth = np.loadtxt(tmp_path / "relative/r1/r2.truth.tum")
    assert truth[:, 0].tolist() == [0.6, 1.1]
    assert (truth[:, 1:3] == record.truth[1:3, :2]).all()


def test_no_truth_no_truth_file(record: PairRecord, tmp_path: Path) -> None:
    write(replace(record, truth=np.full((4, 3), np.nan)), tmp_path)
    assert sorted(p.name for p in (tmp_path / "relative/r1").iterdir()) == ["r2.csv", "r2.tum"]
    assert json.loads((tmp_path / "summary.json").read_text())["team"]["position_rmse_m"] is None


def test_summary_has_the_names_of_the_interface(record: PairRecord, tmp_path: Path) -> None:
    summary = write(record, tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8")) == summary
    assert set(summary) == {"log", "robots", "ticks", "team", "egos", "process", "configuration", "versions"}
    assert summary["configuration"] == as_dict(Configuration())
    assert summary["versions"].keys() == {"dgorl", "python", "numpy"}  # type: ignore[attr-defined]
    assert summary["process"]["cpu_s"] > 0  # type: ignore[index]
    assert summary["process"]["peak_rss_mb"] > 10  # type: ignore[index]


def test_an_earlier_run_leaves_nothing_behind_but_strangers_stay(record: PairRecord, tmp_path: Path) -> None:
    write(replace(record, peer="r9"), tmp_path)
    old = Records(("r7",), record.t, {"r7": np.ones(4)}, {("r7", "r2"): record})
    output.write(old, Configuration(), {}, tmp_path)
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures/error_r7.png").touch()
    (tmp_path / "mine.txt").touch()
    write(record, tmp_path)
    files = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    pair = {f"relative/r1/r2{end}" for end in (".csv", ".tum", ".truth.tum")}
    assert files == {"summary.json", "mine.txt"} | pair
    assert not (tmp_path / "relative/r7").exists()


def test_a_folder_that_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "relative/r1").mkdir(parents=True)
    (tmp_path / "relative/r1/notes.csv").touch()
    output.prepare(tmp_path)
    assert (tmp_path / "relative/r1/notes.csv").exists()


@pytest.mark.parametrize("path", ["file", "file/below"])
def test_a_file_in_the_way_is_named(record: PairRecord, tmp_path: Path, path: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DgorlError, match=r"file: is a file, not a folder"):
        write(record, tmp_path / path)


@pytest.mark.parametrize("name", ["../r2", "a\\b", "..", "."])
def test_names_cannot_leave_the_folder(record: PairRecord, tmp_path: Path, name: str) -> None:
    pairs = {("r1", name): replace(record, peer=name)}
    with pytest.raises(DgorlError, match="cannot name a file"):
        output.write(replace(records(record), pairs=pairs), Configuration(), {}, tmp_path)
