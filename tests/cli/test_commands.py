"""The other subcommands, exit codes, help, interrupts."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

import dgorl as package
from dgorl.cli.config import commented
from dgorl.configuration import Configuration, as_dict, merge
from dgorl.logs import read
from dgorl.measurements import Bearing, Range, Rssi

from .commandline import ENVIRONMENT, Dgorl, command, ended, fails_well

COMMANDS = ("demo", "run", "simulate", "paper", "agent", "fleet", "monitor", "doctor", "keys", "config")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example(dgorl: Dgorl, name: str) -> None:
    done = dgorl(name, "--help")
    assert done.returncode == 0
    assert f"Example: dgorl {name}" in done.stdout
    assert "--json" in done.stdout or name == "agent"  # whose stdout is JSON always


def test_overview_and_version(dgorl: Dgorl) -> None:
    overview = dgorl("--help")
    assert overview.returncode == 0
    assert all(f"  {name} " in overview.stdout for name in COMMANDS)
    assert dgorl("--version").stdout == f"dgorl {package.__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        [], ["rum"], ["--frob"], ["run"], ["run", "x", "--frob"], ["run", "x", "--period", "often"],
        ["run", "x", "--initial", "maybe"], ["run", "x", "--measurements", "smell"], ["simulate"],
        ["simulate", "--out", "x", "--motion", "zigzag"], ["config", "extra"], ["demo", "--seed", "x"],
    ],
)  # fmt: skip
def test_usage_errors_are_2(dgorl: Dgorl, arguments: list[str]) -> None:
    done = dgorl(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr
    assert "Traceback" not in done.stderr


def test_unknown_command_names_the_nearest(dgorl: Dgorl) -> None:
    assert "did you mean `run`?" in dgorl("rum").stderr


def test_config_reads_back_and_explains_every_setting(dgorl: Dgorl) -> None:
    text = dgorl("config").stdout
    assert merge(Configuration(), yaml.safe_load(text), "config") == Configuration()
    assert yaml.safe_load(text) == as_dict(Configuration())
    settings = [line for line in text.splitlines() if line]
    assert all("  # " in line for line in settings)
    assert json.loads(dgorl("config", "--json").stdout) == as_dict(Configuration())


def test_config_of_other_values_reads_back() -> None:
    changes = {"window": "all", "antennas": {"r1": [0.1, 0.0, 0.3]}, "radio": {"kernel": "huber"}}
    other = merge(Configuration(), changes, "test")
    assert yaml.safe_load("\n".join(commented(other))) == as_dict(other)


def test_simulate_takes_every_option_and_the_seed(dgorl: Dgorl, tmp_path: Path) -> None:
    options = [
        "--robots", 4, "--area", 30, "--steps", 8, "--period", 1.0, "--speed", 0.4,
        "--sensors", "range,bearing",
        "--range-sigma", 0.2, "--path-loss-exponent", 2.5, "--shadowing-db", 3, "--shadowing-correlation", 2,
        "--reciprocity", 0.5, "--comm-range", 50, "--motion", "formation", "--nlos", 0.1,
        "--wheel-scale", 1.02,
        "--wheel-lag", 0.1, "--teleport", "r2@3:5", "--seed", 3,
    ]  # fmt: skip
    done = dgorl("simulate", *options, "--out", tmp_path / "a", "--json")
    assert done.returncode == 0, done.stderr
    log = read(tmp_path / "a")
    assert json.loads(done.stdout) == {
        "log": str(tmp_path / "a"), "robots": ["r1", "r2", "r3", "r4"], "measurements": len(log.measurements),
    }  # fmt: skip
    kinds = {type(m) for m in log.measurements}
    assert {Range, Bearing} <= kinds
    assert Rssi not in kinds
    dgorl("simulate", *options, "--out", tmp_path / "b")
    assert (tmp_path / "a/ranges.csv").read_bytes() == (tmp_path / "b/ranges.csv").read_bytes()
    dgorl("simulate", *options[:-1], 4, "--out", tmp_path / "b")
    assert (tmp_path / "a/ranges.csv").read_bytes() != (tmp_path / "b/ranges.csv").read_bytes()


def test_simulate_overwrites_logs_alone(dgorl: Dgorl, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").touch()
    assert "holds files that are no dgorl log" in fails_well(dgorl("simulate", "--out", tmp_path))
    assert "is a file" in fails_well(dgorl("simulate", "--out", tmp_path / "thesis.txt"))
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_simulate_refuses_what_cannot_be(dgorl: Dgorl, tmp_path: Path) -> None:
    assert "robots" in fails_well(dgorl("simulate", "--robots", 0, "--out", tmp_path / "a"))
    assert "teleport" in fails_well(dgorl("simulate", "--teleport", "r1", "--out", tmp_path / "a"))


def test_demo(dgorl: Dgorl, tmp_path: Path) -> None:
    done = dgorl("demo", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out/demo/log/team.yaml").exists()
    picture = tmp_path / "out/demo/figures/trajectories.png"
    assert picture.stat().st_size > 20_000
    assert str(picture.relative_to(tmp_path)) in done.stdout
    assert "5 robots, 100 ticks" in done.stdout


def test_demo_of_a_log(dgorl: Dgorl, small: Path, tmp_path: Path) -> None:
    done = dgorl("demo", "--log", small, "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["log"] == str(small)
    assert (tmp_path / "out/small/figures/trajectories.png").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process")
def test_interrupt_is_130(dgorl: Dgorl, tmp_path: Path) -> None:
    log, out = tmp_path / "log", tmp_path / "out"
    assert dgorl("simulate", "--steps", 3000, "--robots", 6, "--out", log).returncode == 0
    process = subprocess.Popen(
        command("run", log, "--out", out),
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(
            signal.SIGINT, signal.default_int_handler
        ),  # a job in the background ignores it
    )
    with ended(process):
        for _ in range(600):
            if out.exists():
                break
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert (stdout, stderr) == ("", "interrupted\n")


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process")
def test_an_interrupt_that_a_destructor_swallows_comes_again() -> None:
    swallows = """
import os, signal, sys, time
from dgorl.cli import main as line

class Swallowing:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)

def command(_):
    try:
        Swallowing()
        time.sleep(30)
    finally:
        time.sleep(2.5)
        print("cleared up")

sys.unraisablehook = lambda unraisable: None
line.import_module = lambda name: type("Module", (), {"main": staticmethod(command)})
sys.exit(line.main(["demo"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", swallows],
        capture_output=True,
        text=True,
        timeout=30,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "cleared up\n", "interrupted\n")


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGPIPE")
def test_a_reader_that_leaves_is_no_error() -> None:
    process = subprocess.Popen(command("config"), env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(timeout=30) == 1
