"""The expected Cramér–Rao bound: E[J Λ⁻¹ Jᵀ], Λ the Fisher information of the trajectory graph at the truth.

METHOD §8. The bound at a tick is that of all data up to the tick, no window; a known start counts with its prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dgorl.configuration import Configuration
from dgorl.evaluation.records import truth_at
from dgorl.history import WORLD_KEY, History
from dgorl.logs.log import Log
from dgorl.measurements import Measurement, known_at
from dgorl.optimization import native
from dgorl.optimization.problem import Indices, Solution
from dgorl.se2 import Array
from dgorl.team_state import TeamState, joint_now
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Window, assemble, grow


def bound(
    log: Log, configuration: Configuration, starts: list[Measurement], stamps: Array
) -> Mapping[tuple[str, str], Array]:
    """Covariance (T, 3, 3) that no unbiased estimator of T_ego_peer at ``stamps`` (T,) can undercut, by (ego, peer).

    The covariance is of (x, y, theta) in the ego's true frame; pairs not linked to one another are left out.
    Raises ValueError where the log's truth does not cover its odometry.
    """
    history = History(replace(configuration, window="all", history=float("inf")))
    waiting = sorted([*starts, *log.measurements], key=known_at)
    found: dict[tuple[str, str], list[tuple[int, Array]]] = {}
    k = 0
    for row, now in enumerate(stamps):
        while k < len(waiting) and known_at(waiting[k]) <= now:
            history.add(waiting[k])
            k += 1
        history.admit(float(now), node_due=True)
        for component in grow(history, (), -np.inf, float(now)):
            if len(component.stretches) > 1:
                window = assemble(history, component, -np.inf, float(now), None)
                state = _state_at_truth(history, window, log, float(now))
                for ego in component.tracks:
                    for peer, (_, covariance) in state.relative(ego).items():
                        if peer != WORLD_KEY:
                            found.setdefault((ego.robot, peer.robot), []).append((row, covariance))
    return {pair: _series(rows, len(stamps)) for pair, rows in found.items()}


def _state_at_truth(history: History, window: Window, log: Log, now: float) -> TeamState:
    poses = np.array(window.problem.initial)
    for key, (offset, first, count) in window.layout.items():
        stamps = np.maximum(np.arange(first, first + count) / KEYFRAMES_PER_SECOND, key.begin)
        poses[offset : offset + count] = truth_at(log.truth, key.robot, stamps)

    def at_truth(select: Indices) -> Solution:
        return Solution(poses, 0.0, 0, "truth", native.covariance(window.problem, poses, select))

    return joint_now(history, window, now, at_truth)


def _series(rows: list[tuple[int, Array]], length: int) -> Array:
    series = np.full((length, 3, 3), np.nan)
    for row, covariance in rows:
        series[row] = covariance
    return series
