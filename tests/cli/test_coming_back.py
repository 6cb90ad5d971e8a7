"""Real agents: one comes back with a journal that it has outlived, its default one, started from another directory."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from dgorl.team.journal_place import state_journal

from .commandline import ENVIRONMENT, Dgorl, command
from .live_team import LiveTeam, live_team


def begin(team: LiveTeam, robot: str, state: Path, cwd: Path) -> None:
    """An agent that is not told where its journal is."""
    arguments = ("--robot", robot, "--team", team.file, "--key", team.folder / f"{robot}.key", "--stdin")
    cwd.mkdir(exist_ok=True)
    with (team.folder / f"{robot}.log").open("ab") as messages:
        team.robots[robot] = subprocess.Popen(
            command("agent", *arguments, "--sync", "normal"),
            env={**ENVIRONMENT, "OPENBLAS_NUM_THREADS": "1", "XDG_STATE_HOME": str(state)},
            cwd=cwd,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=messages,
        )


def end(team: LiveTeam, robot: str) -> None:
    process = team.robots.pop(robot)
    process.terminate()
    with suppress(BrokenPipeError):
        process.stdin.close()
    assert process.wait(20) == 0


def until(dgorl: Dgorl, team: LiveTeam, well: Callable[[dict], bool]) -> dict:
    """The monitor's view, asked again for up to a minute."""
    deadline = time.monotonic() + 60
    while True:
        done = dgorl("monitor", "--team", team.file, "--once", "--json", "--seconds", "3")
        robots = json.loads(done.stdout)["robots"] if done.returncode == 0 else {}
        if (robots and well(robots)) or time.monotonic() > deadline:
            return robots


def hear_one_another(robots: dict) -> bool:
    """Both r1 and r2 have fresh odometry of the other."""
    told = {name: robots[name]["says"] for name in ("r1", "r2")}
    ages = [told[a]["peers"].get(b, {}).get("age_s") for a, b in (("r1", "r2"), ("r2", "r1")) if told[a]]
    return len(ages) == 2 and all(age is not None and age < 3.0 for age in ages)


def test_an_agent_with_an_outlived_journal_is_not_locked_out(dgorl: Dgorl, tmp_path: Path) -> None:
    first, other = tmp_path / "state", tmp_path / "other"
    with live_team(tmp_path) as team:
        epochs = []
        begin(team, "r2", first, tmp_path)
        for state in (first, other, first):
            begin(team, "r1", state, tmp_path / f"from-{len(epochs)}")
            robots = until(dgorl, team, hear_one_another)
            assert hear_one_another(robots), robots
            epochs.append(robots["r1"]["epoch"])
            end(team, "r1")
        assert len(set(epochs)) == 3
    log = [json.loads(line) for line in (tmp_path / "r1.log").read_text().splitlines()]
    joined = [line for line in log if line["event"] == "joined"]
    assert [line["epoch"] for line in joined] == [epochs[0], epochs[1], epochs[0]]
    places = {Path(line["journal"]) for line in joined}
    assert places == {state / "dgorl" / "lab" / "r1.journal" for state in (first, other)}
    assert all(path.exists() for path in places)
    (ending,) = [line for line in log if line["event"] == "this robot's epoch has ended: a new one begins"]
    assert (ending["ended"], ending["epoch"]) == (epochs[0], epochs[2])
    assert not any("exception" in line for line in log)


def test_no_name_leads_out_of_the_state_folder(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for team in (".", "..", "lab", "a b"):
        assert state_journal(team, "r1").resolve().is_relative_to(tmp_path.resolve() / "dgorl")
        assert state_journal(team, "r1").parent.parent == tmp_path / "dgorl"
