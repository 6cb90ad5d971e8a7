"""An agent started on a full disk hears the others, says so once a minute, and joins them when there is room."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from .commandline import ENVIRONMENT, Dgorl, command
from .live_team import live_team

SCRIPT = Path(__file__).with_name("small_disk.py")
PATIENCE = 60.0


def until(well: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + PATIENCE
    while not well():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.5)
    return True


def test_a_full_disk_at_the_start(dgorl: Dgorl, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    try:
        probe = ["unshare", "-rm", "mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)]
        if done := subprocess.run(probe, capture_output=True, text=True, check=False).stderr:
            pytest.skip(f"no small disks here: {done.strip()}")
    except FileNotFoundError:
        pytest.skip("no small disks here: no unshare")
    said, log = tmp_path / "r1.said", tmp_path / "r1.log"

    def events() -> list[dict]:
        return [json.loads(line) for line in log.read_text().splitlines()]

    def last() -> dict:
        reports = [json.loads(line) for line in said.read_text().splitlines()[-3:-1]]
        return reports[-1] if reports else {"peers": {}, "data": ""}

    with live_team(tmp_path) as team:
        team.start("r2")
        arguments = ("--robot", "r1", "--team", team.file, "--key", tmp_path / "r1.key", "--stdin")
        agent = command("agent", *arguments, "--journal", disk / "r1.journal")
        with said.open("wb") as out, log.open("wb") as messages:
            team.robots["r1"] = subprocess.Popen(
                ["unshare", "-rm", sys.executable, str(SCRIPT), str(disk), *agent],
                env={**ENVIRONMENT, "OPENBLAS_NUM_THREADS": "1"},
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=messages,
            )
        assert until(lambda: "r2:" in last()["data"]), log.read_text()
        assert "r1:" not in last()["data"], "nothing of its own is sent that is not kept"
        assert last()["rejected"]["journal"] >= 1
        refusals = [event for event in events() if "full" in event["event"] or "full" in event.get("why", "")]
        assert [event["level"] for event in refusals] == ["error", "error"], "as it starts, and once a minute"
        team.robots["r1"].stdin.write(b"room\n")
        team.robots["r1"].stdin.flush()
        assert until(lambda: "r1:" in last()["data"]), log.read_text()
        located = ("tracked", "position")
        assert until(lambda: last()["peers"].get("r2", {}).get("status") in located), last()
        seen = ("monitor", "--team", team.file, "--once", "--json", "--robot", "r2")

        def found() -> bool:
            done = dgorl(*seen)
            says = json.loads(done.stdout)["robots"]["r2"]["says"] if done.returncode == 0 else None
            return bool(says) and says["peers"].get("r1", {}).get("status") in located

        assert until(found), dgorl(*seen).stdout
    assert [event["event"] for event in events()].count("joined") == 1
