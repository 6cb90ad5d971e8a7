"""Where everybody is now, in the team's frame: the newest window solution carried on to ``now``. METHOD §1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dgorl import _core
from dgorl.history import WORLD_KEY, History
from dgorl.limits import optimum
from dgorl.optimization.problem import Indices, Solution
from dgorl.relative import Relative, relative_to
from dgorl.se2 import Array
from dgorl.tracks import TrackKey
from dgorl.window import Component, Window, assemble

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

    def relative(self, ego: TrackKey) -> Mapping[TrackKey, Relative]:
        """T_ego_j with its covariances, for every other member."""
        seen = relative_to(self.poses, self.covariance, self.members.index(ego))
        return {key: one for key, one in zip(self.members, seen, strict=True) if key != ego}


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
    if window.world is not None:
        members = (*members, WORLD_KEY)
        poses = np.concatenate([poses, np.zeros((1, 3))])
        grown = np.zeros((3 * len(members), 3 * len(members)))
        grown[:-3, :-3] = covariance
        covariance = grown
    return TeamState(now, members, poses, covariance, window, solution)
