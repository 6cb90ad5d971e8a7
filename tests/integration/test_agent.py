"""Agents on a network in memory, in virtual time: whatever the network does, they end up knowing the same."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from dgorl import Localizer, Team, logs
from dgorl.configuration import Configuration, as_dict
from dgorl.estimate import Estimate
from dgorl.evaluation.records import LOCATED
from dgorl.logs.log import Log
from dgorl.measurements import Displacement, Measurement, known_at, robots_of
from dgorl.replay import replay, start_priors
from dgorl.team.agent import BAD_LINE, Agent
from dgorl.team.faults import Faults, Faulty, Partition, topology
from dgorl.team.intake import Moved, line_of
from dgorl.team.journal import Journal
from dgorl.team.journal_data import parse, recompute
from dgorl.team.journal_schema import JournalError
from dgorl.team.keys import Key, generate
from dgorl.team.memory import Air
from dgorl.team.report import Peer, Report, estimates_of, peers_of, read_report
from dgorl.team.team_file import TeamFile

from .teams import settings, simulated

STEP = 0.05
"""Agents look at the network this often [s]."""
SETTLE = 8.0
"""Time for all to learn what all know, whatever gets lost [s]."""


@dataclass
class Lab:
    """A team of agents, the log they sense, and the air between them."""

    log: Log
    folder: Path
    faults: Faults = field(default_factory=Faults)
    configuration: Configuration | None = None
    air: Air = field(default_factory=Air)
    agents: dict[str, Agent] = field(default_factory=dict)
    reports: dict[str, list[Report]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.keys: Mapping[str, Key] = {robot: generate() for robot in self.log.robots}
        self.configuration = self.configuration or settings(self.log)
        self.team = TeamFile(
            "lab",
            {robot: key.public for robot, key in self.keys.items()},
            configuration=self.configuration,
            starts=self.log.starts,
        )
        self.told = dict.fromkeys(self.log.robots, 0)
        self.lines = {r: [m for m in self.log.measurements if robots_of(m)[0] == r] for r in self.log.robots}

    def start(self, robot: str) -> Agent:
        journal = Journal.open(
            self.folder / f"{robot}.journal",
            robot,
            self.team.roster,
            settings=as_dict(self.configuration),
            keep=400.0,
            starts=start_priors(self.team.starts),
            synchronous="normal",
        )
        transport = Faulty(self.air.transport(robot), robot, self.faults, lambda: self.air.now)
        agent = Agent(robot, self.team, self.keys[robot], transport, journal, self.air.now)
        self.agents[robot] = agent
        self.reports.setdefault(robot, [])
        return agent

    def stop(self, robot: str) -> None:
        self.agents.pop(robot).close()

    def run(self, until: float) -> None:
        """Let time pass; robots sense, as JSON lines, while their agents are there."""
        for k in range(round(self.air.now / STEP) + 1, round(until / STEP) + 1):
            self.air.now = k * STEP
            for robot in self.log.robots:
                for measurement in self.sensed(robot):
                    if robot in self.agents:
                        assert self.agents[robot].take_line(line_of(measurement), self.air.now) is None
            for robot, agent in self.agents.items():
                report = agent.step(self.air.now)
                if report is not None:
                    self.reports[robot].append(read_report(report.line()))

    def sensed(self, robot: str) -> Iterator[Measurement]:
        lines = self.lines[robot]
        while self.told[robot] < len(lines) and known_at(lines[self.told[robot]]) <= self.air.now:
            yield lines[self.told[robot]]
            self.told[robot] += 1

    def end(self, now: float) -> None:
        """Go on to ``now`` [s], let what was told until then arrive, and estimate at ``now`` once more."""
        self.run(now)
        for k in range(1, round(SETTLE / STEP)):
            self.air.now = now + k * STEP
            for agent in self.agents.values():
                agent.hear(self.air.now)
        for robot, agent in self.agents.items():
            self.reports[robot].append(agent.estimate(now, final=True))

    @property
    def data(self) -> set[str]:
        """What the agents' last reports were made of: one if all know the same."""
        return {said[-1].data for robot, said in self.reports.items() if robot in self.agents}

    def last(self) -> dict[str, dict[str, Peer]]:
        return {robot: self.reports[robot][-1].peers for robot in self.agents}


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[type]:
    """Makes labs whose agents are closed at the end."""
    with ExitStack() as stack:

        def make(log: Log, faults: Faults | None = None, **changes: object) -> Lab:
            made = Lab(log, tmp_path, faults or Faults(), settings(log, **changes))
            stack.callback(lambda: [made.stop(robot) for robot in list(made.agents)])
            return made

        yield make


