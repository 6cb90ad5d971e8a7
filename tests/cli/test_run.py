"""`dgorl run` end to end."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from .commandline import Dgorl, fails_well

NAMES = {
    "log", "robots", "ticks", "initial", "measurements", "solver", "team", "egos", "process",
    "configuration", "versions",
}  # fmt: skip

NO_RANGES = "t,from,to,range,sigma\n"


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_everything_is_written(results: Path) -> None:
    written = set(files(results))
    for ego in ("r1", "r2", "r3"):
        assert f"figures/error_{ego}.png" in written
        for peer in {"r1", "r2", "r3", "world"} - {ego}:
            assert {f"relative/{ego}/{peer}{end}" for end in (".csv", ".tum", ".truth.tum")} <= written
    assert {"summary.json", "figures/trajectories.png"} <= written
    assert len(written) == 2 + 3 + 3 * 3 * 3


def test_table_and_summary_agree(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    done = dgorl("run", small, "--initial", "known", "--out", tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary.keys() >= NAMES
    assert summary["ticks"] == 12
    assert summary["measurements"] == ["range", "bearing", "rssi"]
    for robot in ("r1", "r2", "r3"):
        (row,) = [line for line in done.stdout.splitlines() if line.split()[:1] == [robot]]
        assert f"{summary['egos'][robot]['position_rmse_m']:.2f}" in row
        assert set(summary["egos"][robot]["peers"]) == {"r1", "r2", "r3"} - {robot}
    for unit in ("[m]", "[°]", "[%]", "[ms]"):
        assert unit in done.stdout
    assert "trajectories.png" in done.stdout
    assert done.stderr == ""


def test_localises_well_with_ranges_and_bearings(results: Path) -> None:
    team = json.loads((results / "summary.json").read_text(encoding="utf-8"))["team"]
    assert team["position_rmse_m"] < 2
    assert team["heading_rmse_deg"] < 5
    assert team["tracked_fraction"] > 0.9
    assert team["coverage_95"] > 0.8


def test_same_log_same_bytes(dgorl: Dgorl, small: Path, results: Path, tmp_path: Path) -> None:
    assert dgorl("run", small, "--initial", "known", "--out", tmp_path).returncode == 0
    assert files(tmp_path / "relative") == files(results / "relative")


def test_json_is_alone_on_stdout(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    done = dgorl("run", small, "--out", tmp_path, "--json", "--ego", "r2", "--ego", "r3")
    summary = json.loads(done.stdout)
    assert summary == json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert list(summary["egos"]) == ["r2", "r3"]
    assert "position" in done.stderr
    assert not (tmp_path / "relative/r1").exists()


def test_a_folder_is_used_again(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    assert dgorl("run", small, "--out", tmp_path / "a/b").returncode == 0
    assert dgorl("run", small, "--out", tmp_path / "a/b", "--ego", "r1").returncode == 0
    assert [p.name for p in (tmp_path / "a/b/relative").iterdir()] == ["r1"]


def test_default_folder_is_named_after_the_log(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    assert dgorl("run", small, "--ego", "r1", cwd=tmp_path).returncode == 0
    assert (tmp_path / "out/small/summary.json").exists()


def test_evo_reads_the_trajectories(results: Path) -> None:
    evo = Path(sys.executable).parent / "evo_traj"
    folder = results / "relative/r1"
    done = subprocess.run(
        [evo, "tum", folder / "r2.tum", "--ref", folder / "r2.truth.tum"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("poses") == 2


def test_order_of_configuration(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    shutil.copytree(small, log)
    team = yaml.safe_load((log / "team.yaml").read_text(encoding="utf-8"))
    team["radio"] = {
        **team.get("radio", {}),
        "sigma_db": 3.0,
        "path_loss_exponent": 2.5,
        "rssi_at_1m_dbm": -41.0,
    }
    (log / "team.yaml").write_text(yaml.safe_dump(team), encoding="utf-8")
    settings = tmp_path / "mine.yaml"
    settings.write_text("window: 15\nperiod: 1.0\nradio: {sigma_db: 4.0}\n", encoding="utf-8")
    options = ["--config", settings, "--period", 2, "--seed", 7, "--candidates", 3, "--out", tmp_path / "o", "--json"]
    configuration = json.loads(dgorl("run", log, *options).stdout)["configuration"]
    assert configuration["radio"]["rssi_at_1m_dbm"] == -41.0
    assert configuration["radio"]["path_loss_exponent"] == 2.5
    assert configuration["radio"]["sigma_db"] == 4.0
    assert (configuration["window"], configuration["period"], configuration["seed"]) == (15.0, 2.0, 7)
    assert (configuration["history"], configuration["candidates"]) == (180.0, 3)


def test_starts_are_unknown_unless_said(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    """What is not located after twelve steps is said with its reason; no start is used."""
    done = dgorl("run", small, "--measurements", "rssi", "--out", tmp_path, "--json")
    summary = json.loads(done.stdout)
    assert summary["initial"] == "unknown"
    assert not (tmp_path / "relative/r1/world.csv").exists()
    seen = summary["egos"]["r1"]["peers"]["r2"]
    assert seen["status"] not in ("position", "tracked")
    assert seen["reason"]
    assert "Not located at the end" in done.stderr
    assert "r1" in done.stderr
    assert "No ground truth" not in done.stderr


def test_a_rerun_takes_hypotheses_away(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    assert dgorl("run", small, "--out", tmp_path, "--ego", "r1").returncode == 0
    (tmp_path / "hypotheses/r1").mkdir(parents=True, exist_ok=True)
    (tmp_path / "hypotheses/r1/r9.csv").touch()
    assert dgorl("run", small, "--out", tmp_path, "--ego", "r1", "--initial", "known").returncode == 0
    assert not (tmp_path / "hypotheses").exists()


def test_readings_long_after_all_odometry_cost_no_ticks(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    """As when ranges are stamped in milliseconds: nobody can be located without odometry."""
    log = tmp_path / "log"
    shutil.copytree(small, log)
    with (log / "ranges.csv").open("a", encoding="utf-8") as ranges:
        ranges.write("40000.0,r1,r2,3.0,0.1\n")
    done = dgorl("run", log, "--out", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["ticks"] < 400


def test_window_all(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    done = dgorl("run", small, "--window", "all", "--ego", "r1", "--out", tmp_path, "--json")
    assert json.loads(done.stdout)["configuration"]["window"] == "all"


def test_measurements_are_chosen(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    done = dgorl("run", small, "--measurements", "bearing,rssi", "--ego", "r1", "--out", tmp_path, "--json")
    assert json.loads(done.stdout)["measurements"] == ["bearing", "rssi"]


def test_without_truth_the_errors_are_null_and_words_say_so(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    shutil.copytree(small, log)
    truth = tmp_path / "truth.csv"
    (log / "groundtruth.csv").rename(truth)
    blind = dgorl("run", log, "--initial", "known", "--out", tmp_path / "o", "--json")
    team = json.loads(blind.stdout)["team"]
    assert (team["position_rmse_m"], team["coverage_95"]) == (None, None)
    assert team["tracked_fraction"] > 0
    assert "No ground truth" in blind.stderr
    assert not list((tmp_path / "o").rglob("*.truth.tum"))
    assert (tmp_path / "o/figures/trajectories.png").exists()
    seen = dgorl("run", log, "--initial", "known", "--out", tmp_path / "o", "--json", "--truth", truth)
    assert json.loads(seen.stdout)["team"]["position_rmse_m"] is not None


def test_dead_reckoning_without_measurements(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    shutil.copytree(small, log)
    for name in ("rssi", "bearings"):
        (log / f"{name}.csv").unlink()
    (log / "ranges.csv").write_text(NO_RANGES, encoding="utf-8")
    known = dgorl("run", log, "--out", tmp_path / "o", "--initial", "known")
    assert known.returncode == 0, known.stderr
    assert "dead reckoning from the starts" in known.stdout
    unknown = dgorl("run", log, "--out", tmp_path / "o")
    assert unknown.returncode == 0, unknown.stderr
    assert "nobody can be located" in unknown.stdout


def test_one_robot(dgorl: Dgorl, tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.mkdir()
    (log / "team.yaml").write_text("robots: [r1]\nstart: {r1: [0, 0, 0]}\n", encoding="utf-8")
    (log / "odometry.csv").write_text("t,robot,v,omega\n0,r1,0.5,0.1\n1,r1,0.5,0\n2,r1,0,0\n", encoding="utf-8")
    (log / "ranges.csv").write_text(NO_RANGES, encoding="utf-8")
    done = dgorl("run", log, "--out", tmp_path / "o")
    assert done.returncode == 0, done.stderr
    assert "r1 is alone" in done.stdout


def test_empty_log(dgorl: Dgorl, tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.mkdir()
    (log / "team.yaml").write_text("robots: [r1, r2]\n", encoding="utf-8")
    (log / "odometry.csv").write_text("t,robot,v,omega\n", encoding="utf-8")
    (log / "ranges.csv").write_text(NO_RANGES, encoding="utf-8")
    assert str(log) in fails_well(dgorl("run", log, "--out", tmp_path / "o"))
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["--candidates", "0"], "candidates must be at least 1"),
        (["--ego", "r9"], "r9"),
        (["--window", "7"], "command line: window must be a multiple of 5 s"),
        (["--window", "long"], "window must be seconds or all"),
        (["--history", "1"], "history must be at least 10 s"),
        (["--truth", "nowhere.csv"], "nowhere.csv"),
        (["--config", "nowhere.yaml"], "nowhere.yaml: cannot be read"),
    ],
)
def test_known_failures_are_one_line(dgorl: Dgorl, small: Path, tmp_path: Path, options: list[str], what: str) -> None:
    assert what in fails_well(dgorl("run", small, "--out", tmp_path / "o", *options))


def test_unknown_setting_names_the_nearest(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    settings = tmp_path / "mine.yaml"
    settings.write_text("radio: {sigma_bd: 4.0}\n", encoding="utf-8")
    said = fails_well(dgorl("run", small, "--config", settings))
    assert "mine.yaml: unknown setting `radio.sigma_bd`; did you mean `sigma_db`?" in said


def test_a_kind_the_log_lacks(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    log = tmp_path / "log"
    shutil.copytree(small, log)
    (log / "ranges.csv").unlink()
    assert "range" in fails_well(dgorl("run", log, "--measurements", "range"))


def test_a_file_where_the_folder_should_be(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    (tmp_path / "o").touch()
    assert f"{tmp_path / 'o'}: is a file" in fails_well(dgorl("run", small, "--out", tmp_path / "o"))
