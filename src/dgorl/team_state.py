"""Where everybody is now, in the team's frame: the newest window solution carried on to ``now``. METHOD §1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dgorl import _core, se2
from dgorl.history import WORLD_KEY, History
from dgorl.optimization import native
from dgorl.optimization.problem import Indices, Solution
from dgorl.se2 import Array
from dgorl.tracks import TrackKey
from dgorl.window import Component, Window, assemble

TOLERANCE = 1e-7
"""Largest last step of a tick's optimisation [m, rad]."""


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

    def relative(self, ego: TrackKey) -> Mapping[TrackKey, tuple[Array, Array]]:
        """T_ego_j (3,) and its covariance (3, 3) of (x, y, theta) in the ego's frame, for every other member."""
        e = self.members.index(ego)
        relative = se2.between(self.poses[e], self.poses)
        n = len(self.members)
        blocks = self.covariance.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
        back = se2.adjoint(se2.inverse(relative))
        own = blocks[np.arange(n), np.arange(n)]
        cross = blocks[:, e] @ back.transpose(0, 2, 1)
        tangent = own - cross - cross.transpose(0, 2, 1) + back @ blocks[e, e] @ back.transpose(0, 2, 1)
        turn = np.tile(np.eye(3), (n, 1, 1))
        turn[:, :2, :2] = se2.rotation(relative[:, 2])
        covariance = turn @ tangent @ turn.transpose(0, 2, 1)
        covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
        return {key: (relative[j], covariance[j]) for j, key in enumerate(self.members) if j != e}


def team_state(history: History, component: Component, low: float, now: float) -> TeamState:
    """Optimise a component's window [low, now] and carry every robot on to ``now``.

    Raises ValueError when the graph leaves a pose undetermined.
    """
    window = assemble(history, component, low, now, None)
    return joint_now(history, window, now, lambda select: native.solve(window.problem, select, TOLERANCE))


def joint_now(history: History, window: Window, now: float, solve: Callable[[Indices], Solution]) -> TeamState:
    """Every member carried on from its newest keyframe to ``now``; ``solve`` gives poses and covariance of those."""
    tracks = {track.key: track for track in history.tracks}
    members = tuple(window.layout)
    last = np.array([window.index(key, tracks[key].core.newest(now)) for key in members], dtype=np.int64)
    solution = solve(last)
    delta, noise = _core.carried([tracks[key].core for key in members], now, history.motion)
    poses = se2.compose(solution.poses[last], delta)
    covariance = _carried(solution.covariance, delta, noise)
    if window.world is not None:
        members = (*members, WORLD_KEY)
        poses = np.concatenate([poses, np.zeros((1, 3))])
        covariance = np.pad(covariance, (0, 3))
    return TeamState(now, members, poses, covariance, window, solution)


def _carried(covariance: Array, delta: Array, noise: Array) -> Array:
    """Joint covariance (3n, 3n) of poses X_j after each moved by delta_j (n, 3) with noise_j (n, 3, 3)."""
    n = len(delta)
    back = se2.adjoint(se2.inverse(delta))
    blocks = covariance.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    moved = back[:, None] @ blocks @ back[None].transpose(0, 1, 3, 2)
    moved[np.arange(n), np.arange(n)] += noise
    return np.asarray(moved.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n))
