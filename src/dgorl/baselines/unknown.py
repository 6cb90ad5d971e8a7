"""Baselines without known starts: they begin where DGORL, running beside them, first tracks everybody. METHOD §7.

None of them can find a team from nothing, so each is given the first relative poses that DGORL states as `tracked`,
with their covariance, and is on its own from then on. Its world is the first robot's body frame at that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dgorl.configuration import Configuration
from dgorl.estimate import Estimate, PeerEstimate, Status
from dgorl.localizer import Team
from dgorl.measurements import (
    WORLD,
    Displacement,
    Measurement,
    Odometry,
    RelativePose,
)
from dgorl.se2 import Array

if TYPE_CHECKING:
    from dgorl.baselines import TeamEstimator

FRAME_SIGMA = 1e-3
"""The first robot stands where its own frame is, as exactly as a covariance can say without harm [m, rad]."""

WAITING = "waits for DGORL to track every peer: its first poses are this estimator's start"


class AfterTracking:
    """A baseline that begins when the first robot by name sees every peer as `tracked` by DGORL.

    Until then every peer is isolated. Afterwards it takes readings stamped later than that; DGORL is not asked again.
    """

    def __init__(self, baseline: TeamEstimator, robots: Sequence[str], configuration: Configuration) -> None:
        self._baseline = baseline
        self._robots = sorted(robots)
        self._finder: Team | None = Team(configuration)
        self._started = np.inf

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of any robot."""
        if self._finder is not None:
            self._finder.add(measurement)
        if isinstance(measurement, Odometry | Displacement) or measurement.stamp > self._started:
            self._baseline.add(measurement)

    def update(self, now: float) -> Any:
        """The baseline's state at ``now`` [s]."""
        if self._finder is not None:
            seen = self._finder.view(self._robots[0], self._finder.update(now), now)
            if all(peer in seen and seen[peer].status is Status.TRACKED for peer in self._robots[1:]):
                self._finder, self._started = None, now
                for start in starts_of(seen, self._robots, now):
                    self._baseline.add(start)
        return self._baseline.update(now)

    def view(self, robot: str, state: Any, now: float) -> Estimate:
        """The team as one robot sees it; the frame the baseline began in is nobody's world."""
        estimate = self._baseline.view(robot, state, now)
        peers = {peer: seen for peer, seen in estimate.items() if peer != WORLD}
        if self._finder is not None:
            peers = {peer: _waiting(seen.age) for peer, seen in peers.items()}
        return replace(estimate, peers=peers)


def _waiting(age: float) -> PeerEstimate:
    return PeerEstimate(None, None, Status.ISOLATED, 0.0, age, WAITING)


def starts_of(seen: Estimate, robots: Sequence[str], now: float) -> list[RelativePose]:
    """Starts in the body frame of ``robots[0]`` at ``now`` [s], from how it sees the others.

    What the errors of several peers have in common is lost: each start is stated alone.
    """
    own = FRAME_SIGMA**2
    starts = [RelativePose(WORLD, robots[0], now, 0.0, 0.0, 0.0, (own, 0.0, 0.0, own, 0.0, own), prior=True)]
    for peer in robots[1:]:
        pose, covariance = seen[peer].pose, seen[peer].tangent_covariance
        if pose is not None and covariance is not None:
            starts.append(_start(peer, now, pose, covariance))
    return starts


def _start(peer: str, now: float, pose: Array, covariance: Array) -> RelativePose:
    x, y, theta = pose.tolist()
    xx, xy, xt, yy, yt, tt = covariance[np.triu_indices(3)].tolist()
    return RelativePose(WORLD, peer, now, x, y, theta, (xx, xy, xt, yy, yt, tt), prior=True)
