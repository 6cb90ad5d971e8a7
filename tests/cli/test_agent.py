"""`dgorl agent` as robots run it: a process that is fed, asked, stopped, killed and started again."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh

from dgorl.measurements import Odometry, Rssi
from dgorl.team.intake import line_of
from dgorl.team.journal_data import parse
from dgorl.team.keys import make_key
from dgorl.team.report import Report, read_report
from dgorl.team.zenoh_transport import open_session

from .commandline import ENVIRONMENT, Dgorl, command

RATE = 5.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Process:
    """One agent; its clock shows 0 s at ``at`` on the machine's monotonic clock and runs fast."""

    def __init__(self, folder: Path, robot: str, at: float, *more: object) -> None:
        self.at, self.robot = at, robot
        self.reports = folder / f"{robot}-{time.monotonic_ns()}.jsonl"
        self.messages = self.reports.with_suffix(".log")
        words = ["agent", "--robot", robot, "--team", folder / "team.yaml", "--key", folder / f"{robot}.key"]
        words += ["--journal", folder / f"{robot}.journal", "--origin=0", f"--at={at}", f"--rate={RATE}", *more]
        with self.reports.open("wb") as out, self.messages.open("wb") as errors:
            self.process = subprocess.Popen(
                command(*words), stdin=subprocess.PIPE, stdout=out, stderr=errors, env=ENVIRONMENT, cwd=folder
            )

    @property
    def now(self) -> float:
        return (time.monotonic() - self.at) * RATE

    def say(self, line: bytes) -> None:
        self.process.stdin.write(line + b"\n")
        self.process.stdin.flush()

    def said(self) -> list[Report]:
        lines = self.reports.read_bytes().splitlines(keepends=True)
        return [read_report(line) for line in lines if line.startswith(b'{"type":"estimate"') and line.endswith(b"\n")]

    def answers(self) -> list[dict[str, Any]]:
        lines = self.reports.read_bytes().splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.startswith(b'{"type":"error"') and line.endswith(b"\n")]

    def event(self, name: str) -> dict[str, Any] | None:
        records = [json.loads(line) for line in self.messages.read_text().splitlines()]
        assert all({"time", "level", "robot", "event"} <= record.keys() for record in records)
        return next((record for record in records if record["event"] == name), None)

    def drive(self, begin: float) -> float:
        """Odometry and a reading of the other robot from ``begin`` [s] to now; until when it was."""
        other = {"r1": "r2", "r2": "r1"}[self.robot]
        while begin + 0.5 <= self.now:
            self.say(line_of(Odometry(self.robot, begin, begin + 0.5, 0.5, 0.1)))
            self.say(line_of(Rssi(other, self.robot, begin + 0.5, -60.0)))
            begin += 0.5
        return begin

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        with suppress(BrokenPipeError):
            self.process.stdin.close()

    def end(self, number: int) -> int:
        self.process.send_signal(number)
        return self.process.wait(20)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Keys and a team file."""
    keys = {robot: make_key(tmp_path / f"{robot}.key").public for robot in ("r1", "r2")}
    team = {
        "team": "lab",
        "robots": {robot: {"key": key} for robot, key in keys.items()},
        "transport": {"addresses": {robot: f"tcp/127.0.0.1:{free_port()}" for robot in keys}},
    }
    (tmp_path / "team.yaml").write_text(yaml.safe_dump(team))
    return tmp_path


@pytest.fixture
def launch(folder: Path) -> Iterator[Callable[..., Process]]:
    with ExitStack() as stack:

        def start(robot: str, at: float, *more: object) -> Process:
            launched = Process(folder, robot, at, *more)
            stack.callback(launched.close)
            return launched

        yield start


def until(holds: Callable[[], object], seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_first_start_is_no_warning(launch: Callable[..., Process]) -> None:
    agent = launch("r1", time.monotonic())
    until(lambda: agent.event("joined"))
    records = [json.loads(line) for line in agent.messages.read_text().splitlines()]
    assert any("a new epoch begins" in record["event"] for record in records)
    assert [record for record in records if record["level"] == "warning" and "no time" not in record["event"]] == []


def test_two_agents_from_start_to_end(launch: Callable[..., Process]) -> None:
    at = time.monotonic()
    robots = [launch(robot, at, "--stdin") for robot in ("r1", "r2")]
    first, second = robots
    until(lambda: all(robot.event("joined") for robot in robots))
    driven = {robot.robot: float(int(robot.now)) for robot in robots}

    def know_one_another() -> bool:
        for robot in robots:
            driven[robot.robot] = robot.drive(driven[robot.robot])
        said = [robot.said() for robot in robots]
        return all(reports and len(parse(reports[-1].data)) == 2 for reports in said)

    until(know_one_another)
    first.say(b'{"type": "range", "stamp": 1, "peer": "r2"}')
    until(first.answers)
    assert first.answers()[0]["what"].startswith("Object missing required field `range`")

    # SIGTERM: it says what it knows, leaves the network and the journal in good order, in little memory.
    assert first.end(signal.SIGTERM) == 0
    last = first.said()[-1]
    assert last.final
    assert last.rejected["bad line"] == 1
    assert last.peers["r2"].status in ("ambiguous", "unobservable", "isolated")
    left = first.event("left")
    assert left is not None
    assert left["peak_rss_mb"] <= 80
    until(lambda: second.said()[-1].present == ())

    # A power cut: the epoch goes on, and no number is used twice.
    second.process.kill()
    second.process.wait()
    joined, used = second.event("joined"), parse(second.said()[-1].data)
    again = launch("r2", at, "--stdin")
    until(lambda: again.event("joined"))
    resumed = again.event("joined")
    assert joined is not None
    assert resumed is not None
    assert resumed["epoch"] == joined["epoch"]
    assert resumed["next"] > used["r2", int(joined["epoch"], 16)].high
    until(again.said)
    assert used.keys() <= parse(again.said()[-1].data).keys()
    assert again.end(signal.SIGINT) == 130
    assert again.said()[-1].final


def test_measurements_on_loopback_and_none_from_the_team_network(launch: Callable[..., Process], folder: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    team = yaml.safe_load((folder / "team.yaml").read_text())["transport"]["addresses"]["r1"]
    agent = launch("r1", time.monotonic(), "--local", endpoint)
    until(lambda: agent.event("joined"))
    heard: dict[str, list[bytes]] = {"driver": [], "stranger": []}

    def joined(name: str, address: str) -> zenoh.Session:
        session = open_session({"mode": "client", "connect/endpoints": [address]})
        session.declare_subscriber("local/r1/*", lambda sample: heard[name].append(sample.payload.to_bytes()))
        session.declare_subscriber("dgorl/**", lambda sample: None)
        return session

    with joined("driver", endpoint) as driver, joined("stranger", team) as stranger:
        until(lambda: heard["driver"])
        line = line_of(Odometry("r1", agent.now - 0.5, agent.now, 0.5, 0.0))
        for _ in range(5):
            stranger.put("local/r1/measurements", b"what a stranger says")
            stranger.put("local/r1/estimate", b"what a stranger estimates")
        driver.put("local/r1/measurements", line + b"\nnonsense\n")
        until(lambda: agent.said() and agent.said()[-1].rejected)
        until(lambda: any(b'"error"' in payload for payload in heard["driver"]))
    assert read_report(heard["driver"][0]).robot == "r1"
    assert agent.end(signal.SIGTERM) == 0
    last = agent.said()[-1]
    assert last.rejected == {"bad line": 1}
    assert parse(last.data)
    assert set(heard["stranger"]) <= {b"what a stranger says", b"what a stranger estimates"}  # its own


def test_what_is_wrong_is_said_in_one_line(dgorl: Dgorl, folder: Path) -> None:
    def agent(*words: object, robot: str = "r1") -> str:
        done = dgorl("agent", "--robot", robot, "--team", folder / "team.yaml", *words, cwd=folder)
        (record,) = (json.loads(line) for line in done.stderr.splitlines())
        assert (done.returncode, done.stdout, record["level"]) == (1, "", "critical")
        return str(record["event"])

    key = ("--key", folder / "r1.key")
    assert "no robot is called `r3`; the robots are r1, r2" in agent(robot="r3")
    assert "r1 needs its key" in agent()
    assert "not the key of r1" in agent("--key", folder / "r2.key")
    assert "on loopback alone" in agent(*key, "--local", "tcp/0.0.0.0:7448")
    assert "no-such.yaml" in dgorl("agent", "--robot", "r1", "--team", folder / "no-such.yaml").stderr
    done = dgorl("agent", "--robot", "r1")
    assert done.returncode == 2


def test_it_does_without_what_is_large() -> None:
    what = (
        "import sys; from dgorl.cli.main import main; import dgorl.team.process, dgorl.cli.agent;"
        "print(sorted({'tyro', 'rich', 'scipy', 'matplotlib', 'gtsam'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", what], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
