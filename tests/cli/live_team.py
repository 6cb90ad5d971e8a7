"""Real agents on loopback that stand still, for what watches them."""

from __future__ import annotations

import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import atan2, hypot
from pathlib import Path

import yaml

from dgorl.measurements import Bearing, Measurement, Odometry, Range
from dgorl.team.intake import line_of
from dgorl.team.keys import make_key

from .commandline import ENVIRONMENT, command

PLACES = {"r1": (0.0, 0.0), "r2": (3.0, 0.0), "r3": (1.5, 2.6)}
ROBOTS = tuple(PLACES)
PERIOD = 0.25


@dataclass
class LiveTeam:
    """``team.yaml`` names r1, r2 and r3. ``robots``: their processes."""

    folder: Path
    data: dict
    robots: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    @property
    def file(self) -> Path:
        return self.folder / "team.yaml"

    def write(self, name: str, changes: Mapping[str, object]) -> Path:
        path = self.folder / name
        path.write_text(yaml.safe_dump({**self.data, **changes}))
        return path

    def start(self, robot: str, file: Path | None = None) -> None:
        arguments = ("--robot", robot, "--team", file or self.file, "--key", self.folder / f"{robot}.key", "--stdin")
        journal = ("--journal", self.folder / f"{robot}.journal", "--sync", "normal")
        with (self.folder / f"{robot}.log").open("ab") as messages:
            self.robots[robot] = subprocess.Popen(
                command("agent", *arguments, *journal),
                env={**ENVIRONMENT, "OPENBLAS_NUM_THREADS": "1"},
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=messages,
            )

    def sense(self, stop: threading.Event) -> None:
        """Tell all agents that they stand, 3 m apart, and where they see one another."""
        while not stop.wait(PERIOD):
            now = time.time()
            for robot, process in list(self.robots.items()):
                rows: list[Measurement] = [Odometry(robot, now - PERIOD, now, 0.0, 0.0)]
                for other in ROBOTS:
                    if other != robot:
                        dx, dy = (b - a for a, b in zip(PLACES[robot], PLACES[other], strict=True))
                        rows += [Range(robot, other, now, hypot(dx, dy), 0.1)]
                        rows += [Bearing(robot, other, now, atan2(dy, dx), 0.05)]
                try:
                    process.stdin.write(b"".join(line_of(row) + b"\n" for row in rows))
                    process.stdin.flush()
                except OSError:
                    continue


@contextmanager
def live_team(folder: Path, **changes: object) -> Iterator[LiveTeam]:
    """A team without robots yet; those that were started are ended."""
    ports = []
    with socket.socket() as a, socket.socket() as b, socket.socket() as c:
        for probe in (a, b, c):
            probe.bind(("127.0.0.1", 0))
            ports.append(probe.getsockname()[1])
    data = {
        "team": "lab",
        "robots": {robot: {"key": make_key(folder / f"{robot}.key").public} for robot in ROBOTS},
        "transport": {"addresses": {r: f"tcp/127.0.0.1:{port}" for r, port in zip(ROBOTS, ports, strict=True)}},
        "start": {robot: [*place, 0.0] for robot, place in PLACES.items()},
        "start_stamp": time.time(),
        **changes,
    }
    team = LiveTeam(folder, data)
    team.write("team.yaml", {})
    stop = threading.Event()
    senses = threading.Thread(target=team.sense, args=(stop,))
    senses.start()
    try:
        yield team
    finally:
        stop.set()
        senses.join()
        for process in team.robots.values():
            process.terminate()
            with suppress(BrokenPipeError):
                process.stdin.close()
        for process in team.robots.values():
            process.wait(20)
