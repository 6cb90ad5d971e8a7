"""A simulated team's log. METHOD §9."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from dgorl.logs.log import Log, Start, in_order
from dgorl.measurements import Covariance, Displacement, Measurement
from dgorl.se2 import Array, wrap
from dgorl.simulation.links import radio_of
from dgorl.simulation.scenario import START_SIGMA, Scenario
from dgorl.simulation.sensors import sense
from dgorl.simulation.terrain import Landscape
from dgorl.simulation.world import Trajectories, move


def simulate(scenario: Scenario) -> Log:
    """The log of a scenario: a pure function of it, its seed included.

    Odometry is one Displacement a robot and step, with the covariance of the step's noise. Known starts are
    the true start poses plus a draw of START_SIGMA: that is what a start with a prior of 0.05 m, 1° means.
    The log's configuration states the radio, not the wheels' scale and lag: these the estimator has to be
    told.
    """
    team = move(scenario)
    stamps: Array = np.arange(scenario.steps + 1, dtype=float) * scenario.period
    measurements: list[Measurement] = list(_odometry(scenario, team, stamps))
    for (i, a), (j, b) in combinations(enumerate(scenario.names), 2):
        measurements += sense(scenario, a, b, team.poses[1:, [i, j]], stamps[1:])
    truth = {name: np.column_stack([stamps, team.poses[:, k]]) for k, name in enumerate(scenario.names)}
    starts = {name: _known_start(scenario, name, team.poses[0, k]) for k, name in enumerate(scenario.names)}
    name = Path(f"simulation-{scenario.seed}")
    log = Log(name, scenario.names, in_order(measurements), truth, starts, _configuration(scenario), {})
    if not scenario.terrain:
        return log
    land = Landscape(scenario)
    return replace(log, terrain=land.map(), altitudes=tuple(land.altitudes(team.poses[1:], stamps[1:])))


def _odometry(scenario: Scenario, team: Trajectories, stamps: Array) -> Iterator[Displacement]:
    xx, yy, tt = (sigma * sigma for sigma in scenario.odometry_sigma)
    covariance: Covariance = (xx, 0.0, 0.0, yy, 0.0, tt)
    for k, name in enumerate(scenario.names):
        for step, (v, omega) in enumerate(team.twists[:, k].tolist()):
            start, end = float(stamps[step]), float(stamps[step + 1])
            yield Displacement(name, start, end, v * scenario.period, 0.0, omega * scenario.period, covariance)


def _known_start(scenario: Scenario, name: str, T_w_r: Array) -> Start:
    x, y, theta = T_w_r + scenario.generator(f"known start {name}").normal(0.0, START_SIGMA)
    return Start(0.0, (float(x), float(y), float(wrap(theta))))


def _configuration(scenario: Scenario) -> dict[str, Any]:
    if "rssi" not in scenario.sensors:
        return {}
    radio = radio_of(scenario)
    names = ("rssi_at_1m_dbm", "path_loss_exponent", "sigma_db", "reciprocity")
    settings = {name: getattr(radio, name) for name in names}
    if scenario.shadowing_correlation > 0 and scenario.speed > 0:
        # Both ends move: readings this long apart have e⁻² of their shadowing in common.
        settings["thinning"] = scenario.shadowing_correlation / scenario.speed
    return {"radio": settings}
