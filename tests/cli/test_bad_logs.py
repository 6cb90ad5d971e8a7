"""A bad line in a log of any format stops `dgorl run` with ``FILE:LINE:`` and no traceback."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from .commandline import Dgorl, fails_well


@pytest.mark.parametrize(
    ("file", "row"),
    [
        ("odometry.csv", "nan,r1,1,1"),
        ("rssi.csv", "1.0,r1,r9,-50"),
        ("ranges.csv", "1.0,r1,r2,-3,0.1"),
        ("bearings.csv", "1.0,r1"),
        ("groundtruth.csv", "1.0,r1,x,y,0"),
    ],
)
def test_dgorl_folder(dgorl: Dgorl, small: Path, tmp_path: Path, file: str, row: str) -> None:
    log = tmp_path / "log"
    shutil.copytree(small, log)
    text = (log / file).read_text(encoding="utf-8")
    (log / file).write_text(text + row + "\n", encoding="utf-8")
    line = text.count("\n") + 1
    assert f"{log / file}:{line}: " in fails_well(dgorl("run", log, "--out", tmp_path / "o"))


def test_team_yaml(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    shutil.copytree(small, log)
    (log / "team.yaml").write_text("robots: [r1, r2, r3\nstart: {", encoding="utf-8")
    assert f"{log / 'team.yaml'}:2: " in fails_well(dgorl("run", log))


def test_mrclam(dgorl: Dgorl, tmp_path: Path) -> None:
    log = tmp_path / "mrclam"
    log.mkdir()
    rows = {
        "Odometry": "0.0 0.1 0.0\n1.0 0.1 x\n",
        "Measurement": "0.5 14 1.0 0.1\n",
        "Groundtruth": "0.0 0 0 0\n",
    }
    (log / "Barcodes.dat").write_text("".join(f"{k} {9 * k + 5}\n" for k in range(1, 6)), encoding="utf-8")
    for k in range(1, 6):
        for name, text in rows.items():
            (log / f"Robot{k}_{name}.dat").write_text(text, encoding="utf-8")
    assert f"{log / 'Robot1_Odometry.dat'}:2: " in fails_well(dgorl("run", log))


def test_pyfg(dgorl: Dgorl, tmp_path: Path) -> None:
    log = tmp_path / "team.pyfg"
    log.write_text("VERTEX_SE2 0.0 A0 0 0 0\nEDGE_RANGE 0.0 A0 B0\n", encoding="utf-8")
    assert f"{log}:2: " in fails_well(dgorl("run", log))


def test_no_log_at_all(dgorl: Dgorl, tmp_path: Path) -> None:
    assert str(tmp_path / "nowhere") in fails_well(dgorl("run", tmp_path / "nowhere"))
    assert str(tmp_path) in fails_well(dgorl("run", tmp_path))
