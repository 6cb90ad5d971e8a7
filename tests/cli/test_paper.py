"""`dgorl paper` end to end, small."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from dgorl.evaluation.experiments import Paper
from dgorl.evaluation.results import read

from .commandline import ENVIRONMENT, Dgorl, command, fails_well

TINY = ("--trials", 1, "--steps", 6)
CLAIMS = (
    "relative RMSE lower than that of split covariance intersection, same inputs, known starts",
    "relative RMSE lower than that of TRN with split CI, which knows the terrain besides, known starts",
    "relative RMSE ÷ that of GTSAM's fixed-lag smoother, same window, known starts",
    "CPU of a tick ÷ that of gtsam-fixed-lag, known starts",
    "absolute error, mean, known starts, no alignment",
    "localization error over the side of 60 m",
    "localization error over the mean distance between robots",
    "absolute error, mean, each run SE(2)-aligned once",
    "solver time per graph, 5 robots, 60 keyframes, from tracking: our core",
    "CPU of one robot's process at 2 Hz, known starts",
    "relative position RMSE ÷ expected Cramér–Rao bound, known starts",
    "relative position RMSE of located peers ÷ bound, unknown starts",
    "ticks at which the mean NEES lies in its 95 % band, known starts",
    "inside the 95 % ellipse, known starts",
)


WITHOUT_COMPILER = {**ENVIRONMENT, "PATH": "", "CXX": ""}


def paper(out: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Small, and without a compiler, as g2o takes half a minute to compile."""
    return subprocess.run(
        command("paper", "--out", out, *TINY, *arguments), cwd=out.parent, env=WITHOUT_COMPILER, capture_output=True,
        text=True, timeout=240, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("paper") / "out"
    done = paper(out, "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert "absolute error" in done.stdout
    assert done.stderr == ""
    return out


def test_everything_is_written(folder: Path) -> None:
    written = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.parent.name != "parts"}
    figures = {
        f"figures/{name}.{end}" for name in ("trajectories", "rmse", "comparison", "cpu") for end in ("png", "pdf")
    }
    assert written == {"claims.md", "claims.json", "trials.parquet", "trials_timings.parquet"} | figures
    table = read(folder / "trials.parquet")
    assert len(table["step"]) == sum(len(t.estimators) * 5 * t.scenario.steps for t in Paper(trials=1, steps=6).plan())


def test_every_claim_has_its_row(folder: Path) -> None:
    page = (folder / "claims.md").read_text(encoding="utf-8")
    found = {
        claim["claim"]: claim for claim in json.loads((folder / "claims.json").read_text(encoding="utf-8"))["claims"]
    }
    for name in CLAIMS:
        assert f"| {name} |" in page
        assert found[name]["command"].startswith("dgorl paper --out")
        assert found[name]["trials"] == 1
    for figure in ("4.2 m", "8 %", "23 %", "10.2 ± 2.7 ms", "143 ± 49 %"):
        assert figure in page
    assert "| solver g2o | – | – | – | – | – | – | – | not measured: g2o in C++ needs a C++17 compiler" in page
    asked = [name for name in found if found[name]["asked"]]
    assert all(found[name]["met"] in (True, False) for name in asked)


def test_a_second_run_computes_nothing_and_says_the_same(folder: Path) -> None:
    before = {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in (folder / "parts").iterdir()}
    table, page = ((folder / name).read_bytes() for name in ("trials.parquet", "claims.md"))
    done = paper(folder, "--workers", 2, "--json")
    assert done.returncode == 0, done.stderr
    assert {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in (folder / "parts").iterdir()} == before
    assert (folder / "trials.parquet").read_bytes() == table
    assert (folder / "claims.md").read_bytes() == page
    assert {claim["claim"] for claim in json.loads(done.stdout)["claims"]} >= set(CLAIMS)


def test_interrupted_it_keeps_what_is_finished(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = subprocess.Popen(
        command("paper", "--out", out, *TINY, "--workers", 1), cwd=tmp_path, env=WITHOUT_COMPILER, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    end = time.monotonic() + 60
    while not list(out.glob("parts/[!.]*.errors.parquet")) and time.monotonic() < end:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stdout == ""
    assert stderr.endswith("the same command goes on from there\ninterrupted\n")
    assert "Traceback" not in stderr
    finished = list(out.glob("parts/[!.]*.errors.parquet"))
    assert len(finished) == 1
    stamp = finished[0].stat().st_mtime_ns
    done = paper(out, "--workers", 1)
    assert done.returncode == 0, done.stderr
    assert finished[0].stat().st_mtime_ns == stamp
    assert (out / "trials.parquet").read_bytes() == (folder / "trials.parquet").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("--trials", 0), "--trials must be at least 1, got 0"),
        (("--workers", 0), "--workers must be at least 1, got 0"),
        (("--steps", -1), "--steps must be at least 1, got -1"),
        (("--seed", -1), "--seed must be at least 0, got -1"),
    ],
)
def test_bad_arguments(dgorl: Dgorl, tmp_path: Path, arguments: tuple[object, ...], what: str) -> None:
    assert what in fails_well(dgorl("paper", "--out", tmp_path / "out", *arguments))
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_way(dgorl: Dgorl, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("", encoding="utf-8")
    assert "is a file, not a folder" in fails_well(dgorl("paper", "--out", tmp_path / "out", *TINY))


def test_no_cluster_there(dgorl: Dgorl, tmp_path: Path) -> None:
    done = dgorl("paper", "--out", tmp_path / "out", *TINY, "--cluster", "tcp://127.0.0.1:9")
    assert "no Dask scheduler answers" in fails_well(done)


def test_usage(dgorl: Dgorl) -> None:
    assert dgorl("paper").returncode == 2
    assert "Example: dgorl paper" in dgorl("paper", "--help").stdout
