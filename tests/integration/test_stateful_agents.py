"""Whatever agents live through, none dies nor needs its last wall, and when all is quiet they know and say the same."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from dataclasses import replace
from functools import cache
from math import inf
from pathlib import Path

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from dgorl.logs.log import Log
from dgorl.replay import start_priors
from dgorl.team.faults import Faults, Partition
from dgorl.team.intake import Moved
from dgorl.team.journal_data import parse, recompute
from dgorl.team.report import peers_of

from .teams import settings as configured
from .teams import simulated
from .test_agent import SETTLE, STEP, Lab

WHICH = st.integers(0, 2)
BACK = 30.0
"""After this [s] on a good network everybody knows everybody again, however often they began anew."""


@cache
def sensed(seed: int) -> Log:
    return simulated(steps=400, sensors=("range",), seed=seed)


class AgentsMachine(RuleBasedStateMachine):
    """Agents with journals on a network in memory, in virtual time."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="dgorl-agents-"))
        self.saved: dict[str, list[Path]] = {}
        self.copied = False

    @initialize(seed=st.integers(0, 2), known=st.booleans())
    def begin(self, seed, known) -> None:
        log = sensed(seed)
        self.lab = Lab(log, self.folder, configuration=configured(log, window=10.0, candidates=2))
        if not known:
            self.lab.team = replace(self.lab.team, starts={})
        for robot in log.robots:
            self.lab.start(robot)
        self.run_for(1.0)

    @rule(seconds=st.sampled_from([0.5, 1.0, 2.3, 4.0, 7.0]))
    def run_for(self, seconds) -> None:
        self.lab.run(self.lab.air.now + seconds)
        for robot, agent in self.lab.agents.items():
            assert not agent.failures, (robot, agent.failures[0].error)

    @rule(which=WHICH, how=st.sampled_from(["journal", "journal", "new", "older", "first"]))
    def restart(self, which, how) -> None:
        """At once, or, if it is down, whenever that is."""
        robot = self.name(which)
        if robot in self.lab.agents:
            self.stop(robot)
        journal = self.folder / f"{robot}.journal"
        if how != "journal":
            for path in self.folder.glob(f"{robot}.journal*"):
                path.unlink()
        if how in ("older", "first"):
            self.copied, copies = True, self.saved[robot]
            copy = copies[0] if how == "first" else copies[max(len(copies) - 2, 0)]
            for path in copy.iterdir():
                shutil.copy(path, journal.with_name(path.name))
        self.lab.start(robot)

    @rule(which=WHICH)
    def shut_down(self, which) -> None:
        if self.name(which) in self.lab.agents:
            self.stop(self.name(which))

    @rule(which=WHICH)
    def part(self, which) -> None:
        robots = frozenset(self.lab.log.robots)
        alone = frozenset({self.name(which)})
        self.change(Faults(partitions=(Partition((alone, robots - alone), -inf, inf),)))

    @rule(loss=st.sampled_from([0.3, 0.6]), delay=st.sampled_from([0.1, 0.5]), seed=st.integers(0, 9))
    def lose(self, loss, delay, seed) -> None:
        self.change(Faults(seed=seed, loss=loss, delay=(0.0, delay), duplicate=0.1, reorder=0.1))

    @rule()
    def mend(self) -> None:
        self.change(Faults())

    @rule(which=WHICH)
    def carry(self, which) -> None:
        agent = self.lab.agents.get(self.name(which))
        if agent is not None:
            agent.take(Moved(self.lab.air.now))

    @rule(which=WHICH)
    def busy(self, which) -> None:
        """An agent is not scheduled for a while: ticks are missed."""
        robot = self.name(which)
        agent = self.lab.agents.pop(robot, None)
        self.run_for(2.3)
        if agent is not None:
            self.lab.agents[robot] = agent

    def teardown(self) -> None:
        try:
            if hasattr(self, "lab"):
                self.mend()
                for robot in self.lab.log.robots:
                    if robot not in self.lab.agents:
                        self.lab.start(robot)
                self.run_for(BACK)
                self.quiet()
        finally:
            for agent in list(self.lab.agents.values()) if hasattr(self, "lab") else ():
                with suppress(Exception):
                    agent.close()
            shutil.rmtree(self.folder)

    def quiet(self) -> None:
        """Nothing is measured any more, and all that is known reaches all."""
        lab = self.lab
        now = round(lab.air.now)
        for k in range(1, round(SETTLE / STEP)):
            lab.air.now = now + k * STEP
            for agent in lab.agents.values():
                agent.hear(lab.air.now)
        said = {robot: agent.estimate(now, final=True) for robot, agent in lab.agents.items()}
        epochs = {robot: agent.journal.epoch for robot, agent in lab.agents.items()}
        held = {robot: parse(report.data) for robot, report in said.items()}
        for robot, data in held.items():
            for peer, epoch in epochs.items():
                assert list(data.get((peer, epoch), ())) == list(held[peer].get((peer, epoch), ())), (robot, peer)
        for agent in lab.agents.values():
            assert not agent.failures, agent.failures[0].error
            agent.journal.flush()
        assert self.copied or len({report.data for report in said.values()}) == 1
        journals = {robot: lab.folder / f"{robot}.journal" for robot in lab.agents}
        for robot, report in said.items():
            # A robot that lived on an older copy has signed two contents under one name: then each holds its own.
            told = [journals[robot]] if self.copied else list(journals.values())
            again = recompute(told, report.data, now, robot, lab.configuration, start_priors(lab.team.starts))
            assert peers_of(again) == report.peers, robot

    def stop(self, robot: str) -> None:
        """Leave, and keep a copy of what is on the disk."""
        self.lab.stop(robot)
        copy = self.folder / f"copy-{robot}-{len(self.saved.setdefault(robot, []))}"
        copy.mkdir()
        for path in self.folder.glob(f"{robot}.journal*"):
            shutil.copy(path, copy)
        self.saved[robot].append(copy)

    def change(self, faults: Faults) -> None:
        self.lab.faults = faults
        for agent in self.lab.agents.values():
            agent.transport.faults = faults

    def name(self, which: int) -> str:
        return self.lab.log.robots[which]


def test_what_agents_can_live_through() -> None:
    run_state_machine_as_test(
        AgentsMachine,
        settings=settings(
            max_examples=6,
            stateful_step_count=12,
            deadline=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        ),
    )
