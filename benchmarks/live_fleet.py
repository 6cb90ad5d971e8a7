"""Fleets for ``live.py``: run one as ``dgorl fleet`` does, and read what it left, journals included."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from dgorl import logs
from dgorl.cli import fleet as command
from dgorl.cli.parsing import parse
from dgorl.evaluation.metrics import figures
from dgorl.evaluation.records import PairRecord, Records
from dgorl.measurements import WORLD, known_at
from dgorl.team import fleet_results
from dgorl.team.bundles import Name
from dgorl.team.fleet import Fleet, run
from dgorl.team.journal_data import parse as parse_data
from dgorl.team.journal_read import contents
from dgorl.team.journal_schema import Kind, connect
from dgorl.team.report import Report

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Row:
    """What is asked, what was measured, the command, and whether the one meets the other."""

    asked: str
    measured: str
    command: str
    good: bool


@dataclass(frozen=True)
class Place:
    """Where rows leave their fleets, and where the recordings are; ``short``: less of everything, to try a row."""

    out: Path
    data: Path
    short: bool = False

    def folder(self, name: str) -> Path:
        path = self.out / name
        path.mkdir(parents=True, exist_ok=True)
        return path


@dataclass(frozen=True)
class Stored:
    """A bundle in a journal. body: its signed bytes. cut: when it was made. held: by the tick at this time it was
    there [s, both on the clocks of those who wrote them]."""

    body: bytes
    cut: float
    held: float


def stored(path: Path) -> dict[Name, Stored]:
    """All bundles of a journal."""
    cuts = {name: bundle.cut for name, bundle in contents(path).bundles.items()}
    found, fresh = {}, []
    with closing(connect(path, "ro")) as database:
        rows = database.execute("SELECT kind, now, robot, epoch, sequence, body FROM entries ORDER BY number")
        for kind, now, robot, epoch, sequence, body in rows:
            if kind == Kind.BUNDLE:
                fresh.append((Name(robot, int(epoch, 16), sequence), bytes(body)))
            elif kind == Kind.TICK:
                found |= {name: Stored(data, cuts[name], now) for name, data in fresh}
                fresh = []
    return found | {name: Stored(data, cuts[name], inf) for name, data in fresh}


@dataclass(frozen=True)
class Left:
    """A fleet that has run, and the words ``dgorl fleet`` takes for the same."""

    fleet: Fleet
    words: tuple[str, ...]

    @cached_property
    def reports(self) -> dict[str, list[Report]]:
        return fleet_results.reports_of(self.fleet)

    @cached_property
    def records(self) -> Records:
        return fleet_results.records_of(self.fleet, self.reports)

    @cached_property
    def checks(self) -> fleet_results.Checks:
        return fleet_results.check(self.fleet, self.reports)

    @cached_property
    def journals(self) -> dict[str, dict[Name, Stored]]:
        return {robot: stored(self.fleet.journal(robot)) for robot in self.fleet.log.robots}

    @cached_property
    def team(self) -> dict[str, float | None]:
        return figures(self.records.between_robots())

    @property
    def said(self) -> str:
        """The command for a table, without this machine's paths."""
        words = ["LOG" if word == str(self.fleet.log.path) else word.removeprefix(f"{ROOT}/") for word in self.words]
        return f"`dgorl fleet {' '.join(words)}`"

    @property
    def skipped(self) -> float:
        """Share of the ticks that a busy machine cost."""
        stamps = {robot: self.records.pairs[robot, peer].t for robot, peer in self.records.pairs if peer != WORLD}
        due = (self.fleet.last - self.fleet.first) / self.fleet.configuration.period * len(stamps)
        return max(1.0 - sum(map(len, stamps.values())) / due, 0.0)

    def equal(self) -> bool:
        """Whether all were there at the end, hold the same, and estimate the same of it."""
        checks = self.checks
        return set(checks.robots) == set(self.fleet.log.robots) and checks.data and checks.estimates is not False

    def told(self) -> str:
        """... in words."""
        checks = self.checks
        if not self.equal():
            return f"NOT EQUAL ({'; '.join(checks.differences) or ', '.join(checks.robots)})"
        return f"data of {len(checks.robots)} robots equal" + (", estimates to the bit" if checks.estimates else "")

    def held_after(self, stamp: float) -> float:
        """How long after ``stamp`` [s] all held all that was cut by then [s]."""
        due = {name for journal in self.journals.values() for name, b in journal.items() if b.cut <= stamp}
        last = max(journal[name].held if name in journal else inf for journal in self.journals.values() for name in due)
        return max(last - stamp, 0.0)

    def admitted_after(self, stamp: float) -> float:
        """How long after ``stamp`` [s] all estimates were made of all that was cut by then [s]."""
        due = {name for journal in self.journals.values() for name, b in journal.items() if b.cut <= stamp}
        return max(max(_first_with(said, due, stamp) for said in self.reports.values()) - stamp, 0.0)

    def numbering(self) -> tuple[int, int, int]:
        """Bundles in all journals together; of these, how many their own robot lost; names of two contents."""
        bodies: dict[Name, set[bytes]] = {}
        for journal in self.journals.values():
            for name, bundle in journal.items():
                bodies.setdefault(name, set()).add(bundle.body)
        lost = sum(name not in self.journals[name.robot] for name in bodies)
        return len(bodies), lost, sum(len(contents) > 1 for contents in bodies.values())

    def gaps(self) -> int:
        """Numbers of a robot's epoch below its last that its own journal does not hold."""
        own: dict[tuple[str, int], set[int]] = {}
        for robot, journal in self.journals.items():
            for name in journal:
                if name.robot == robot:
                    own.setdefault((robot, name.epoch), set()).add(name.sequence)
        return sum(max(numbers) + 1 - len(numbers) for numbers in own.values())


