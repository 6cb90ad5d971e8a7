"""Terrain relative navigation with split covariance intersection (Wiktor and Rock, ICRA 2020). METHOD §7.

Each robot weighs the places it may be at by what its altimeter reads above a known elevation map, takes the Gaussian of
the same moments, and fuses ranges to its peers by split covariance intersection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dgorl import se2
from dgorl.baselines.beliefs import Belief, advanced
from dgorl.baselines.intersection import SplitIntersectionTeam
from dgorl.configuration import Configuration
from dgorl.se2 import Array
from dgorl.terrain import Altitude, Terrain

EXTENT = 4.0
"""Places considered reach this far from the estimate [σ]."""

LINES = 33
"""Grid lines across them, in each direction."""


class TerrainTeam(SplitIntersectionTeam):
    """Split covariance intersection, and each robot's altimeter above the map.

    altitudes: the whole log's; each is used when the odometry of its robot tells of its stamp.
    """

    def __init__(self, configuration: Configuration, terrain: Terrain, altitudes: Sequence[Altitude]) -> None:
        super().__init__(configuration)
        self._terrain = terrain
        self._waiting: dict[str, list[Altitude]] = {}
        for altitude in sorted(altitudes, key=lambda m: m.stamp, reverse=True):
            self._waiting.setdefault(altitude.robot, []).append(altitude)

    def _sense(self, until: float, now: float) -> None:
        for robot, waiting in self._waiting.items():
            belief = self._beliefs.get(robot)
            if belief is None:
                continue
            known = min(belief.track.core.known(now), until)
            while waiting and waiting[-1].stamp <= known:
                altitude = waiting.pop()
                keyframe, place = belief.track.core.locate(altitude.stamp)
                if keyframe >= belief.keyframe:
                    belief = above(advanced(belief, keyframe), place, altitude, self._terrain)
            self._beliefs[robot] = belief


def above(belief: Belief, place: Array, altitude: Altitude, terrain: Terrain) -> Belief:
    """The belief given what the altimeter read at ``place`` (3,) in its frame: a point-mass filter.

    Masses on a grid over the position's ellipse; the heading follows by what it has in common with the position. Off
    the map a height is known as well as the map's spread says. The altimeter's noise is the robot's own, so that with
    P⁺ = F P the dependent part becomes F D Fᵀ, as in the linear case.
    """
    p = belief.covariance
    c, s = np.cos(belief.pose[2]), np.sin(belief.pose[2])
    rotation = np.array([[c, -s], [s, c]])
    by_pose = rotation @ np.array([[1.0, 0.0, -place[1]], [0.0, 1.0, place[0]]])
    spread = by_pose @ p @ by_pose.T
    line = np.linspace(-EXTENT, EXTENT, LINES)
    white = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    steps = white @ np.linalg.cholesky(spread).T
    mass = -0.5 * np.sum(white**2, axis=1) + _log_likelihood(
        terrain, se2.compose(belief.pose, place)[:2] + steps, altitude
    )
    mass = np.exp(mass - mass.max())
    mass /= mass.sum()
    mean = mass @ steps
    left = steps - mean
    narrow = (left * mass[:, None]).T @ left
    gain = np.linalg.solve(spread, by_pose @ p).T
    after = p - gain @ (spread - narrow) @ gain.T
    after = (after + after.T) / 2
    shrink = np.linalg.solve(p, after).T
    dependent = shrink @ belief.dependent @ shrink.T
    independent = after - dependent
    if np.linalg.eigvalsh(independent)[0] < 0:  # several places fit: the ellipse grew
        dependent, independent = after, np.zeros((3, 3))
    pose = se2.compose(belief.pose, se2.exp(gain @ mean))
    return replace(belief, pose=pose, dependent=dependent, independent=independent)


def _log_likelihood(terrain: Terrain, points: Array, altitude: Altitude) -> Array:
    heights = terrain.at(points)
    mean, spread = terrain.middle
    off = np.isnan(heights)
    sigma = np.where(off, np.hypot(altitude.sigma, spread), altitude.sigma)
    return np.asarray(-0.5 * ((altitude.height - np.where(off, mean, heights)) / sigma) ** 2 - np.log(sigma))
