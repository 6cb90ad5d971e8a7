"""An estimator that raises costs an agent its estimate for some seconds: not its life, nor the others a bundle."""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest

from dgorl import Team, logs, se2
from dgorl.evaluation.records import LOCATED
from dgorl.nodes import Memo, Node
from dgorl.replay import replay
from dgorl.team import teller
from dgorl.team.agent import Agent
from dgorl.team.journal_data import parse
from dgorl.team.journal_schema import Kind
from dgorl.team.json_logs import JsonLines
from dgorl.team.report import Peer, peers_of
from dgorl.team.wall import REASON, SELDOM, Wall

from .teams import settings, simulated
from .test_agent import Lab, assert_alike

SECONDS = 40.0


@pytest.fixture(scope="module")
def log() -> logs.log.Log:
    return simulated(steps=80, sensors=("rssi", "range"), seed=5)


@pytest.fixture
def team(log: logs.log.Log, tmp_path: Path) -> Iterator[Lab]:
    with ExitStack() as stack:
        made = Lab(log, tmp_path, configuration=settings(log))
        for robot in log.robots:
            made.start(robot)
        stack.callback(lambda: [made.stop(robot) for robot in list(made.agents)])
        yield made


def localizer(agent: Agent) -> Team:
    """The team of the agent's own estimator."""
    return agent._estimator._localizer.team


def raising(agent: Agent, method: str, fails: Callable[[float], bool]) -> list[float]:
    """Let a method of the agent's Team raise at the times it is asked for; when it did."""
    team, raised = localizer(agent), []
    whole = getattr(team, method)

    def broken(now: float) -> object:
        if fails(now):
            raised.append(now)
            raise KeyError(f"{method} at {now}")
        return whole(now)

    setattr(team, method, broken)
    return raised


@pytest.mark.parametrize("method", ["update", "prepare", "takes_late"])
def test_the_estimate_is_missing_until_the_next_node_and_then_as_if_nothing_had_been(team: Lab, method: str) -> None:
    team.run(12.0)
    raised = raising(team.agents["r1"], method, lambda now: 17.0 <= now < 18.0)
    for k in range(round((SECONDS - 12.0) / 0.05)):
        now = 12.0 + 0.05 * (k + 1)
        team.air.now = now
        for robot, agent in team.agents.items():
            for measurement in team.sensed(robot):
                agent.take(measurement)
            report = agent.step(now, parts=True)
            if report is not None:
                team.reports[robot].append(report)
    team.end(SECONDS + 1.0)
    assert raised == [17.0]  # once: it is left alone until a node is due
    said = {report.stamp: report for report in team.reports["r1"]}
    down = [stamp for stamp, report in said.items() if {p.reason for p in report.peers.values()} == {REASON}]
    assert down == [17.0 + 0.5 * k for k in range(8)]
    for stamp in down:
        assert {(p.status, p.pose) for p in said[stamp].peers.values()} == {("isolated", None)}
        assert set(said[stamp].peers) == {"r2", "r3"}
    assert said[21.0].peers["r2"].status in LOCATED
    assert_alike(team, SECONDS + 1.0)
    (failure,) = team.agents["r1"].failures
    assert (failure.tick, failure.repeated) == (17.0, 0)


def test_its_bundles_still_reach_the_others(team: Lab) -> None:
    team.run(6.0)
    raising(team.agents["r2"], "update", lambda now: True)
    team.run(10.5)
    assert {p.reason for p in team.reports["r2"][-1].peers.values()} == {REASON}
    assert team.reports["r1"][-1].peers["r2"].status in LOCATED
    held = parse(team.reports["r1"][-1].data)["r2", team.agents["r2"].journal.epoch]
    assert held.high >= 19


def test_working_ahead_may_fail_too(team: Lab) -> None:
    team.run(6.0)
    agent = team.agents["r1"]
    raising(agent, "anticipate", lambda now: True)
    agent.rest()
    team.run(12.0)
    said = {report.stamp: {p.reason for p in report.peers.values()} for report in team.reports["r1"]}
    assert said[6.5] == said[10.5] == {REASON}
    assert REASON not in said[11.0]


