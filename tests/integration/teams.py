"""Small teams and ways to feed a Localizer, shared by the integration tests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from dgorl import Configuration, Localizer, Team
from dgorl.configuration import merge
from dgorl.logs.log import Log
from dgorl.measurements import Measurement, known_at
from dgorl.replay import known_starts
from dgorl.simulation import Scenario, simulate

Flat = dict[tuple[float, str, str], tuple[str, bytes, bytes]]


def simulated(**options: object) -> Log:
    """A small simulated log."""
    return simulate(replace(Scenario(robots=3, steps=60, area=20.0), **options))


def settings(log: Log, **changes: object) -> Configuration:
    return merge(merge(Configuration(), log.configuration, "log"), changes, "test")


def everything(log: Log) -> list[Measurement]:
    """Measurements and known starts in the order they become known."""
    return sorted([*known_starts(log), *log.measurements], key=known_at)


def ticks(log: Log, period: float = 0.5) -> np.ndarray:
    last = max(known_at(m) for m in log.measurements)
    return np.arange(1, int(last / period) + 1) * period


def flat(localizers: Iterable[Localizer], now: float) -> Flat:
    """Every estimate at ``now`` as comparable bits."""
    found: Flat = {}
    for localizer in localizers:
        for peer, estimate in localizer.update(now).items():
            pose = b"" if estimate.pose is None else estimate.pose.tobytes()
            covariance = b"" if estimate.covariance is None else estimate.covariance.tobytes()
            found[now, localizer.robot, peer] = (estimate.status, pose, covariance)
    return found


def team_of(log: Log, configuration: Configuration) -> tuple[Team, list[Localizer]]:
    team = Team(configuration)
    return team, [Localizer(robot, team=team) for robot in log.robots]


def causal(
    log: Log, configuration: Configuration, stamps: Sequence[float], arrive: dict[int, float] | None = None
) -> Flat:
    """Estimates at ``stamps`` when measurement k arrives at ``arrive[k]`` [s], by default as soon as it is known."""
    measurements = everything(log)
    arrival = [(arrive or {}).get(k, known_at(m)) for k, m in enumerate(measurements)]
    order = iter(sorted(range(len(measurements)), key=lambda k: (arrival[k], k)))
    team, localizers = team_of(log, configuration)
    found: Flat = {}
    k = next(order, None)
    for now in stamps:
        while k is not None and arrival[k] <= now:
            team.add(measurements[k])
            k = next(order, None)
        found |= flat(localizers, float(now))
    return found
