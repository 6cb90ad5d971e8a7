"""A whole live team on this machine: one agent process a robot, fed from a log at any rate, on a network with faults.

The agents are the ones that run on robots; they meet over loopback, with keys and a team file made for them.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from dgorl.configuration import Configuration, as_dict
from dgorl.errors import DgorlError
from dgorl.logs.log import Log, Start
from dgorl.measurements import Displacement, Measurement, Odometry, known_at, robots_of
from dgorl.plain_yaml import yaml_text
from dgorl.team.agent_process import AgentProcess
from dgorl.team.fault_file import FaultFile
from dgorl.team.intake import Moved, line_of
from dgorl.team.keys import make_key
from dgorl.team.pace import Pace

LEAD = 0.5, 0.1
"""The log begins this long [s] after all agents are ready, and this longer for each of them: they have to meet."""
CATCH_UP = 3.0
"""At any rate bundles are exchanged for this long [s of the machine] after the log's end: it may be busy."""
PATIENCE = 30.0
"""An agent that has not left this long [s] after its time is ended."""


@dataclass(frozen=True)
class Event:
    """What happens to ``robot`` at ``stamp`` [s of the log]: its process is killed, or started."""

    stamp: float
    robot: str
    kind: str


@dataclass(frozen=True)
class Fleet:
    """What is to run. Times are the log's [s].

    starts: known start poses, empty when they are unknown. rate: log seconds a second. offsets [s], drifts [ppm]: of
    robots' clocks. events: sorted. settle: how long bundles are exchanged after the log's end.
    """

    log: Log
    configuration: Configuration
    folder: Path
    starts: Mapping[str, Start] = field(default_factory=dict)
    rate: float = 1.0
    faults: FaultFile | None = None
    offsets: Mapping[str, float] = field(default_factory=dict)
    drifts: Mapping[str, float] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    settle: float = 10.0

    @cached_property
    def first(self) -> float:
        """When the log begins [s]: the first tick of a replay."""
        period = self.configuration.period
        return -(-min(map(known_at, self.log.measurements)) // period) * period

    @cached_property
    def last(self) -> float:
        """Its last tick [s]."""
        period = self.configuration.period
        return max(map(known_at, self.log.measurements)) // period * period

    @property
    def quiet(self) -> float:
        """How long agents go on after its end [s]."""
        return max(self.settle, CATCH_UP * self.rate)

    def pace(self, robot: str, at: float = 0.0) -> Pace:
        """The robot's clock; ``at``: the machine's monotonic clock when the log begins."""
        return Pace(self.first, at, self.rate, self.offsets.get(robot, 0.0), self.drifts.get(robot, 0.0))

    def late(self, robot: str) -> bool:
        """Whether it is not there when the log begins."""
        return next((event.kind == "join" for event in self.events if event.robot == robot), False)

    def lives(self, robot: str) -> int:
        """How often its program begins."""
        joins = sum(event.kind == "join" and event.robot == robot for event in self.events)
        return joins + (not self.late(robot))

    def command(self, robot: str) -> list[str]:
        """Its agent's command line."""
        pace = self.pace(robot)
        words: list[object] = ["agent", "--robot", robot, "--stdin", "--sync", "normal"]
        words += ["--team", self.folder / "team.yaml", "--key", self.folder / f"{robot}.key"]
        words += ["--journal", self.journal(robot), f"--origin={pace.origin}", "--rate", pace.rate]
        words += [f"--clock-offset={pace.offset}", f"--clock-drift={pace.drift}"]
        words += [f"--until={pace.to_robot(self.last)}", "--settle", self.quiet]
        if self.faults is not None:
            words += ["--faults", self.folder / "faults.json"]
        return [sys.executable, "-m", "dgorl", *map(str, words)]

    def journal(self, robot: str) -> Path:
        """The robot's journal."""
        return self.folder / f"{robot}.journal"

    def reports(self, robot: str) -> Path:
        """What its agent said on stdout."""
        return self.folder / f"{robot}.jsonl"

    def messages(self, robot: str) -> Path:
        """... and on stderr."""
        return self.folder / f"{robot}.log"


def run(fleet: Fleet) -> None:
    """Run it to its end; what it leaves are journals, reports and logs in its folder. Raises DgorlError."""
    due = in_order(fleet)
    prepare(fleet)
    lives = {
        robot: [
            AgentProcess(fleet.command(robot), fleet.reports(robot), fleet.messages(robot))
            for _ in range(fleet.lives(robot))
        ]
        for robot in fleet.log.robots
    }
    everyone = [life for robot in lives.values() for life in robot]
    try:
        for life in everyone:
            life.ready()
        at = time.monotonic() + LEAD[0] + LEAD[1] * len(lives)
        awake = {robot: life.pop(0).begin(at) for robot, life in lives.items() if not fleet.late(robot)}
        for stamp, what in due:
            wait(stamp, fleet, at)
            if not isinstance(what, Event):
                robot, line = what
                if robot in awake:
                    awake[robot].say(line)
            elif what.kind == "join":
                awake[what.robot] = lives[what.robot].pop(0).begin(at)
            elif what.robot in awake:
                awake.pop(what.robot).kill()
        for life in awake.values():
            life.no_more()
        deadline = at + (fleet.last + fleet.quiet - fleet.first) / fleet.rate + PATIENCE
        for robot, life in awake.items():
            if not life.leaves(deadline):
                raise DgorlError(f"{robot}: its agent did not end well; see {fleet.messages(robot)}")
    finally:
        for life in everyone:
            life.kill()


def prepare(fleet: Fleet) -> None:
    """Make the folder with keys, team.yaml and faults, in place of an earlier fleet's."""
    folder = fleet.folder
    folder.mkdir(parents=True, exist_ok=True)
    for pattern in ("*.key", "*.journal*", "*.jsonl", "*.log", "team.yaml", "faults.json"):
        for file in folder.glob(pattern):
            file.unlink()
    keys = {robot: make_key(folder / f"{robot}.key").public for robot in fleet.log.robots}
    ports = _free_ports(len(keys))
    team = {
        "team": "fleet",
        "robots": {robot: {"key": key} for robot, key in keys.items()},
        "start": {robot: list(start.pose) for robot, start in fleet.starts.items()},
        "start_stamp": {robot: start.stamp for robot, start in fleet.starts.items()} or None,
        "transport": {"addresses": {r: f"tcp/127.0.0.1:{port}" for r, port in zip(keys, ports, strict=True)}},
        **as_dict(fleet.configuration),
    }
    text = yaml_text(team)
    (folder / "team.yaml").write_text(text, encoding="utf-8")
    if fleet.faults is not None:
        fleet.faults.write(folder / "faults.json")


Due = Event | tuple[str, bytes]


def in_order(fleet: Fleet) -> list[tuple[float, Due]]:
    """Events, and each robot's lines at the time they are known [s of the log]."""
    due: list[tuple[float, int, Due]] = [(event.stamp, 0, event) for event in fleet.events]
    epochs: dict[str, int] = {}
    for measurement in sorted(fleet.log.measurements, key=known_at):
        robot = author(measurement)
        pace, stamp = fleet.pace(robot), known_at(measurement)
        if isinstance(measurement, Odometry | Displacement):
            before = epochs.get(robot, measurement.epoch)
            epochs[robot] = measurement.epoch
            if measurement.epoch != before:
                due.append((stamp, 1, (robot, line_of(Moved(pace.to_robot(measurement.start))))))
        due.append((stamp, 1, (robot, line_of(_on_clock(measurement, pace)))))
    return [(stamp, what) for stamp, _, what in sorted(due, key=lambda item: item[:2])]


def author(measurement: Measurement) -> str:
    """Who made a measurement."""
    return robots_of(measurement)[0]


def _on_clock(measurement: Measurement, pace: Pace) -> Measurement:
    """A measurement with its stamps on the robot's clock."""
    names = ("start", "end") if isinstance(measurement, Odometry | Displacement) else ("stamp",)
    stamps: dict[str, Any] = {name: pace.to_robot(getattr(measurement, name)) for name in names}
    return replace(measurement, **stamps)


def wait(stamp: float, fleet: Fleet, at: float) -> None:
    """Until the log is at ``stamp`` [s]; it began when the monotonic clock was at ``at`` [s]."""
    remaining = at + (stamp - fleet.first) / fleet.rate - time.monotonic()
    if remaining > 0.0:
        time.sleep(remaining)


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for probe in sockets:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in sockets]
    finally:
        for probe in sockets:
            probe.close()
