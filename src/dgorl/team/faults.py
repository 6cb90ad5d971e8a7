"""Bad networks: loss, delay, duplicates, reordering, partitions and limited reach round any transport, by seed.

Links are cut where they are heard: on a network that carries everything to all, each receiver decides for each sender.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from random import Random
from typing import Literal

from dgorl.team.transport import Received, Traffic, Transport

HELD_BACK = 0.5
"""A message that is overtaken comes up to this much later [s]."""

WAITING = 100_000
"""So many messages are on their way to a robot at most."""

Topology = Literal["full", "line", "ring"]
Reaches = Callable[[str, str, float], bool]
"""Whether what a sender says at a time [s] reaches a receiver."""


@dataclass(frozen=True)
class Partition:
    """From ``start`` to ``end`` [s] only robots of one group hear one another; who is in none hears nobody."""

    groups: tuple[frozenset[str], ...]
    start: float
    end: float

    def parts(self, a: str, b: str, now: float) -> bool:
        """Whether it stands between two robots now."""
        return self.start <= now < self.end and not any(a in group and b in group for group in self.groups)


def everywhere(sender: str, receiver: str, now: float) -> bool:
    """Everyone hears everyone."""
    return True


def topology(name: Topology, robots: Sequence[str]) -> Reaches:
    """Who hears whom when robots stand in this order."""
    place = {robot: index for index, robot in enumerate(robots)}

    def reaches(sender: str, receiver: str, now: float) -> bool:
        if sender not in place or receiver not in place:
            return False
        apart = abs(place[sender] - place[receiver])
        return apart <= 1 or (name == "ring" and apart == len(place) - 1)

    return everywhere if name == "full" else reaches


@dataclass(frozen=True)
class Faults:
    """What goes wrong on every link. Shares are in [0, 1]; times in seconds."""

    seed: int = 0
    loss: float = 0.0
    """share of messages that never come"""
    delay: tuple[float, float] = (0.0, 0.0)
    """shortest and longest time on the way"""
    duplicate: float = 0.0
    """share that comes twice"""
    reorder: float = 0.0
    """share that is overtaken by later ones"""
    partitions: tuple[Partition, ...] = ()
    reaches: Reaches = everywhere

    def connected(self, sender: str, receiver: str, now: float) -> bool:
        """Whether anything passes from one to the other."""
        return self.reaches(sender, receiver, now) and not any(p.parts(sender, receiver, now) for p in self.partitions)


class Faulty:
    """A transport as ``robot`` finds it on a bad network. ``now``: the time partitions are given in [s].

    What is delayed comes with the time of its arrival; the inner transport's clock and ``now`` may differ.
    """

    def __init__(self, transport: Transport, robot: str, faults: Faults, now: Callable[[], float]) -> None:
        self.robot, self.faults = robot, faults
        self.cut = 0
        """messages that were lost"""
        self._inner, self._now = transport, now
        self._links: dict[str, Random] = {}
        self._order = count()
        self._on_their_way: list[tuple[float, int, Received]] = []

    def send(self, channel: str, payload: bytes) -> None:
        """To all; faults are the receivers'."""
        self._inner.send(channel, payload)

    def poll(self) -> list[Received]:
        """What has come by now."""
        now = self._now()
        for message in self._inner.poll():
            for late in self._delays(message.sender, now):
                arriving = message._replace(at=message.at + late)
                heapq.heappush(self._on_their_way, (now + late, next(self._order), arriving))
        arrived = []
        while self._on_their_way and self._on_their_way[0][0] <= now:
            arrived.append(heapq.heappop(self._on_their_way)[2])
        return arrived

    def _delays(self, sender: str, now: float) -> list[float]:
        """How late each copy of a message comes [s]; none if it is lost."""
        faults = self.faults
        link = self._links.setdefault(sender, Random(f"{faults.seed}:{sender}:{self.robot}"))
        lost, twice, held = (
            link.random() < faults.loss,
            link.random() < faults.duplicate,
            link.random() < faults.reorder,
        )
        delays = [link.uniform(*faults.delay) for _ in range(2)]
        if held:
            delays[0] += link.uniform(0.0, HELD_BACK)
        if lost or not faults.connected(sender, self.robot, now) or len(self._on_their_way) >= WAITING:
            self.cut += 1
            return []
        return delays if twice else delays[:1]

    def present(self) -> frozenset[str]:
        """Those whose messages pass."""
        now = self._now()
        return frozenset(other for other in self._inner.present() if self.faults.connected(other, self.robot, now))

    @property
    def traffic(self) -> Traffic:
        """What the inner transport carried."""
        return self._inner.traffic

    def close(self) -> None:
        """Leave the network."""
        self._inner.close()
