"""Agents and robots that only tell, on a network in memory, in virtual time. For the benchmarks of the live team."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

from dgorl.configuration import Configuration, as_dict
from dgorl.logs.log import Log
from dgorl.measurements import Measurement, known_at, robots_of
from dgorl.replay import start_priors
from dgorl.team.agent import Agent
from dgorl.team.bundler import Bundler
from dgorl.team.faults import Faults, Faulty
from dgorl.team.gossip import Gossip
from dgorl.team.journal import LIMIT, Journal
from dgorl.team.keys import Key, generate
from dgorl.team.memory import Air
from dgorl.team.report import Report
from dgorl.team.team_file import TeamFile
from dgorl.team.voice import Outgoing
from dgorl.team.wire import seal

STEP = 0.1
"""Robots look at the network this often [s]."""


@dataclass
class Teller:
    """A robot that tells what it measures and relays what it hears, without an estimate or a journal."""

    bundler: Bundler
    gossip: Gossip
    signer: Key
    network: Faulty
    period: float
    tick: int = 0

    def take(self, measured: Measurement) -> None:
        self.bundler.add(measured)

    def step(self, now: float) -> None:
        """Hear the network and answer it; at a tick publish what was measured."""
        for message in self.network.poll():
            reaction = self.gossip.receive(message.channel, message.sender, message.payload, message.at)
            self.bundler.heard(reaction.clocks)
            self._send(reaction.send)
        self._send(self.gossip.tick(now))
        if int(now / self.period + 1e-9) > self.tick:
            self.tick = int(now / self.period + 1e-9)
            for bundle in self.bundler.cut(now):
                self._send(self.gossip.publish(seal(bundle, self.signer), now))

    def _send(self, messages: Iterable[Outgoing]) -> None:
        for message in messages:
            self.network.send(message.channel, message.payload)


class VirtualTeam:
    """The robots of a log in virtual time: ``agents`` of them estimate, the others tell.

    limit: of a journal's size [bytes]. Close it to let go of the journals.
    """

    def __init__(
        self,
        log: Log,
        configuration: Configuration,
        folder: Path,
        faults: Faults,
        agents: Iterable[str],
        limit: int = LIMIT,
    ) -> None:
        self.log, self.air, self._faults = log, Air(), faults
        self._keys = {robot: generate() for robot in log.robots}
        self._team = TeamFile(
            "virtual",
            {robot: key.public for robot, key in self._keys.items()},
            configuration=configuration,
            starts=log.starts,
        )
        self.agents = {robot: self._agent(robot, folder, limit) for robot in agents}
        self.tellers = {robot: self._teller(robot) for robot in log.robots if robot not in self.agents}
        self._ready = sorted(log.measurements, key=known_at)
        self._taken = self._steps = 0

    def run(self, until: float) -> Iterator[Report]:
        """Let time pass to ``until`` [s]; every agent's estimates as they are made."""
        while self._steps < round(until / STEP):
            self._steps += 1
            self.air.now = now = self._steps * STEP
            while self._taken < len(self._ready) and known_at(self._ready[self._taken]) <= now + 1e-9:
                measured = self._ready[self._taken]
                robot = robots_of(measured)[0]
                (self.agents.get(robot) or self.tellers[robot]).take(measured)
                self._taken += 1
            for teller in self.tellers.values():
                teller.step(now)
            for agent in self.agents.values():
                report = agent.step(now)
                if report is not None:
                    yield report

    def close(self) -> None:
        for agent in self.agents.values():
            agent.close()

    def _network(self, robot: str) -> Faulty:
        return Faulty(self.air.transport(robot), robot, self._faults, lambda: self.air.now)

    def _agent(self, robot: str, folder: Path, limit: int) -> Agent:
        settings = self._team.configuration
        window = 0.0 if settings.window == "all" else float(settings.window)
        journal = Journal.open(
            folder / f"{robot}.journal",
            robot,
            self._team.roster,
            settings=as_dict(settings),
            keep=settings.history + window + 10.0,
            starts=start_priors(self.log.starts),
            limit=limit,
            synchronous="normal",
        )
        return Agent(robot, self._team, self._keys[robot], self._network(robot), journal, self.air.now)

    def _teller(self, robot: str) -> Teller:
        team, key = self._team, self._keys[robot]
        epoch = Random(robot).getrandbits(64)
        gossip = Gossip(
            robot, epoch, team.roster, key, team.configuration_hash, history=team.configuration.history
        )  # fmt: skip
        bundler = Bundler(team.team, robot, epoch, substep=team.substep)
        return Teller(bundler, gossip, key, self._network(robot), team.configuration.period)
