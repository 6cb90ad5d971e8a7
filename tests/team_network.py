"""Robots that gossip over a network in memory, in virtual time: bundlers, gossip and faults, without estimates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from random import Random

from dgorl.measurements import Odometry, Rssi
from dgorl.team.bundler import Bundler
from dgorl.team.bundles import Name, Sealed
from dgorl.team.faults import Faults, Faulty
from dgorl.team.gossip import Gossip
from dgorl.team.keys import UNSIGNED, Key, Roster, Signer, generate
from dgorl.team.memory import Air, MemoryTransport
from dgorl.team.transport import Received
from dgorl.team.voice import Outgoing
from dgorl.team.wire import seal

TEAM = "test"
CONFIGURATION = b"8 bytes."
PERIOD = 0.5
STEP = 0.05


@dataclass(frozen=True)
class Disk:
    """What a robot's disk held at one time. made: the first number of its epoch that was not used."""

    epoch: int
    journal: dict[Name, Sealed]
    admitted: list[tuple[str, int]]
    made: int


@dataclass
class Robot:
    """One robot's program without its estimate. ``journal`` is what would be on its disk."""

    name: str
    epoch: int
    gossip: Gossip
    bundler: Bundler
    signer: Signer
    air: MemoryTransport
    network: Faulty
    journal: dict[Name, Sealed] = field(default_factory=dict)
    admitted: list[tuple[str, int]] = field(default_factory=list)
    arrivals: dict[Name, float] = field(default_factory=dict)
    endings: list[str] = field(default_factory=list)
    """why each of its epochs ended of itself"""

    @property
    def made(self) -> int:
        """The first number of its epoch that it has not used."""
        return self.bundler.sequence

    def disk(self) -> Disk:
        """A copy of its disk as it is now."""
        return Disk(self.epoch, dict(self.journal), list(self.admitted), self.made)

    @property
    def known(self) -> set[Name]:
        return set(self.journal)


