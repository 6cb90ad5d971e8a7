"""A fleet whose robots come late, leave, and come back changed, for ``live.py``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import msgspec
from live_fleet import ROOT, Place, Row, beginning

from dgorl import logs
from dgorl.configuration import Configuration, load, merge
from dgorl.evaluation.records import LOCATED
from dgorl.team.agent_process import AgentProcess
from dgorl.team.fleet import LEAD, PATIENCE, Event, Fleet, in_order, prepare, wait
from dgorl.team.journal_data import held, ranges
from dgorl.team.journal_read import contents
from dgorl.team.ranges import Ranges
from dgorl.team.report import Report, read_report

CONFIG = ROOT / "configs" / "mrclam.yaml"

NEWEST = 120.0
"""Robots are compared by what was measured this long before the end [s]."""
FRESH = 1.5
"""What is known of a peer that is picked up is not older [s]."""


@dataclass(frozen=True)
class Life:
    """A robot's program from start to end [s from the log's beginning].

    leaves: in good order; else it is killed. offset: of its clock [s]. forgets: its journal is gone when it begins.
    """

    what: str
    robot: str
    start: float = -inf
    end: float = inf
    leaves: bool = False
    offset: float = 0.0
    forgets: bool = False


LIVES = (
    Life("", "r1"),
    Life("", "r2", end=110.0, offset=2.0),
    Life("without its journal", "r2", start=115.0, forgets=True, offset=2.0),
    Life("", "r3", end=160.0, offset=-3.0),
    Life("clock set back by 10.3 s", "r3", start=165.0, offset=-13.3),
    Life("", "r4", end=70.0, leaves=True, offset=1.3),
    Life("back after leaving", "r4", start=80.0, offset=1.3),
    Life("late", "r5", start=40.0, end=210.0, offset=4.1),
    Life("clock set ahead by 3 s", "r5", start=213.0, offset=7.1),
)
"""r1 alone is there all the time."""


@dataclass(frozen=True)
class Story:
    """pickups: of each late life, what it was and how long after its start all others had located it, and it them [s].

    equal: all hold the same at the end. epochs: of each robot, known to anybody.
    """

    pickups: tuple[tuple[str, float, float], ...]
    equal: bool
    epochs: Mapping[str, int]

    @property
    def good(self) -> bool:
        return self.equal and bool(self.pickups) and all(max(theirs, own) < inf for _, theirs, own in self.pickups)

    def told(self) -> str:
        said = (f"{what}: {theirs:.1f} / {own:.1f} s" for what, theirs, own in self.pickups)
        epochs = ", ".join(f"{robot} {number}" for robot, number in self.epochs.items())
        return (
            f"located by all others / locates them all after its start: {'; '.join(said)}; epochs {epochs}; "
            f"data at the end {'equal' if self.equal else 'NOT EQUAL'}"
        )


def churned(folder: Path, log: Path, rate: float) -> Story:
    """Run these lives over a log, every robot on a clock of its own."""
    recording = logs.read(log)
    configuration = merge(Configuration(), {**load(CONFIG), "clock": "estimated"}, str(CONFIG))
    fleet = Fleet(recording, configuration, folder, rate=rate)
    lives = [replace(life, start=fleet.first + life.start, end=fleet.first + life.end) for life in LIVES]
    _run(fleet, lives)
    said = [_reports(fleet, number, life) for number, life in enumerate(lives)]
    last = {life.robot: number for number, life in enumerate(lives)}
    pickups = []
    for number, life in enumerate(lives):
        if life.start > fleet.first:
            there = [other.robot != life.robot and other.start <= life.start < other.end for other in lives]
            others = [seen for seen, is_there in zip(said, there, strict=True) if is_there]
            theirs = max(_from(life.start, seen, {life.robot}) for seen in others)
            own = _from(life.start, said[number], {other for other in last if other != life.robot})
            pickups.append((f"{life.robot} {life.what}", theirs, own))
    known = {robot: _held(fleet, robot) for robot in last}
    epochs = {robot: len({e for data in known.values() for r, e in data if r == robot}) for robot in last}
    return Story(tuple(pickups), len({ranges(data) for data in known.values()}) == 1, epochs)


def _held(fleet: Fleet, robot: str) -> dict[tuple[str, int], Ranges]:
    """Its newest bundles with measurements: what is older than the history nobody sends any more, and what is told of
    clocks in the end somebody may have left too early to hear."""
    bundles = contents(fleet.journal(robot)).bundles.items()
    return held(name for name, bundle in bundles if bundle.measurements and bundle.cut > fleet.last - NEWEST)


def _run(fleet: Fleet, lives: Sequence[Life]) -> None:
    """Every life's program waits from the beginning until its time has come."""
    prepare(fleet)
    processes = [
        AgentProcess(
            _on_its_clock(fleet, life).command(life.robot), _said(fleet, number, life), fleet.messages(life.robot)
        )
        for number, life in enumerate(lives)
    ]
    due = [(stamp, 1, number, line) for number, life in enumerate(lives) for stamp, line in _lines(fleet, life)]
    due += [(life.start, 0, number, None) for number, life in enumerate(lives)]
    due += [(life.end, 0, number, None) for number, life in enumerate(lives) if life.end < inf]
    due.sort(key=lambda item: item[:2])
    begun: set[int] = set()
    try:
        for process in processes:
            process.ready()
        at = time.monotonic() + LEAD[0] + LEAD[1] * len(processes)
        for stamp, _, number, line in due:
            wait(stamp, fleet, at)
            life, process = lives[number], processes[number]
            if line is not None:
                process.say(line)
            elif number not in begun:
                begun.add(number)
                for file in fleet.folder.glob(f"{life.robot}.journal*") if life.forgets else ():
                    file.unlink()
                process.begin(at)
            elif life.leaves:
                process.leave()
            else:
                process.kill()
        deadline = at + (fleet.last + fleet.quiet - fleet.first) / fleet.rate + PATIENCE
        for number, process in enumerate(processes):
            process.no_more()
            assert lives[number].end < inf or process.leaves(deadline)
    finally:
        for process in processes:
            process.kill()


