"""Where everybody is now, in the team's frame: the newest window solution carried on to ``now``. METHOD §1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from dgorl import _core
from dgorl.history import WORLD_KEY, History
from dgorl.limits import optimum
from dgorl.optimization.problem import Indices, Solution
from dgorl.se2 import Array
from dgorl.tracks import TrackKey
from dgorl.window import Component, Window, assemble

K = TypeVar("K")

TOLERANCE = 3e-3
"""Largest last step of a tick's optimisation [m, rad]. Convergence is quadratic: the error left is far smaller, and no
later estimate starts from it."""


@dataclass(frozen=True)
class TeamState:
    """Members of one component at ``stamp`` [s]: poses (n, 3), joint covariance (3n, 3n) of right perturbations.

    The world, where known, is the last member and has no uncertainty.
    """

    stamp: float
    members: tuple[TrackKey, ...]
    poses: Array
    covariance: Array
    window: Window
    solution: Solution
    turning: Mapping[TrackKey, float]
    """variance of how members have turned since their odometry ended, where it ends before ``stamp`` [rad²]"""

    def relative(self, ego: TrackKey) -> Mapping[TrackKey, tuple[Array, Array]]:
        """T_ego_j (3,) and its covariance (3, 3) of (x, y, theta) in the ego's frame, for every other member."""
        e = self.members.index(ego)
        poses, covariances = _core.relative(self.poses, self.covariance, e)
        if ego in self.turning:
            covariances[:, :2, :2] += bent(poses, self.turning[ego])
        return {key: (poses[j], covariances[j]) for j, key in enumerate(self.members) if j != e}


def bent(poses: Array, turning: float) -> Array:
    """(N, 2, 2): how the arcs on which peers at poses (N, 3) may lie, as the ego may have turned, leave their tangents.

    turning: variance of the ego's heading [rad²]. To first order peers would move on straight lines: with a robot's
    odometry half a second late that is metres too little. E (1 − cos δ)² p pᵀ.
    """
    share = 1.5 - 2.0 * np.exp(-turning / 2) + np.exp(-2.0 * turning) / 2
    grown: Array = share * poses[:, :2, None] * poses[:, None, :2]
    return grown


def turned(cores: Mapping[K, _core.Track], history: History, now: float) -> dict[K, float]:
    """Variance of how robots have turned since their odometry ended, of those where it ends before ``now`` [rad²]."""
    late = {key: core for key, core in cores.items() if core.known(now) < now}
    return {key: float(core.foreseen(now, history.motion)[2, 2]) for key, core in late.items()}


def team_state(history: History, component: Component, low: float, now: float) -> TeamState:
    """Optimise a component's window [low, now] and carry every robot on to ``now``.

    Raises ValueError when the graph leaves a pose undetermined.
    """
    window = assemble(history, component, low, now, None)
    return joint_now(history, window, now, lambda select: optimum(history.configuration, window, select, TOLERANCE))


def joint_now(history: History, window: Window, now: float, solve: Callable[[Indices], Solution]) -> TeamState:
    """Every member carried on from its newest keyframe to ``now``; ``solve`` gives poses and covariance of those."""
    tracks = {track.key: track for track in history.tracks}
    members = tuple(window.layout)
    last = np.array([window.index(key, tracks[key].core.newest(now)) for key in members], dtype=np.int64)
    solution = solve(last)
    cores = [tracks[key].core for key in members]
    poses, covariance = _core.carry(cores, now, history.motion, solution.poses[last], solution.covariance)
    turning = turned(dict(zip(members, cores, strict=True)), history, now)
    if window.world is not None:
        members = (*members, WORLD_KEY)
        poses = np.concatenate([poses, np.zeros((1, 3))])
        grown = np.zeros((3 * len(members), 3 * len(members)))
        grown[:-3, :-3] = covariance
        covariance = grown
    return TeamState(now, members, poses, covariance, window, solution, turning)
