"""Whose results a folder holds: not those of another log, nor half of them."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from dgorl.errors import DgorlError
from dgorl.evaluation import output

from .commandline import ENVIRONMENT, Dgorl, command


def test_logs_of_one_name_have_folders_of_their_own(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        shutil.copytree(small, tmp_path / name / "lab")
    for log in ("monday/lab", "tuesday/lab", "monday/lab/../../tuesday/lab"):
        done = dgorl("run", log, "--ego", "r1", "--initial", "known", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    folders = {"lab": "monday", "lab-2": "tuesday"}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(folders)
    for folder, day in folders.items():
        summary = json.loads((tmp_path / "out" / folder / "summary.json").read_text(encoding="utf-8"))
        assert Path(summary["log"]).resolve() == tmp_path / day / "lab"
    assert "Results: out/lab-2" in done.stdout


def test_an_interrupt_leaves_former_results_as_they_were(dgorl: Dgorl, tmp_path: Path) -> None:
    log, out = tmp_path / "long", tmp_path / "out"
    assert dgorl("simulate", "--robots", 4, "--steps", 2000, "--sensors", "range", "--out", log).returncode == 0
    out.mkdir()
    assert dgorl("run", _short(log, tmp_path), "--ego", "r1", "--out", out).returncode == 0
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    before = _contents(out)
    with subprocess.Popen(
        command("run", log, "--out", out), env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 60
        while not list(out.glob(".unfinished-*")) and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "interrupted\n")
    assert _contents(out) == before


def _short(log: Path, tmp_path: Path) -> Path:
    """The first ten seconds of a log."""
    short = tmp_path / "short"
    short.mkdir()
    (short / "team.yaml").write_text((log / "team.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    for name in ("odometry.csv", "ranges.csv", "groundtruth.csv"):
        rows = (log / name).read_text(encoding="utf-8").splitlines()
        kept = [row for row in rows[1:] if float(row.split(",")[0]) <= 10.0]
        (short / name).write_text("\n".join([rows[0], *kept]) + "\n", encoding="utf-8")
    return short


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class TestReplacing:
    def write(self, folder: Path, text: str, names: tuple[str, ...]) -> None:
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")

    def test_the_new_takes_the_place_of_the_old(self, tmp_path: Path) -> None:
        self.write(tmp_path, "old", ("summary.json", "relative/r1/r2.csv", "figures/trajectories.png", "mine.txt"))
        with output.replacing(tmp_path) as folder:
            self.write(folder, "new", ("summary.json", "relative/r1/r3.csv"))
            assert (tmp_path / "summary.json").read_text(encoding="utf-8") == "old"
        assert {name: text.decode() for name, text in _contents(tmp_path).items()} == {
            "summary.json": "new",
            "relative/r1/r3.csv": "new",
            "mine.txt": "old",
        }
        assert not list(tmp_path.glob(".unfinished-*"))

    @pytest.mark.parametrize("error", [KeyboardInterrupt, DgorlError])
    def test_an_error_changes_nothing(self, tmp_path: Path, error: type[BaseException]) -> None:
        self.write(tmp_path / "there", "old", ("summary.json", "relative/r1/r2.csv"))
        before = _contents(tmp_path)

        def fail(folder: Path) -> None:
            with output.replacing(folder) as unfinished:
                self.write(unfinished, "new", ("summary.json",))
                raise error

        for name in ("there", "new/deep"):
            with pytest.raises(error):
                fail(tmp_path / name)
        assert _contents(tmp_path) == before
        assert not (tmp_path / "new" / "deep").exists()

    def test_results_of_something_else_are_nobodys_log(self, tmp_path: Path) -> None:
        assert output.log_of(tmp_path) is None
        (tmp_path / "summary.json").write_text("[1]", encoding="utf-8")
        assert output.log_of(tmp_path) == tmp_path