def _on_its_clock(fleet: Fleet, life: Life) -> Fleet:
    return replace(fleet, offsets={life.robot: life.offset})


def _lines(fleet: Fleet, life: Life) -> list[tuple[float, bytes]]:
    """What the robot measures while it lives."""
    every = in_order(_on_its_clock(fleet, life))
    said = [(stamp, what) for stamp, what in every if not isinstance(what, Event) and life.start <= stamp < life.end]
    return [(stamp, line) for stamp, (robot, line) in said if robot == life.robot]


def _said(fleet: Fleet, number: int, life: Life) -> Path:
    return fleet.folder / f"{number}-{life.robot}.jsonl"


def _reports(fleet: Fleet, number: int, life: Life) -> list[tuple[float, Report]]:
    """Its reports and their time [s of the log]; a line torn by a kill is left out."""
    pace, reports = _on_its_clock(fleet, life).pace(life.robot), []
    for line in _said(fleet, number, life).read_bytes().splitlines():
        with suppress(msgspec.MsgspecError):
            report = read_report(line)
            reports.append((pace.to_recording(report.stamp), report))
    return reports


def _from(start: float, said: list[tuple[float, Report]], peers: set[str]) -> float:
    """How long after ``start`` [s] a robot first locates all these with fresh data [s]."""
    for stamp, report in said:
        seen = [report.peers.get(peer) for peer in peers]
        if stamp >= start and all(p and p.status in LOCATED and p.age is not None and p.age <= FRESH for p in seen):
            return stamp - start
    return inf


def churn(place: Place) -> Iterator[Row]:
    """Late, gone, back with another clock or without a journal."""
    folder = place.folder("churn")
    recording = beginning(folder / "log", place.data / "mrclam6", 260.0)
    story = churned(folder / "fleet", recording, rate=2.0)
    yield Row(
        "join late, leave, come back with a new clock or without a journal: picked up, nobody else restarted",
        story.told(),
        "`python benchmarks/live.py --only churn`",
        story.good,
    )
