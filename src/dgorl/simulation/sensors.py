"""What the robots sense of one another, pair by pair."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dgorl.measurements import Bearing, Measurement, Range, Rssi
from dgorl.se2 import Array, wrap
from dgorl.simulation.links import rssi
from dgorl.simulation.scenario import RANGE_EXCESS, RSSI_LOSS_DB, Scenario


def sense(scenario: Scenario, a: str, b: str, poses: Array, stamps: Array) -> Iterator[Measurement]:
    """All readings between robots a and b within ``comm_range``.

    poses: (T, 2, 3) true poses of a and b [m, m, rad] at ``stamps`` (T,) [s]. RSSI and bearing: one a
    direction and step; range: one a pair and step, measured by a and b in turn. Without line of sight
    (``nlos``) a pair's range is too long and its signal too weak, in both directions alike.
    """
    pair = f"{a} {b}"
    ends = poses[:, :, :2]
    distance = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    heard = np.flatnonzero(distance <= scenario.comm_range)
    blocked = scenario.generator(f"nlos {pair}").uniform(size=len(stamps)) < scenario.nlos
    if "rssi" in scenario.sensors:
        loss = scenario.generator(f"loss {pair}").exponential(RSSI_LOSS_DB, len(stamps)) * blocked
        dbm = rssi(scenario, pair, ends) - loss[:, None]
        for k in heard:
            yield Rssi(a, b, float(stamps[k]), float(dbm[k, 0]))
            yield Rssi(b, a, float(stamps[k]), float(dbm[k, 1]))
    if "range" in scenario.sensors:
        noise = scenario.generator(f"range {pair}").normal(0.0, scenario.range_sigma, len(stamps))
        excess = scenario.generator(f"excess {pair}").exponential(RANGE_EXCESS, len(stamps)) * blocked
        ranges = np.maximum(distance + noise + excess, 0.0)
        for k in heard:
            robot, peer = (a, b) if k % 2 == 0 else (b, a)
            yield Range(robot, peer, float(stamps[k]), float(ranges[k]), scenario.range_sigma)
    if "bearing" in scenario.sensors:
        bearings = _bearings(scenario, pair, poses)
        for k in heard:
            yield Bearing(a, b, float(stamps[k]), float(bearings[k, 0]), scenario.bearing_sigma)
            yield Bearing(b, a, float(stamps[k]), float(bearings[k, 1]), scenario.bearing_sigma)


def _bearings(scenario: Scenario, pair: str, poses: Array) -> Array:
    """Bearings of b seen by a and of a seen by b, (T, 2) [rad]."""
    dx, dy = (poses[:, 1, :2] - poses[:, 0, :2]).T
    towards = np.stack([np.arctan2(dy, dx), np.arctan2(-dy, -dx)], axis=-1)
    noise = scenario.generator(f"bearing {pair}").normal(0.0, scenario.bearing_sigma, towards.shape)
    return wrap(towards - poses[:, :, 2] + noise)
