"""Replay of a log: measurements reach the team in the order they became known, one tick at a time. No truth enters."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor

from dgorl.configuration import Configuration
from dgorl.errors import DgorlError
from dgorl.estimate import Estimate
from dgorl.localizer import Localizer, Team
from dgorl.logs.log import Log, Start
from dgorl.measurements import WORLD, Measurement, RelativePose, known_at

START_SIGMA = (0.05, 0.05, 0.017453292519943295)
"""How well known starts are trusted: 0.05 m, 0.05 m, 1° (INTERFACES, ``--initial known``)."""


@dataclass(frozen=True)
class Tick:
    """Every ego's estimate at ``stamp`` [s], and the CPU time the tick took for each ego [s]."""

    stamp: float
    estimates: Mapping[str, Estimate]
    cpu_s: Mapping[str, float]


class Replay:
    """An iterable of ticks with a length. Iterate it once."""

    def __init__(self, log: Log, configuration: Configuration, initial: str, egos: Sequence[str]) -> None:
        self._measurements: list[Measurement] = sorted(log.measurements, key=known_at)
        if initial == "known":
            self._measurements = sorted([*known_starts(log), *self._measurements], key=known_at)
        self._team = Team(configuration)
        self._egos = [Localizer(ego, team=self._team) for ego in egos]
        period = configuration.period
        self._period = period
        stamps = [known_at(m) for m in log.measurements]
        self._first, self._last = (ceil(min(stamps) / period), floor(max(stamps) / period)) if stamps else (0, -1)

    def __len__(self) -> int:
        return max(self._last - self._first + 1, 0)

    def __iter__(self) -> Iterator[Tick]:
        waiting = iter([*self._measurements, None])
        measurement = next(waiting)
        for k in range(self._first, self._last + 1):
            now = k * self._period
            began = time.process_time()
            while measurement is not None and known_at(measurement) <= now:
                self._team.add(measurement)
                measurement = next(waiting)
            states = self._team.update(now)
            shared = time.process_time() - began
            estimates, cpu = {}, {}
            for ego in self._egos:
                began = time.process_time()
                estimates[ego.robot] = ego.view(states, now)
                cpu[ego.robot] = shared + time.process_time() - began
            yield Tick(now, estimates, cpu)


def replay(
    log: Log, configuration: Configuration, *, initial: str = "known", egos: Sequence[str] | None = None
) -> Replay:
    """Localise every ego's peers, causally, at multiples of the period.

    initial: ``known`` takes the log's start poses. egos: names, by default all robots of the log.
    Raises DgorlError for an unknown ego or missing starts.
    """
    chosen = tuple(egos) if egos else log.robots
    for ego in chosen:
        if ego not in log.robots:
            raise DgorlError(f"{log.path}: no robot named `{ego}`; the log has {', '.join(log.robots)}")
    return Replay(log, configuration, initial, chosen)


def known_starts(log: Log) -> list[RelativePose]:
    """The log's start poses as priors on the world. Raises DgorlError when a robot has none."""
    missing = [robot for robot in log.robots if robot not in log.starts]
    if missing:
        raise DgorlError(
            f"{log.path}: no start pose for {', '.join(missing)}; give `start` in team.yaml or a ground truth"
        )
    return [_start(robot, log.starts[robot]) for robot in log.robots]


def _start(robot: str, start: Start) -> RelativePose:
    xx, yy, tt = (sigma**2 for sigma in START_SIGMA)
    x, y, theta = start.pose
    return RelativePose(WORLD, robot, start.stamp, x, y, theta, (xx, 0.0, 0.0, yy, 0.0, tt), prior=True)
