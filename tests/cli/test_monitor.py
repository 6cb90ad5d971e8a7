"""``dgorl monitor`` and ``dgorl doctor`` beside real agents on loopback."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dgorl.team.zenoh_transport import open_session

from .commandline import ENVIRONMENT, Dgorl, command, fails_well
from .live_team import LiveTeam, live_team


def until(dgorl: Dgorl, arguments: tuple[object, ...], well: Callable[[str], bool]) -> str:
    """What the monitor prints, asked again for up to a minute: on a busy machine a robot may be late for a moment."""
    deadline = time.monotonic() + 60
    while True:
        done = dgorl("monitor", *arguments)
        if (done.returncode == 0 and well(done.stdout)) or time.monotonic() > deadline:
            assert done.returncode == 0, done.stderr
            return done.stdout


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory, dgorl: Dgorl) -> Iterator[LiveTeam]:
    """r1 and r2 are there, r3 has another team.yaml."""
    with live_team(tmp_path_factory.mktemp("team")) as made:
        made.start("r1")
        made.start("r2")
        made.start("r3", made.write("other.yaml", {"history": 60.0}))
        until(
            dgorl,
            ("--team", made.file, "--once", "--json", "--seconds", "3"),
            lambda told: all(robot["says"] for robot in json.loads(told)["robots"].values()),
        )
        yield made


def test_once_prints_a_table(dgorl: Dgorl, team: LiveTeam) -> None:
    def tracked(text: str) -> bool:
        rows = [line.split() for line in text.splitlines()]
        return any(row[:1] == ["r1"] and "r2" in row and "tracked" in row for row in rows)

    text = until(dgorl, ("--team", team.file, "--once"), tracked)
    assert tracked(text), text
    assert "Team lab: 3 of 3 robots are heard" in text
    assert "r3: has another team.yaml" in text


def test_one_robot_as_json(dgorl: Dgorl, team: LiveTeam) -> None:
    def status(text: str) -> str:
        says = json.loads(text)["robots"]["r1"]["says"]
        return says["peers"]["r2"]["status"] if says else "silent"

    arguments = ("--team", team.file, "--once", "--json", "--robot", "r1")
    state = json.loads(until(dgorl, arguments, lambda text: status(text) == "tracked"))
    assert state["team"] == "lab"
    assert list(state["robots"]) == ["r1"]
    robot = state["robots"]["r1"]
    assert robot["same_team_file"] is True
    assert abs(robot["clock"]["ahead_s"]) < 0.5
    peer = robot["says"]["peers"]["r2"]
    assert peer["status"] == "tracked"
    assert peer["pose"][:2] == pytest.approx([3.0, 0.0], abs=0.5)
    assert 0.0 < peer["position_sigma_m"] < 1.0
    assert robot["says"]["loss"]["r2"] < 0.5
    assert robot["says"]["sent_bytes_per_s"] > 0


def test_watching_costs_robots_nothing_that_they_hear(dgorl: Dgorl, team: LiveTeam) -> None:
    """Robots do not get bulletins: what r1 receives is what the others send beside them."""
    state = json.loads(dgorl("monitor", "--team", team.file, "--once", "--json").stdout)["robots"]
    assert "monitor" not in state["r1"]["says"]["present"]
    assert state["r1"]["says"]["present"] == ["r2", "r3"]


@pytest.mark.parametrize("terminal", [False, True], ids=["pipe", "terminal"])
def test_live_until_interrupted(team: LiveTeam, terminal: bool) -> None:
    ours, theirs = pty.openpty() if terminal else os.pipe()
    process = subprocess.Popen(
        command("monitor", "--team", team.file, "--every", "0.5"),
        stdout=theirs,
        stderr=subprocess.PIPE,
        env=ENVIRONMENT,
    )
    os.close(theirs)
    text, deadline = b"", time.monotonic() + 30
    while text.count(b"Team lab") < 3 and time.monotonic() < deadline:
        text += os.read(ours, 65536)
    process.send_signal(signal.SIGINT)
    try:
        while os.read(ours, 65536):
            pass
    except OSError:  # the terminal is closed
        pass
    _, errors = process.communicate(timeout=20)
    os.close(ours)
    assert text.count(b"Team lab") >= 3
    assert process.returncode == 130
    assert errors == b"interrupted\n"
    assert (b"\x1b[" in text) == terminal


def test_a_picture_on_disk(dgorl: Dgorl, team: LiveTeam, tmp_path: Path) -> None:
    picture = tmp_path / "live.png"
    done = dgorl("monitor", "--team", team.file, "--viewer", "--once", "--out", picture)
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert list(tmp_path.iterdir()) == [picture]


def test_doctor_names_whose_file_differs(dgorl: Dgorl, team: LiveTeam) -> None:
    done = dgorl("doctor", "--team", team.file, "--journal", team.folder / "r1.journal", "--seconds", "4")
    assert done.returncode == 1
    assert "r3: another team.yaml (hash" in done.stdout
    assert "r1 is on the network, dgorl" in done.stdout
    assert "in use by an agent" in done.stdout
    assert done.stderr.startswith("dgorl: ")
    assert done.stderr.count("\n") == 1


def test_doctor_says_who_is_missing_as_json(dgorl: Dgorl, tmp_path: Path) -> None:
    with live_team(tmp_path) as team:
        team.start("r1")
        deadline = time.monotonic() + 30
        while (
            dgorl("monitor", "--team", team.file, "--once", "--seconds", "3").returncode and time.monotonic() < deadline
        ):
            pass
        done = dgorl("doctor", "--team", team.file, "--json", "--seconds", "3")
    assert done.returncode == 1
    told = json.loads(done.stdout)
    assert told["well"] is False
    problems = [finding["what"] for finding in told["findings"] if finding["level"] == "problem"]
    assert len(problems) == 2
    for robot, problem in zip(("r2", "r3"), problems, strict=True):
        address = team.data["transport"]["addresses"][robot]
        assert problem == f"{robot} is not on the network ({address}: the machine is there, no agent listens)"


def test_strangers_names_reach_no_terminal(dgorl: Dgorl, team: LiveTeam) -> None:
    """Anybody on the network may be called what he likes: escape sequences, lines of his own."""
    names = ("\x1b]0;owned\x07", "y\n✓ network nobody to see here", "\x9b1mz")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    watched = team.write("watched.yaml", {"transport": {**team.data["transport"], "connect": [endpoint]}})
    settings = {"mode": "peer", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    with open_session(settings) as stranger:
        tokens = [stranger.liveliness().declare_token(f"dgorl/lab/{name}/alive") for name in names]
        heard = dgorl("doctor", "--team", watched, "--seconds", "3")
        seen = dgorl("monitor", "--team", watched, "--once")
        for token in tokens:
            token.undeclare()
    said = heard.stdout + heard.stderr + seen.stdout + seen.stderr
    assert all(c.isprintable() or c == "\n" for c in said)
    assert not any(word in said for word in ("owned", "nobody to see", "1mz"))
    assert "3 on the network under a name that no robot can have" in heard.stdout
    assert "under names that no robot can have: 3" in seen.stdout


def test_nobody_is_heard(dgorl: Dgorl, tmp_path: Path) -> None:
    with live_team(tmp_path) as team:
        done = dgorl("monitor", "--team", team.file, "--once", "--seconds", "0.5")
        assert "nobody was heard for 0.5 s; `dgorl doctor --team" in fails_well(done)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--robot", "r7", "--once"], "no robot is called `r7`"),
        (["--out", "x.png"], "--viewer"),
        (["--every", "0"], "must be positive"),
        (["--viewer", "--once"], "--out FILE.png"),
    ],
)
def test_what_cannot_be_is_said(dgorl: Dgorl, tmp_path: Path, arguments: list[str], what: str) -> None:
    with live_team(tmp_path) as team:
        assert what in fails_well(dgorl("monitor", "--team", team.file, *arguments))
