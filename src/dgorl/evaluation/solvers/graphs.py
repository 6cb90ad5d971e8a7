"""The graphs solvers are compared on: windows of the paper's experiment, 60 keyframes of each robot. METHOD §9."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dgorl import _core, se2
from dgorl.configuration import Configuration, merge
from dgorl.localizer import Team
from dgorl.measurements import known_at
from dgorl.optimization.problem import Indices, Problem
from dgorl.replay import known_starts
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate

Sensor = Literal["rssi", "range"]
Start = Literal["tracking", "dead reckoning"]
KEYFRAMES = 60
"""Of each robot: 29.5 s, the longest window before the first keyframe is marginalised."""


@dataclass(frozen=True)
class SolverGraph:
    """A window graph, the newest poses (n,) whose joint covariance is asked, and where solvers start from."""

    seed: int
    sensor: Sensor
    start: Start
    problem: Problem
    newest: Indices


def solver_graphs(seed: int, sensor: Sensor, robots: int = 5) -> tuple[SolverGraph, ...]:
    """One simulated team with known starts: the same graph once for each start.

    tracking: the last node's poses, 4.5 s old, extended by odometry, as a tick starts. dead reckoning: the known starts
    extended by odometry. No kernels: all solvers then have the same factors.
    """
    log = simulate(Scenario(robots=robots, steps=KEYFRAMES, sensors=(sensor,), seed=seed))
    configuration = merge(Configuration(), log.configuration, "the simulated log")
    configuration = merge(configuration, {"ranging": {"kernel": "none"}}, "the comparison")
    team = Team(configuration)
    now = (KEYFRAMES - 1) / 2
    for measurement in sorted([*known_starts(log), *log.measurements], key=known_at):
        if known_at(measurement) <= now:
            team.add(measurement)
    window = team.update(now).joined[0].window
    newest = np.array([offset + count - 1 for offset, _, count in window.layout.values()], dtype=np.int64)
    reckoned = np.array(window.problem.initial)
    known = window.problem.relative_poses
    assert known is not None
    for offset, _, count in window.layout.values():
        row = int(np.flatnonzero(known.j == offset)[0])
        start = se2.compose(reckoned[known.i[row]], known.delta[row])
        reckoned[offset : offset + count] = _core.chain(start, _motion(window.problem, offset, count))
    return (
        SolverGraph(seed, sensor, "tracking", window.problem, newest),
        SolverGraph(seed, sensor, "dead reckoning", replace(window.problem, initial=reckoned), newest),
    )


def _motion(problem: Problem, offset: int, count: int) -> Array:
    """Odometry (count − 1, 3) between a track's successive poses."""
    i, _, delta, _ = problem.odometry
    return delta[(i >= offset) & (i < offset + count - 1)]
