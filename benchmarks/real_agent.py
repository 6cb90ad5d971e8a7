"""One real agent, seen from outside, among robots that only tell. For the benchmarks that measure an agent's process.

It runs at the pace of the wall clock over Zenoh on loopback; the rest of its team are threads of another process, with
keys, gossip and a Zenoh session each, without estimates. Linux: costs are read from /proc.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from pathlib import Path
from random import Random

import msgspec
import numpy as np
from virtual_team import Teller

from dgorl.configuration import Configuration, merge
from dgorl.measurements import Displacement, Odometry, known_at
from dgorl.simulation import Scenario, simulate
from dgorl.team.bundler import Bundler
from dgorl.team.fleet import Fleet, author, in_order, prepare, wait
from dgorl.team.gossip import Gossip
from dgorl.team.keys import load_key
from dgorl.team.lines import LinesIn
from dgorl.team.pace import READY
from dgorl.team.report import Report, read_report
from dgorl.team.team_file import TeamFile
from dgorl.team.zenoh_transport import ZenohTransport

ROBOT = "r1"
"""The one that is measured."""
LEAD = 3.0
"""The log begins this long [s] after the agent is ready; the others start meanwhile."""
LOOK = 0.02
"""The others look at the network this often [s]."""
TICK = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Scene:
    """A simulated team at 2 Hz with known starts and real wheels, a fifth of the paper's noise; where its files are.

    twists: odometry every 0.1 s instead of one row a step. latency: the measured agent's sensors tell so late [s].
    """

    folder: Path
    seconds: float
    robots: int = 5
    sensors: tuple[str, ...] = ("rssi", "range")
    twists: bool = False
    latency: float = 0.0

    def fleet(self) -> Fleet:
        """The same in every process."""
        steps = round(2 * self.seconds)
        log = simulate(Scenario(robots=self.robots, steps=steps, area=25.0, sensors=self.sensors, odometry_noise=0.2))
        if self.twists:
            measurements = chain.from_iterable(
                _twists(m) if isinstance(m, Displacement) else (m,) for m in log.measurements
            )
            log = replace(log, measurements=tuple(measurements))
        return Fleet(log, merge(Configuration(), log.configuration, "log"), self.folder, log.starts, settle=0.0)


def _twists(step: Displacement) -> Iterator[Odometry]:
    """Straight on, then a turn in place, as the simulator moves."""
    ends = np.linspace(step.start, step.end, 6).tolist()
    for k, (start, end) in enumerate(pairwise(ends)):
        v, omega = (step.dx / 4 / (end - start), 0.0) if k < 4 else (0.0, step.dtheta / (end - start))
        yield Odometry(step.robot, start, end, v, omega)


@dataclass(frozen=True)
class Cost:
    """What a process has used so far [s of CPU, by thread name too], and what it holds [MB]."""

    at: float
    cpu: float
    threads: Counter[str]
    rss: float


@dataclass(frozen=True)
class Said:
    """A report, and how long after its tick it was published [s]."""

    report: Report
    lag: float


@dataclass
class Measured:
    """The agent's process. ``said`` grows while it runs."""

    fleet: Fleet
    latency: float
    process: subprocess.Popen[bytes]
    at: float = 0.0
    said: list[Said] = field(default_factory=list)

    def log_time(self) -> float:
        """The log's time now [s]."""
        return self.fleet.first + time.monotonic() - self.at

    def cost(self) -> Cost:
        """Now."""
        threads: Counter[str] = Counter()
        for task in Path(f"/proc/{self.process.pid}/task").iterdir():
            name, _, rest = (task / "stat").read_text().partition("(")[2].rpartition(")")
            user, system = rest.split()[11:13]
            threads[name.rstrip("0123456789")] += (int(user) + int(system)) / TICK
        # Of the whole process, threads that ended included.
        user, system = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        return Cost(time.monotonic(), (int(user) + int(system)) / TICK, threads, self.rss())

    def rss(self) -> float:
        """Its memory now, pages of shared libraries included [MB]."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20

    def during(self, begin: float, end: float) -> list[Said]:
        """What it said of ticks from begin to end [s of the log]."""
        return [one for one in self.said if begin <= one.report.stamp < end and not one.report.final]

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in LinesIn(self.process.stdout.fileno()):
            came = time.monotonic()
            try:
                report = read_report(line)
            except msgspec.MsgspecError:
                continue
            self.said.append(Said(report, came - self.at - (report.stamp - self.fleet.first)))

    def _feed(self) -> None:
        assert self.process.stdin is not None
        for stamp, (robot, line) in in_order(self.fleet):
            if robot == ROBOT:
                wait(stamp + self.latency, self.fleet, self.at)
                try:
                    self.process.stdin.write(line + b"\n")
                    self.process.stdin.flush()
                except OSError:
                    return


@contextmanager
def among_others(scene: Scene) -> Iterator[Measured]:
    """The agent from the log's beginning on, all its team there."""
    fleet = scene.fleet()
    prepare(fleet)
    command = fleet.command(ROBOT)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with fleet.messages(ROBOT).open("wb") as messages:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=messages, env=environment
        )
    assert process.stdin is not None
    measured, others = Measured(fleet, scene.latency, process), None
    try:
        while READY not in fleet.messages(ROBOT).read_text():
            if process.poll() is not None:
                raise SystemExit(fleet.messages(ROBOT).read_text())
            time.sleep(0.05)
        measured.at = time.monotonic() + LEAD
        process.stdin.write(f"{measured.at!r}\n".encode())
        process.stdin.flush()
        others = multiprocessing.get_context("spawn").Process(target=_others, args=(scene, measured.at), daemon=True)
        others.start()
        threads = [threading.Thread(target=run, daemon=True) for run in (measured._read, measured._feed)]
        for thread in threads:
            thread.start()
        yield measured
    finally:
        process.kill()
        process.wait()
        if others is not None and others.pid is not None:
            others.kill()
            others.join()