def poisoned(monkeypatch: pytest.MonkeyPatch, since: float, until: float) -> None:
    """No node after ``until`` [s] can be made where odometry of these seconds is known."""
    advance = Memo._advance

    def broken(self: Memo, node: Node) -> Node:
        tracks = [track.core for trail in self._history.trails.values() for track in trail.tracks]
        if node.stamp >= until and any(t.begin < until and t.end > since for t in tracks):
            raise KeyError("a keyframe of a track that has ended")
        return advance(self, node)

    monkeypatch.setattr(Memo, "_advance", broken)


def failing(team: Lab, robot: str) -> list[float]:
    return [r.stamp for r in team.reports[robot] if {p.reason for p in r.peers.values()} == {REASON}]


def test_what_fails_whenever_it_is_asked_is_given_ever_less_of_the_past(
    team: Lab, log: logs.log.Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    poisoned(monkeypatch, 4.0, 5.0)
    team.run(SECONDS)
    down = failing(team, "r1")
    # It fails at 11, 16, 21 and 26 s; then it is given what came in the last 11 s.
    assert down == [11.0 + 0.5 * k for k in range(40)]
    last = team.reports["r1"][-1].peers["r2"]
    assert last.pose is not None
    assert last.status not in LOCATED or near(log, last)
    assert [failure.tick for failure in team.agents["r1"].failures] == [11.0]


def near(log: logs.log.Log, found: Peer) -> bool:
    """Whether r1 sees r2 where it is at the end."""
    true = se2.between(*(log.truth[robot][-1, 1:] for robot in ("r1", "r2")))
    return bool(np.hypot(*(true[:2] - found.pose[:2])) < 5.0)


def test_a_journal_leads_to_the_error_and_beyond_it(team: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        poisoned(patch, 4.0, 5.0)
        team.run(SECONDS)
        for robot in list(team.agents):
            team.stop(robot)
        recorded = logs.read(team.folder / "r1.journal")
        ticks = iter(replay(recorded, team.configuration))
        with pytest.raises(KeyError, match="a track that has ended"):
            list(ticks)
    # Mended, the journal tells all that the robot said where it said anything.
    told = {r.stamp: r.peers for r in team.reports["r1"] if r.stamp not in failing(team, "r1")}
    again = {t.stamp: peers_of(t.estimates["r1"]) for t in replay(recorded, team.configuration)}
    assert told.items() <= again.items()
    assert len(told) >= 38


def test_who_restarts_on_such_a_journal_fails_and_finds_its_way_out(team: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    team.run(9.0)
    poisoned(monkeypatch, 4.0, 5.0)
    team.stop("r1")
    team.start("r1")
    team.run(SECONDS)
    down = failing(team, "r1")
    assert down
    assert down[-1] < 35.0
    assert team.reports["r1"][-1].peers["r2"].pose is not None


def test_errors_are_logged_with_their_place_and_not_over_and_over() -> None:
    wall = Wall(history=180.0)

    def fail(now: float, error: Exception) -> None:
        try:
            raise error
        except Exception as caught:
            wall.failed(caught, now, 7)

    assert not wall.shut(3.0)
    for k in range(20):
        fail(3.0 + 5.0 * k, KeyError("one"))
    fail(100.0, ValueError("another"))
    assert wall.shut(100.5)
    told = [(failure.tick, str(failure.error), failure.repeated) for failure in wall.failures]
    assert told == [(3.0, "'one'", 0), (63.0, "'one'", 11), (100.0, "another", 0)]
    assert wall.failures[1].tick - wall.failures[0].tick >= SELDOM


def test_the_process_logs_traceback_and_entry_of_the_journal(team: Lab, caplog: pytest.LogCaptureFixture) -> None:
    team.run(12.0)
    agent = team.agents["r1"]
    raising(agent, "update", lambda now: True)
    team.run(13.0)
    newest = agent.journal.newest
    with caplog.at_level(logging.ERROR, logger="dgorl.agent"):
        teller.tell_troubles(agent)
    (record,) = caplog.records
    line = json.loads(JsonLines("r1").format(record))
    assert line["level"] == "error"
    assert (line["tick"], line["journal"]) == (12.5, str(team.folder / "r1.journal"))
    assert "KeyError: 'update at 12.5'" in line["exception"]
    assert "estimator.py" in line["exception"]
    assert 0 < line["entry"] < newest
    with closing(sqlite3.connect(agent.journal.path)) as database:
        kind, now = database.execute("SELECT kind, now FROM entries WHERE number = ?", (line["entry"],)).fetchone()
    assert (kind, now) == (Kind.TICK, 12.5)
    teller.tell_troubles(agent)
    assert len(caplog.records) == 1
