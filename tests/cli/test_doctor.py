"""``dgorl doctor`` on installations and logs; on live teams it is tested beside ``dgorl monitor``."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from .commandline import ENVIRONMENT, Dgorl, command


@pytest.fixture(scope="module")
def log(dgorl: Dgorl, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots close to each other, all sensors."""
    log = tmp_path_factory.mktemp("logs") / "close"
    options = ("--robots", 3, "--steps", 12, "--area", 15, "--sensors", "rssi,range,bearing")
    done = dgorl("simulate", *options, "--out", log)
    assert done.returncode == 0, done.stderr
    return log


@pytest.mark.parametrize("name", ["monitor", "doctor"])
def test_help_has_an_example(dgorl: Dgorl, name: str) -> None:
    done = dgorl(name, "--help")
    assert done.returncode == 0
    assert f"Example: dgorl {name}" in done.stdout
    assert "--json" in done.stdout


def test_this_installation_is_well(dgorl: Dgorl) -> None:
    done = dgorl("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the compiled core works" in done.stdout
    assert "All is well" in done.stdout.splitlines()[-1]


def test_a_log(dgorl: Dgorl, log: Path) -> None:
    done = dgorl("doctor", log, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["well"] is True
    what = [finding["what"] for finding in told["findings"] if finding["area"] == "log"]
    assert f"{log}: 3 robots (r1, r2, r3)" in what[0]
    assert {line.split(":")[0] for line in what} >= {"rssi", "range", "bearing", "r1", "r2", "r3"}


def test_a_log_with_a_silent_robot(dgorl: Dgorl, log: Path, tmp_path: Path) -> None:
    odd = tmp_path / "log"
    shutil.copytree(log, odd)
    for name in ("rssi.csv", "ranges.csv", "bearings.csv"):
        head, *rows = (odd / name).read_text().splitlines(keepends=True)
        (odd / name).write_text(head + "".join(row for row in rows if "r3" not in row.split(",")[1:3]))
    done = dgorl("doctor", odd)
    assert done.returncode == 1
    assert "✗ log     no reading links r3 to the others" in done.stdout
    assert done.stderr.startswith("dgorl: 1 problem found; the first, log: no reading links r3")
    assert done.stderr.count("\n") == 1


def test_what_cannot_be_read(dgorl: Dgorl, tmp_path: Path) -> None:
    bad = tmp_path / "team.yaml"
    bad.write_text("team: lab\nrobots: {}\n")
    done = dgorl("doctor", tmp_path / "gone", "--team", bad, "--journal", tmp_path / "gone.journal")
    assert done.returncode == 1
    assert f"✗ log     {tmp_path / 'gone'}: no such file or folder" in done.stdout
    assert f"✗ journal {tmp_path / 'gone.journal'}: no such file" in done.stdout
    assert f"✗ network {bad}:2: `robots` must map names to keys" in done.stdout
    assert "dgorl: 3 problems found" in done.stderr


def test_a_machine_without_a_network_is_told_so(tmp_path: Path) -> None:
    """In a network namespace that has nothing but loopback."""
    (tmp_path / "team.yaml").write_text("team: lab\ninsecure: true\nrobots: [r1, r2]\ntransport: {multicast: true}\n")
    apart = ["unshare", "-rn"]
    try:
        if done := subprocess.run([*apart, "true"], capture_output=True, text=True, check=False).stderr:
            pytest.skip(f"no network namespaces here: {done.strip()}")
    except FileNotFoundError:
        pytest.skip("no network namespaces here: no unshare")
    words = [*apart, *command("doctor", "--team", tmp_path / "team.yaml", "--seconds", "0.5")]
    said = subprocess.run(words, capture_output=True, text=True, env=ENVIRONMENT, timeout=120, check=False)
    assert said.returncode == 1
    assert "✗ network this machine has no network: no interface has an address" in said.stdout