def _others(scene: Scene, at: float) -> None:
    """The rest of the team, until they are ended. They would have computers of their own: the agent goes first."""
    os.nice(10)
    fleet = scene.fleet()
    team, pace = TeamFile.read(fleet.folder / "team.yaml"), fleet.pace(ROBOT, at)
    tellers, rows = [], {}
    for robot in fleet.log.robots:
        if robot == ROBOT:
            continue
        key, epoch = load_key(fleet.folder / f"{robot}.key"), Random(robot).getrandbits(64)
        gossip = Gossip(robot, epoch, team.roster, key, team.configuration_hash)
        bundler = Bundler(team.team, robot, epoch, substep=team.substep)
        network = ZenohTransport(team.team, robot, team.transport, pace.now, fleet.folder, team.roster.robots)
        tellers.append((robot, Teller(bundler, gossip, key, network, fleet.configuration.period)))  # type: ignore[arg-type]
        rows[robot] = deque(sorted((m for m in fleet.log.measurements if author(m) == robot), key=known_at))
    while True:
        for robot, teller in tellers:
            now = pace.now()
            while rows[robot] and known_at(rows[robot][0]) <= now:
                teller.take(rows[robot].popleft())
            teller.step(now)
        time.sleep(LOOK)


def spent(before: Cost, after: Cost) -> float:
    """Share of one core."""
    return (after.cpu - before.cpu) / (after.at - before.at)


def by_thread(before: Cost, after: Cost) -> str:
    """Share of one core by kind of thread, the largest first."""
    seconds = after.at - before.at
    shares = {name: (cpu - before.threads[name]) / seconds for name, cpu in after.threads.items()}
    kinds = sorted(shares.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} {share:.1%}" for name, share in kinds if share > 0.0005)


def lags(said: Sequence[Said]) -> np.ndarray:
    """How long after their ticks estimates were published [ms]."""
    return 1e3 * np.array([one.lag for one in said])
