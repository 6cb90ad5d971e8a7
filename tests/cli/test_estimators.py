"""`dgorl run --estimator NAME`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .commandline import Dgorl, fails_well


@pytest.fixture(scope="module")
def hilly(dgorl: Dgorl, tmp_path_factory: pytest.TempPathFactory) -> Path:
    log = tmp_path_factory.mktemp("logs") / "hilly"
    options = (
        "--robots",
        3,
        "--steps",
        10,
        "--terrain",
        "--altimeter-sigma",
        0.2,
        "--relief",
        3,
        "--terrain-length",
        8,
    )
    done = dgorl("simulate", *options, "--out", log)
    assert done.returncode == 0, done.stderr
    assert (log / "terrain.npz").exists()
    return log


@pytest.mark.parametrize("name", ["dead-reckoning", "naive", "ci", "split-ci", "trn"])
def test_baselines_run(dgorl: Dgorl, hilly: Path, tmp_path: Path, name: str) -> None:
    done = dgorl("run", hilly, "--initial", "known", "--estimator", name, "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert (summary["estimator"], summary["initial"]) == (name, "known")
    assert "starts" not in summary
    assert summary["team"]["all_ticks_position_rmse_m"] < 3
    for ego in ("r1", "r2", "r3"):
        assert {p.name for p in (tmp_path / "relative" / ego).glob("*.csv")} == {
            f"{peer}.csv" for peer in {"r1", "r2", "r3", "world"} - {ego}
        }
    assert (tmp_path / "figures/trajectories.png").exists()


def test_unknown_starts_say_whence(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    done = dgorl("run", small, "--estimator", "split-ci", "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["starts"] == "the first poses that dgorl tracked"


def test_an_unknown_name_is_a_usage_error(dgorl: Dgorl, small: Path) -> None:
    done = dgorl("run", small, "--estimator", "split_ci")
    assert done.returncode == 2
    assert done.stdout == ""
    assert "did you mean `split-ci`?" in " ".join(done.stderr.replace("│", " ").split())


def test_inputs_that_are_missing(dgorl: Dgorl, small: Path, hilly: Path, tmp_path: Path) -> None:
    needs = fails_well(dgorl("run", small, "--estimator", "trn", "--initial", "known", "--out", tmp_path))
    assert f"{small}: trn needs an elevation map, terrain.npz" in needs
    assert "trn needs `--initial known`" in fails_well(dgorl("run", hilly, "--estimator", "trn", "--out", tmp_path))
    assert not (tmp_path / "summary.json").exists()