def in_one_place(lab: Lab, now: float) -> dict[str, dict[str, Peer]]:
    """The same estimates by one Team that is given the log, as `dgorl run` does."""
    team = Team(lab.configuration)
    for measurement in (*start_priors(lab.log.starts), *lab.log.measurements):
        team.add(measurement)
    return {robot: peers_of(Localizer(robot, team=team).update(now)) for robot in lab.log.robots}


@pytest.fixture(scope="module")
def log() -> Log:
    return simulated(steps=40, sensors=("rssi", "range"), seed=3)  # 20 s


def assert_alike(lab: Lab, now: float) -> None:
    assert len(lab.data) == 1
    assert {said[-1].stamp for said in lab.reports.values()} == {now}
    assert lab.last() == in_one_place(lab, now)


def test_on_a_good_network_all_estimate_as_a_replay_does(lab: type, log: Log) -> None:
    team = lab(log)
    for robot in log.robots:
        team.start(robot)
    team.end(20.0)
    assert_alike(team, 20.0)
    report = team.reports["r1"][-1]
    assert report.present == ("r2", "r3")
    assert report.rejected == {}
    assert report.traffic.bundles > 0
    assert set(report.peers) == {"r2", "r3", "world"}
    assert report.peers["r2"].status == "tracked"
    # One report a tick, from the first on.
    assert [r.stamp for r in team.reports["r1"] if not r.final] == [0.5 * k for k in range(1, 41)]


@pytest.mark.parametrize(
    "faults",
    [
        Faults(seed=1, loss=0.3, delay=(0.0, 0.4), duplicate=0.2, reorder=0.2),
        Faults(reaches=topology("line", ("r1", "r2", "r3"))),
        Faults(partitions=(Partition((frozenset({"r1", "r2"}), frozenset({"r3"})), 3.0, 17.0),)),
    ],
    ids=["lossy", "line", "parted"],
)
def test_on_a_bad_network_they_end_up_alike(lab: type, log: Log, faults: Faults) -> None:
    team = lab(log, faults)
    for robot in log.robots:
        team.start(robot)
    team.end(25.0)
    assert_alike(team, 25.0)


def test_a_partition_costs_what_lies_beyond_it_alone(lab: type, log: Log) -> None:
    parted = Partition((frozenset({"r1", "r2"}), frozenset({"r3"})), 2.0, 100.0)
    team = lab(log, Faults(partitions=(parted,)))
    for robot in log.robots:
        team.start(robot)
    team.run(20.0)
    last = team.last()
    assert last["r1"]["r2"].status in LOCATED  # of its heading a tick's turn is unknown
    assert last["r1"]["r3"].status == "isolated"
    assert parse(team.reports["r1"][-1].data).keys() == parse(team.reports["r2"][-1].data).keys()
    assert team.reports["r1"][-1].present == ("r2",)


def test_any_estimate_can_be_made_again_from_journals(lab: type, log: Log) -> None:
    team = lab(log, Faults(seed=2, loss=0.4))
    for robot in log.robots:
        team.start(robot)
    team.run(20.0)
    for robot in log.robots:
        team.stop(robot)
    journals = [team.folder / f"{robot}.journal" for robot in log.robots]
    for report in team.reports["r2"][5::11]:
        again = recompute(journals, report.data, report.stamp, "r2", team.configuration, start_priors(log.starts))
        assert peers_of(again) == report.peers


def test_a_journal_replays_as_the_robot_saw_it(lab: type, log: Log) -> None:
    team = lab(log, Faults(seed=2, loss=0.4))
    for robot in log.robots:
        team.start(robot)
    team.run(20.0)
    for robot in log.robots:
        team.stop(robot)
    recorded = logs.read(team.folder / "r3.journal")
    again = list(replay(recorded, team.configuration, initial="known"))
    assert [tick.stamp for tick in again] == [report.stamp for report in team.reports["r3"]]
    for tick, report in zip(again, team.reports["r3"], strict=True):
        assert peers_of(tick.estimates["r3"]) == report.peers


