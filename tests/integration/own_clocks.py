"""Simulated teams whose robots have their own clocks, and how their messages tell of them."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

from dgorl.logs.log import Log
from dgorl.measurements import ClockKey, ClockReading, Displacement, Measurement, Odometry, robots_of

Delay = Callable[[random.Random], float]


@dataclass(frozen=True)
class Clock:
    """Shows true time + offset, and drift · true time more."""

    offset: float = 0.0
    drift: float = 0.0

    def at(self, true: float) -> float:
        return true + self.offset + self.drift * true


def prompt(rng: random.Random) -> float:
    """About a millisecond, as on an idle radio link."""
    return 0.001 + rng.expovariate(2000.0)


def slow(rng: random.Random) -> float:
    """Up to half a second, as under heavy load."""
    return rng.uniform(0.0, 0.5)


def clocks_of(robots: Iterable[str], rng: random.Random, offset: float = 5.0, ppm: float = 50.0) -> dict[str, Clock]:
    return {name: Clock(rng.uniform(-offset, offset), rng.uniform(-ppm, ppm) * 1e-6) for name in robots}


def key(robot: str) -> ClockKey:
    """The clock of a robot's first epoch."""
    return robot, 2**63 + int(robot[1:])


def author(m: Measurement) -> str:
    return robots_of(m)[0]


def stamped(m: Measurement, clock: Clock) -> Measurement:
    """A measurement as its author's clock has it; its wheels count the same turns."""
    if isinstance(m, Odometry | Displacement):
        start, end = clock.at(m.start), clock.at(m.end)
        if isinstance(m, Displacement):
            return replace(m, start=start, end=end)
        rate = (m.end - m.start) / (end - start)
        return replace(m, start=start, end=end, v=m.v * rate, omega=m.omega * rate)
    return replace(m, stamp=clock.at(m.stamp))


def distorted(log: Log, clocks: Mapping[str, Clock]) -> list[tuple[ClockKey, Measurement]]:
    return [(key(author(m)), stamped(m, clocks[author(m)])) for m in log.measurements]


def exchanged(
    pairs: Iterable[tuple[str, str]],
    clocks: Mapping[str, Clock],
    span: tuple[float, float],
    rng: random.Random,
    delay: Delay = prompt,
    loss: float = 0.0,
    period: float = 0.5,
) -> list[tuple[float, ClockReading]]:
    """Readings at 2 Hz each way between the given pairs, with the true time at which each is known."""
    found = []
    for a, b in pairs:
        for sender, receiver in ((a, b), (b, a)):
            true = span[0] + rng.random() * period
            while true < span[1]:
                took = delay(rng)
                if rng.random() >= loss:
                    sent, received = clocks[sender].at(true), clocks[receiver].at(true + took)
                    found.append((true + took, ClockReading(*key(receiver), *key(sender), sent, received)))
                true += period
    return sorted(found, key=lambda item: (item[0], item[1].robot, item[1].peer))


def all_pairs(robots: Iterable[str]) -> list[tuple[str, str]]:
    names = sorted(robots)
    return [(a, b) for k, a in enumerate(names) for b in names[k + 1 :]]


def line(robots: Iterable[str]) -> list[tuple[str, str]]:
    names = sorted(robots)
    return list(pairwise(names))