class Network:
    """Robots r1... on a bad network. ``signed``: with real keys."""

    def __init__(
        self, count: int, faults: Faults | None = None, *, signed: bool = False, seed: int = 0, history: float = 180.0
    ) -> None:
        self.names = tuple(f"r{k + 1}" for k in range(count))
        self.keys: dict[str, Key] = {name: generate() for name in self.names} if signed else {}
        self.roster = Roster(
            TEAM, {n: self.keys[n].public if signed else None for n in self.names}, insecure=not signed
        )
        self.faults = faults or Faults()
        self.air = Air()
        self.random = Random(seed)
        self.history = history
        self.robots: dict[str, Robot] = {}
        self.twins: dict[str, Robot] = {}
        """other machines that run under a robot's name"""
        self.quiet = False
        self.taps: list[Callable[[str, Outgoing], None]] = []
        self._steps = 0

    @property
    def now(self) -> float:
        return self.air.now

    def start(self, *names: str, journal: Robot | Disk | None = None, clock: Callable[[float], float] = float) -> None:
        """Robots begin, with the journal of an earlier life if there is one; it is copied, not changed."""
        for name in names:
            epoch = journal.epoch if journal else self.random.getrandbits(64)
            air = self.air.transport(name, clock)
            faulty = Faulty(air, name, self.faults, lambda: self.air.now)
            disk = (dict(journal.journal), list(journal.admitted)) if journal else ({}, [])
            made = journal.made if journal else 0
            self.robots[name] = self._life(name, epoch, air, faulty, made, *disk)

    def _life(
        self,
        name: str,
        epoch: int,
        air: MemoryTransport,
        faulty: Faulty,
        made: int,
        known: dict[Name, Sealed],
        admitted: list[tuple[str, int]],
        before: Gossip | None = None,
    ) -> Robot:
        """A robot in an epoch, from what its disk holds."""
        signer = self.keys.get(name, UNSIGNED)
        own = [sealed.bundle for one, sealed in known.items() if (one.robot, one.epoch) == (name, epoch)]
        made = max([made, *(bundle.sequence + 1 for bundle in own)])
        born = min((bundle.cut for bundle in own), default=air.local(self.air.now))
        gossip = Gossip(
            name,
            epoch,
            self.roster,
            signer,
            CONFIGURATION,
            history=self.history,
            born=born,
            made=made,
            began=air.local(self.air.now),
            before=before,
        )
        gossip.restore(list(known.values()), admitted, air.local(self.air.now))
        bundler = Bundler(TEAM, name, epoch, sequence=made)
        return Robot(name, epoch, gossip, bundler, signer, air, faulty, known, admitted)

    def stop(self, name: str, *, twin: bool = False) -> Robot:
        """A robot, or its twin, is gone from one moment to the next; what was on its disk."""
        robot = (self.twins if twin else self.robots).pop(name)
        robot.network.close()
        return robot

    def start_twin(self, name: str, journal: Robot | Disk | None = None) -> None:
        """A second machine begins under a robot's name."""
        robot = self.robots.pop(name)
        self.start(name, journal=journal)
        self.twins[name], self.robots[name] = self.robots[name], robot

    def change(self, faults: Faults) -> None:
        """The network is another from now on."""
        self.faults = faults
        for robot in self.robots.values():
            robot.network.faults = faults

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / STEP)):
            self._steps += 1
            self.air.now = self._steps * STEP
            for robot in [*self.robots.values(), *self.twins.values()]:
                self._step(robot)

    def _step(self, robot: Robot) -> None:
        for message in robot.network.poll():
            self.deliver(robot, message)
        now = robot.air.local(self.air.now)
        if self._steps % round(PERIOD / STEP) == 0 and not self.quiet:
            for bundle in self.measured(robot, now):
                sealed = seal(bundle, robot.signer)
                self._take(robot, [sealed])
                self.send(robot, robot.gossip.publish(sealed, now))
        self.send(robot, robot.gossip.tick(now))
        if why := robot.gossip.witness.ended(now):
            epoch = self.random.getrandbits(64)
            disk = robot.journal, robot.admitted
            new = self._life(robot.name, epoch, robot.air, robot.network, 0, *disk, before=robot.gossip)
            new.endings = [*robot.endings, why]
            self._lives(new, robot)

    def _lives(self, robot: Robot, instead: Robot) -> None:
        for where in (self.robots, self.twins):
            if where.get(robot.name) is instead:
                where[robot.name] = robot

    def deliver(self, robot: Robot, message: Received) -> None:
        """A message reaches a robot."""
        reaction = robot.gossip.receive(message.channel, message.sender, message.payload, message.at)
        robot.bundler.heard(reaction.clocks)
        robot.admitted.extend(reaction.admitted)
        self._take(robot, reaction.new)
        self.send(robot, reaction.send)

    def _take(self, robot: Robot, sealed: Iterable[Sealed]) -> None:
        for one in sealed:
            assert robot.journal.get(one.bundle.name, one) == one, "the first contents of a name count"
            robot.journal[one.bundle.name] = one
            robot.arrivals[one.bundle.name] = self.air.now

    def measured(self, robot: Robot, now: float) -> Sequence:
        """A tick's measurements: a twist every 0.1 s, one RSSI of each robot it hears."""
        for k in range(5):
            start = now - PERIOD + 0.1 * k
            v, omega = self.random.random(), self.random.random()
            robot.bundler.add(Odometry(robot.name, start, min(start + 0.1, now), v, omega))
        for other in self.robots:
            if other != robot.name and self.faults.connected(other, robot.name, self.air.now):
                robot.bundler.add(Rssi(other, robot.name, now, -40.0 - 40.0 * self.random.random()))
        return robot.bundler.cut(now)

    def send(self, robot: Robot, messages: Iterable[Outgoing]) -> None:
        for message in messages:
            for tap in self.taps:
                tap(robot.name, message)
            robot.network.send(message.channel, message.payload)

    def equal(self) -> bool:
        """Whether all robots hold the same bundles."""
        known = [robot.known for robot in self.robots.values()]
        return all(k == known[0] for k in known)

    def missing(self) -> dict[str, int]:
        """How many bundles each robot lacks of what any holds."""
        every = set().union(*(robot.known for robot in self.robots.values()))
        return {name: len(every - robot.known) for name, robot in self.robots.items()}

    def until_equal(self, limit: float) -> float:
        """Let time pass until all hold the same, while nothing new is measured; how long it took [s]."""
        self.quiet, began = True, self.now
        while not self.equal() and self.now - began < limit:
            self.run(STEP)
        self.quiet = False
        return self.now - began


def lossy(**changes: object) -> Faults:
    """The bad network of the tests: half of the messages lost, late, twice, overtaken."""
    return replace(Faults(loss=0.5, delay=(0.0, 0.5), duplicate=0.1, reorder=0.1), **changes)