def _first_with(said: Sequence[Report], due: Iterable[Name], stamp: float) -> float:
    for report in said:
        if report.stamp >= stamp:
            data = parse_data(report.data)
            if all(name.sequence in data.get((name.robot, name.epoch), ()) for name in due):
                return report.stamp
    return inf


def ran(out: Path, *words: object) -> Left:
    """``dgorl fleet WORDS``, but for what it prints and draws."""
    texts = tuple(map(str, words))
    fleet = command.fleet_of(parse(command.Options, "fleet", None, [*texts, "--out", str(out)]))
    run(fleet)
    return Left(fleet, texts)


def replayed(out: Path, *words: object) -> dict[tuple[str, str], Mapping[str, Any]]:
    """The last rows ``dgorl run WORDS`` writes."""
    dgorl("run", *words, "--out", out)
    rows = {}
    for path in sorted(out.glob("relative/*/*.csv")):
        with path.open(encoding="utf-8") as file:
            *_, rows[path.parent.name, path.stem] = csv.DictReader(file)
    return rows


def apart(left: Left, rows: Mapping[tuple[str, str], Mapping[str, Any]]) -> float:
    """The largest difference between a fleet's last poses and a replay's [m, rad]."""
    final = fleet_results.final_of(left.fleet, left.checks)
    differences = []
    for ego, peers in final["egos"].items():
        for peer, said in peers.items():
            row, pose = rows[ego, peer], said["pose"]
            if (float(row["t"]), row["status"], row["x"] == "") != (final["stamp"], said["status"], pose is None):
                return inf
            if pose is not None:
                differences += [abs(float(row[n]) - v) for n, v in zip(("x", "y", "theta"), pose, strict=True)]
    return max(differences)


def dgorl(*words: object) -> None:
    """A command that must succeed."""
    subprocess.run([sys.executable, "-m", "dgorl", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


def simulated(path: Path, seconds: float, robots: int = 5, sensors: str = "rssi,range") -> Path:
    """A log of a team in a square of 25 m; its wheels are real ones, a fifth of the paper's noise."""
    words = ("--robots", robots, "--steps", round(2 * seconds), "--area", 25, "--sensors", sensors)
    dgorl("simulate", *words, "--odometry-noise", 0.2, "--out", path)
    return path


def beginning(path: Path, source: Path, seconds: float) -> Path:
    """The first seconds of a recording, ranges and bearings, as a log of its own: two commands read the same."""
    whole = logs.read(source, ("range", "bearing"))
    end = min(map(known_at, whole.measurements)) + seconds
    logs.write(replace(whole, measurements=tuple(m for m in whole.measurements if known_at(m) <= end)), path)
    return path


def located(records: Iterable[PairRecord], start: float = -inf, end: float = inf) -> float:
    """Share of the pairs' ticks from start to end that are located."""
    return float(np.mean(np.concatenate([r.located[(r.t >= start) & (r.t <= end)] for r in records])))