def test_a_restart_loses_only_what_was_not_sensed(lab: type, log: Log) -> None:
    team = lab(log)
    for robot in log.robots:
        team.start(robot)
    team.run(8.0)
    epoch, following = team.agents["r2"].journal.epoch, team.agents["r2"].journal.next_sequence
    team.stop("r2")
    team.run(11.0)
    team.start("r2")
    team.end(30.0)
    journal = team.agents["r2"].journal
    assert (journal.epoch, journal.next_sequence > following) == (epoch, True)
    assert len(team.data) == 1
    assert [len(ranges) for ranges in parse(team.data.pop()).values()] == [1, 1, 1]  # one epoch each, no number missing
    # What r2 says of others is what others' journals say it must.
    again = recompute(
        [team.folder / "r1.journal"],
        team.reports["r2"][-1].data,
        30.0,
        "r2",
        team.configuration,
        start_priors(log.starts),
    )
    assert peers_of(again) == team.last()["r2"]


def test_own_bundles_a_journal_lost_come_back(lab: type, log: Log) -> None:
    team = lab(log)
    for robot in log.robots:
        team.start(robot)
    team.run(8.0)
    epoch = team.agents["r2"].journal.epoch
    team.stop("r2")
    with closing(sqlite3.connect(team.folder / "r2.journal")) as database, database:
        ends = "SELECT number FROM entries WHERE robot = 'r2' ORDER BY number DESC LIMIT 1 OFFSET 5"
        lost = database.execute(f"DELETE FROM entries WHERE number > ({ends})").rowcount
    assert lost >= 5
    team.start("r2")
    team.end(25.0)
    assert team.agents["r2"].journal.epoch == epoch
    assert_alike(team, 25.0)


def test_a_late_robot_catches_up(lab: type, log: Log) -> None:
    team = lab(log)
    for robot in ("r1", "r2"):
        team.start(robot)
    team.run(15.0)
    team.start("r3")
    team.end(30.0)
    assert len(team.data) == 1
    assert parse(team.data.pop()).keys() >= {("r1", team.agents["r1"].journal.epoch)}


def test_a_carried_robot_begins_a_new_track(lab: type) -> None:
    log = simulated(steps=40, seed=4, teleport="r2@10:5")
    team = lab(log)
    for robot in log.robots:
        team.start(robot)
    team.run(10.0)
    team.agents["r2"].take(Moved(10.0))
    team.end(21.0)
    assert len(team.data) == 1
    track = team.agents["r1"]._estimator._localizer.team.history.trails["r2"].tracks
    assert len({t.key.epoch for t in track}) == 2


def test_missed_ticks_are_skipped_and_nothing_is_lost(lab: type, log: Log) -> None:
    team = lab(log)
    for robot in log.robots:
        team.start(robot)
    team.run(5.0)
    busy = team.agents.pop("r1")
    team.run(9.0)
    for measurement in log.measurements:
        if robots_of(measurement)[0] == "r1" and 5.0 < known_at(measurement) <= 9.0:
            busy.take_line(line_of(measurement), 9.0)
    team.agents["r1"] = busy
    assert busy.step(9.2).stamp == 9.0
    assert busy.step(9.3) is None
    team.end(25.0)
    assert_alike(team, 25.0)


def test_the_network_is_heard_while_a_long_past_is_computed(lab: type, log: Log) -> None:
    team = lab(log)
    for robot in log.robots:
        team.start(robot)
    team.run(18.0)
    team.stop("r2")
    agent = team.start("r2")
    now, parts = 18.5, 0
    while (report := agent.step(now, parts=True)) is None:
        assert agent.due < now
        for other in ("r1", "r3"):
            team.agents[other].step(now)
        now += 0.1
        team.air.now, parts = now, parts + 1
    assert parts >= 3  # nodes
    assert (report.stamp, agent.due) == (18.5, 19.0)
    assert report.traffic.received_messages > 0
    journals = [team.folder / f"{robot}.journal" for robot in log.robots]
    again = recompute(journals, report.data, 18.5, "r2", team.configuration, start_priors(log.starts))
    assert peers_of(again) == report.peers
    assert agent.step(19.0, parts=True).stamp == 19.0


