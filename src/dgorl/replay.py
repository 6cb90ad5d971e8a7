"""Replay of a log: measurements reach the team in the order they became known, one tick at a time. No truth enters."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil, floor

from dgorl import baselines
from dgorl.configuration import Configuration
from dgorl.errors import DgorlError
from dgorl.estimate import Estimate
from dgorl.localizer import Team
from dgorl.logs.log import Log, Part, Start, Step
from dgorl.measurements import WORLD, ClockKey, Displacement, Measurement, Odometry, RelativePose, known_at
from dgorl.team_time import team_on

ALONE = 60.0
"""So long [s] after the last odometry a replay goes on."""

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

    def __init__(
        self, log: Log, configuration: Configuration, initial: str, egos: Sequence[str], estimator: str
    ) -> None:
        measurements: list[Measurement] = sorted(log.measurements, key=known_at)
        if initial == "known":
            measurements = sorted([*known_starts(log), *measurements], key=known_at)
        self._make = partial(baselines.make, estimator, log, configuration, initial=initial)
        self._team = self._make()
        self._egos = egos
        self._configuration = configuration
        self._clock: ClockKey | None = None
        period = configuration.period
        stamps = [known_at(m) for m in log.measurements]
        first, last = (ceil(min(stamps) / period), floor(_end(log, max(stamps)) / period)) if stamps else (0, -1)
        self._count = max(last - first + 1, 0) if log.live is None else len(log.live.steps)
        self._steps = iter(log.live.steps) if log.live else _paced(measurements, period, range(first, last + 1))

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Tick]:
        for step in self._steps:
            began = time.process_time()
            if step.started is not None:
                self._begin(step.started)
            for part in step.admitted:
                self._take(part)
            now = self._team_now(step.now)
            state = self._team.update(now)
            shared = time.process_time() - began
            estimates, cpu = {}, {}
            for ego in self._egos:
                began = time.process_time()
                estimates[ego] = self._team.view(ego, state, now)
                cpu[ego] = shared + time.process_time() - began
            yield Tick(now, estimates, cpu)

    def _begin(self, clock: ClockKey) -> None:
        """A live robot's program begins, on its clock."""
        self._clock = clock
        estimated = self._configuration.clock == "estimated"
        self._team = team_on(self._configuration, clock) if estimated else self._make()

    def _take(self, part: Part) -> None:
        if part.clock is None or not isinstance(self._team, Team):
            for measurement in part.measurements:
                self._team.add(measurement)
            return
        for reading in part.readings:
            self._team.add_reading(reading)
        for measurement in part.measurements:
            self._team.add(measurement, part.clock)

    def _team_now(self, now: float) -> float:
        """Team time when the live robot's clock shows ``now`` [s]."""
        if self._clock is None or not isinstance(self._team, Team):
            return now
        placed = self._team.team_now(*self._clock, now)
        return now if placed is None else placed


def _end(log: Log, last: float) -> float:
    """Until when there is something to estimate [s]: everybody is isolated soon after the last odometry."""
    told = max((m.end for m in log.measurements if isinstance(m, Odometry | Displacement)), default=last)
    return min(last, told + ALONE)


def _paced(measurements: Sequence[Measurement], period: float, ticks: range) -> Iterator[Step]:
    """Measurements in the order they become known, each at the first tick it is known at."""
    taken = 0
    for k in ticks:
        begin = taken
        while taken < len(measurements) and known_at(measurements[taken]) <= k * period:
            taken += 1
        yield Step(k * period, (Part(tuple(measurements[begin:taken])),))


def replay(
    log: Log,
    configuration: Configuration,
    *,
    initial: str = "known",
    egos: Sequence[str] | None = None,
    estimator: str = "dgorl",
) -> Replay:
    """Localise every ego's peers, causally, at multiples of the period; a journal's at the ticks it recorded.

    initial: ``known`` takes the log's start poses; a journal's are those its robot had, either way. egos: names, by
    default all robots of the log, of a journal the one that kept it. estimator: one of
    ``dgorl.baselines.NAMES``; a baseline with unknown starts begins with DGORL's first tracked poses.
    Raises DgorlError for an unknown ego or estimator, missing starts, and inputs an estimator needs that are missing.
    """
    chosen = tuple(egos) if egos else (log.live.robot,) if log.live else log.robots
    for ego in chosen:
        if ego not in log.robots:
            raise DgorlError(f"{log.path}: no robot named `{ego}`; the log has {', '.join(log.robots)}")
    if log.live and configuration.clock == "estimated" and estimator != "dgorl":
        raise DgorlError(f"{log.path}: kept with `clock: estimated`, which only DGORL itself can replay")
    return Replay(log, configuration, initial, chosen, estimator)


def known_starts(log: Log) -> list[RelativePose]:
    """The log's start poses as priors on the world. Raises DgorlError when a robot has none."""
    missing = [robot for robot in log.robots if robot not in log.starts]
    if missing:
        raise DgorlError(
            f"{log.path}: no start pose for {', '.join(missing)}; give `start` in team.yaml or a ground truth"
        )
    return start_priors({robot: log.starts[robot] for robot in log.robots})


def start_priors(starts: Mapping[str, Start]) -> list[RelativePose]:
    """Known start poses as priors on the world."""
    return [_start(robot, start) for robot, start in starts.items()]


def _start(robot: str, start: Start) -> RelativePose:
    xx, yy, tt = (sigma**2 for sigma in START_SIGMA)
    x, y, theta = start.pose
    return RelativePose(WORLD, robot, start.stamp, x, y, theta, (xx, 0.0, 0.0, yy, 0.0, tt), prior=True)
