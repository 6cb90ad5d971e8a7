"""Three real agents in network namespaces, as on three machines, over an Ethernet that loses every fifth frame."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from dgorl.team.fleet_results import check, reports_of
from dgorl.team.journal_data import parse
from dgorl.team.keys import make_key

from .ethernet import Ethernet, missing
from .real_team import BEGINNING, agents, played, prepare, simulated

LOSS, DELAY = 0.2, (0.01, 0.03)


@pytest.fixture
def ethernet(tmp_path: Path) -> Iterator[Ethernet]:
    lacking = missing(tmp_path)
    if lacking:
        pytest.skip(f"no network namespaces here: {lacking}")
    ethernet = Ethernet(tmp_path / "ports", LOSS, DELAY)
    yield ethernet
    ethernet.close()


def test_agents_on_machines_of_their_own(ethernet: Ethernet, tmp_path: Path) -> None:
    fleet = simulated(tmp_path / "live", seconds=15.0, settle=10.0)
    addresses = {robot: f"10.0.0.{number}" for number, robot in enumerate(fleet.log.robots, 1)}
    prepare(fleet, addresses={robot: f"tcp/{address}:7447" for robot, address in addresses.items()})

    def command(robot: str) -> list[str]:
        return ethernet.command(f"{addresses[robot]}/24", *fleet.command(robot))

    with agents(fleet, command) as lives:
        for _ in played(fleet, lives):
            pass
    assert ethernet.carried > 300
    assert 0.8 * LOSS < ethernet.lost / (ethernet.lost + ethernet.carried) < 1.2 * LOSS

    reports = reports_of(fleet)
    for robot, said in reports.items():
        others = tuple(sorted(set(fleet.log.robots) - {robot}))
        assert [name for name, _ in sorted(parse(said[-1].data))] == list(fleet.log.robots)
        assert all(said[-1].peers[other].status in ("position", "tracked") for other in others)
        assert said[-1].rejected.keys() <= BEGINNING
        # Not at every tick: a peer is gone after a lease of 3 s without a sign, and TCP, whose pauses double, stalls
        # for that long when four frames or answers in a row get lost.
        assert any(set(report.present) == set(others) for report in said), {report.present for report in said}
    found = check(fleet, reports)
    assert (found.robots, found.data, found.estimates) == (fleet.log.robots, True, True), found.differences


MET = 10.0


def test_an_address_that_comes_after_the_agent(tmp_path: Path) -> None:
    """At boot an agent may be there before the network: it says so, and meets the others when there is one."""
    lacking = missing(tmp_path)
    if lacking:
        pytest.skip(f"no network namespaces here: {lacking}")
    robots = ("r1", "r2", "r3")
    keys = {robot: {"key": make_key(tmp_path / f"{robot}.key").public} for robot in robots}
    team = {"team": "lab", "robots": keys, "transport": {"multicast": True}}
    (tmp_path / "team.yaml").write_text(yaml.safe_dump(team))
    lease, move = tmp_path / "lease", tmp_path / "move"
    addresses = {"r1": "10.0.7.1/24", "r2": f"10.0.7.2/24@{lease}", "r3": f"10.0.7.3/24@{lease},10.0.7.33/24@{move}"}
    ethernet = Ethernet(tmp_path / "late", 0.0, (0.0, 0.001))
    lives = []
    try:
        for robot, address in addresses.items():
            words = ["agent", "--robot", robot, "--team", "team.yaml", "--key", f"{robot}.key"]
            words += ["--journal", f"{robot}.journal"]
            with (tmp_path / f"{robot}.said").open("wb") as out, (tmp_path / f"{robot}.log").open("wb") as errors:
                command = ethernet.command(address, sys.executable, "-m", "dgorl", *words)
                lives.append(subprocess.Popen(command, stdout=out, stderr=errors, cwd=tmp_path))
        assert until(lambda: all("no network" in (tmp_path / f"{robot}.log").read_text() for robot in ("r2", "r3")))
        lease.touch()
        assert until(lambda: all(heard_at(tmp_path, robot) > 0.0 for robot in robots))
        move.touch()
        assert until(lambda: (tmp_path / "r3.log").read_text().count('"joined"') == 2)
        assert until(lambda: heard_at(tmp_path, "r3", move.stat().st_mtime + 3.0) > 0.0)
    finally:
        for life in lives:
            life.terminate()
        for life in lives:
            life.wait(20)
        ethernet.close()
    logs = {robot: list(map(json.loads, (tmp_path / f"{robot}.log").read_text().splitlines())) for robot in robots}
    events = {robot: [record["event"] for record in log] for robot, log in logs.items()}
    for robot in ("r2", "r3"):
        assert 1 <= sum(event.startswith("no network") for event in events[robot]) <= 2
        assert heard_at(tmp_path, robot) - lease.stat().st_mtime < MET
    assert not any("network" in event for event in events["r1"])
    assert {robot: found.count("joined") for robot, found in events.items()} == {"r1": 1, "r2": 1, "r3": 2}
    first, again = (record for record in logs["r3"] if record["event"] == "joined")
    assert first["epoch"] == again["epoch"], "it goes on where it was"


def until(well: Callable[[], bool]) -> bool:
    """Whether it came to that within a minute."""
    deadline = time.monotonic() + 60.0
    while not well() and time.monotonic() < deadline:
        time.sleep(0.2)
    return well()


def heard_at(folder: Path, robot: str, since: float = 0.0) -> float:
    """When a robot was on one network with both others, from a time on [s], 0 if never."""
    lines = (folder / f"{robot}.said").read_bytes().splitlines(keepends=True)
    reports = [json.loads(line) for line in lines if line.endswith(b"\n")]
    return next((report["stamp"] for report in reports if len(report["present"]) == 2 and report["stamp"] > since), 0.0)