def test_bad_lines_are_answered_and_counted(lab: type, log: Log) -> None:
    team = lab(log)
    agent = team.start("r1")
    complaint = agent.take_line(b'{"type": "rssi", "stamp": 0.1, "transmitter": "r1", "dbm": -60}', 0.2)
    assert complaint is not None
    answer = json.loads(complaint.text())
    assert answer["type"] == "error"
    assert "itself" in answer["what"]
    assert answer["line"].startswith('{"type": "rssi"')
    assert agent.take_line(b"\xff" * 1000, 0.2) is not None
    report = agent.step(0.5)
    assert report.rejected == {BAD_LINE: 2}


def test_what_the_disk_refuses_is_not_sent_yet(lab: type, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    team = lab(log)
    for robot in log.robots:
        team.start(robot)
    team.run(5.0)
    known = {robot: parse(said[-1].data) for robot, said in team.reports.items()}

    def full(*_: object) -> None:
        raise JournalError("r1.journal: cannot be written: disk full")

    agent = team.agents["r1"]
    key = "r1", agent.journal.epoch
    with monkeypatch.context() as patch:
        patch.setattr(agent.journal, "commit_own", full)
        team.run(8.0)
        assert agent.troubles[-1] == "r1.journal: cannot be written: disk full"
        assert team.reports["r1"][-1].rejected == {"journal": 6}
        for said in team.reports.values():
            assert parse(said[-1].data)[key] == known["r2"][key]
    team.end(25.0)
    assert_alike(team, 25.0)


def test_what_the_disk_refuses_for_longer_than_the_history_is_let_go(
    lab: type, log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    team = lab(log, history=10.0)
    for robot in log.robots:
        team.start(robot)
    team.run(2.0)

    def full(*_: object) -> None:
        raise JournalError("r1.journal: cannot be written: disk full")

    agent = team.agents["r1"]
    with monkeypatch.context() as patch:
        patch.setattr(agent.journal, "commit_own", full)
        team.run(18.0)
        assert len(agent._unsent) <= 21
        assert team.reports["r1"][-1].rejected["not committed in time"] >= 10
    before = agent.transport.traffic.sent_messages
    team.run(18.6)
    assert agent.transport.traffic.sent_messages - before < 20, "no burst that others reject"
    team.end(20.0)
    assert len(team.data) == 1


def test_clocks_that_differ(lab: type, log: Log) -> None:
    """With `clock: estimated` agents whose clocks are seconds apart place one another."""
    team = lab(log, clock="estimated")
    offsets = {"r1": 0.0, "r2": 3.0, "r3": -2.0}
    for robot in log.robots:
        journal = Journal.open(
            team.folder / f"{robot}.journal", robot, team.team.roster, settings={}, keep=400.0, synchronous="normal"
        )
        transport = team.air.transport(robot, lambda now, robot=robot: now + offsets[robot])
        team.agents[robot] = Agent(robot, team.team, team.keys[robot], transport, journal, offsets[robot])
    reports: dict[str, Report] = {}
    for k in range(1, 400):
        team.air.now = k * STEP
        for robot, agent in team.agents.items():
            for m in team.sensed(robot):
                shift = offsets[robot]
                if isinstance(m, Displacement):
                    agent.take(Displacement(robot, m.start + shift, m.end + shift, m.dx, m.dy, m.dtheta, m.covariance))
                else:
                    agent.take(type(m)(**{**as_dict(m), "stamp": m.stamp + shift}))
            reports[robot] = agent.step(team.air.now + offsets[robot]) or reports.get(robot)
    clocks = reports["r1"].clocks
    assert set(clocks) == {"r1", "r2", "r3"}
    for robot, offset in offsets.items():
        between = clocks[robot].offset - clocks["r1"].offset
        assert between == pytest.approx(-offset, abs=0.1)
    assert reports["r1"].peers["r2"].pose is not None


def test_reports_come_back_bit_for_bit() -> None:
    log = simulated(steps=40, sensors=("range",), seed=1)
    team = Team(settings(log))
    for measurement in log.measurements:
        team.add(measurement)
    estimate: Estimate = Localizer("r1", team=team).update(20.0)
    assert any(peer.hypotheses for peer in estimate.values())
    there = peers_of(estimate)
    assert peers_of(Estimate("r1", 20.0, estimates_of(there), {}, lambda: estimate.graph)) == there
