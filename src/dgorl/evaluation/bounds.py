"""The expected Cramér–Rao bound: E[J Λ⁻¹ Jᵀ], Λ the Fisher information of the trajectory graph at the truth.

METHOD §8. The bound at a tick is that of all data up to the tick, no window and no robust kernel. A known start counts
with its prior; robots that nothing but measurements links are joined at the truth, so that without known starts the
bound is that of unknown ones.
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
from dgorl.optimization.problem import DensePrior, Indices, Loss, Problem, Solution
from dgorl.relative import first_order
from dgorl.se2 import Array
from dgorl.team_state import TeamState, joint_now
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Component, Window, assemble, grow, merged

VAGUE_SIGMA = (1e3, 1e3, 30.0)
"""So little is assumed of each track's first pose, that the arithmetic stays finite where information is missing."""

UNBOUNDED = (100.0, np.pi)
"""Where position or heading are not known better than this, the information counts as singular [m, rad]."""


def bound(
    log: Log, configuration: Configuration, starts: list[Measurement], stamps: Array
) -> Mapping[tuple[str, str], Array]:
    """Covariance (T, 3, 3) that no unbiased estimator of T_ego_peer at ``stamps`` (T,) can undercut, by (ego, peer).

    The covariance is of (x, y, theta) in the ego's true frame; what the data leaves undetermined is NaN there: the
    bound is infinite. Pairs never linked to one another are left out. starts: known ones, or none.
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
        for component in linked(history, grow(history, (), -np.inf, float(now)), float(now)):
            if len(component.stretches) > 1:
                window = assemble(history, component, -np.inf, float(now), None)
                state = _state_at_truth(history, window, log, float(now))
                for ego in component.tracks:
                    for peer, seen in state.relative(ego).items():
                        if peer != WORLD_KEY:
                            covariance = first_order(seen.pose, seen.tangent)
                            found.setdefault((ego.robot, peer.robot), []).append((row, _bounded(covariance)))
    return {pair: _series(rows, len(stamps)) for pair, rows in found.items()}


def linked(history: History, components: list[Component], limit: float) -> list[Component]:
    """Components joined where measurements up to ``limit`` [s] link their tracks; how they stand does not matter."""
    home = {history.numbers[key]: k for k, unit in enumerate(components) for key in unit.tracks}
    units: list[Component | None] = list(components)
    for table in history.tables.values():
        if not len(table):
            continue
        rows = table.between(-np.inf, limit)
        for a, b in np.unique(np.column_stack([rows.track_a, rows.track_b]), axis=0).tolist():
            one, other = home.get(a), home.get(b)
            if one is None or other is None or one == other:
                continue
            first, second = units[one], units[other]
            assert first is not None
            assert second is not None
            units[one], units[other] = merged(first, second, np.zeros(3)), None
            home = {number: one if k == other else k for number, k in home.items()}
    return [unit for unit in units if unit is not None]


def _state_at_truth(history: History, window: Window, log: Log, now: float) -> TeamState:
    poses = np.array(window.problem.initial)
    for key, (offset, first, count) in window.layout.items():
        stamps = np.maximum(np.arange(first, first + count) / KEYFRAMES_PER_SECOND, key.begin)
        poses[offset : offset + count] = truth_at(log.truth, key.robot, stamps)
    problem = _of_gaussian_noise(window.problem)
    if window.world is None:
        problem = replace(problem, priors=(*problem.priors, *_vague(window, poses)))

    def at_truth(select: Indices) -> Solution:
        return Solution(poses, 0.0, 0, "truth", native.covariance(problem, poses, select))

    return joint_now(history, window, now, at_truth)


def _of_gaussian_noise(problem: Problem) -> Problem:
    """Without kernels: these weigh by the readings' errors, on which the expected information does not depend."""
    return replace(problem, scalars=tuple(replace(scalars, loss=Loss()) for scalars in problem.scalars))


def _vague(window: Window, poses: Array) -> list[DensePrior]:
    """Next to nothing said of each track's first pose; the pinned one stays where it is."""
    information = np.diag(1.0 / np.square(VAGUE_SIGMA))
    free = [offset for offset, _, _ in window.layout.values() if not window.problem.fixed[offset]]
    return [DensePrior(-1, np.array([k]), poses[k : k + 1], information, np.zeros(3)) for k in free]


def _bounded(covariance: Array) -> Array:
    """NaN in place of what is not determined."""
    largest = np.linalg.eigvalsh(covariance[:2, :2])[-1]
    covariance = np.array(covariance)
    if not largest < UNBOUNDED[0] ** 2:
        covariance[:] = np.nan
    elif not covariance[2, 2] < UNBOUNDED[1] ** 2:
        covariance[2, :] = covariance[:, 2] = np.nan
    return covariance


def _series(rows: list[tuple[int, Array]], length: int) -> Array:
    series = np.full((length, 3, 3), np.nan)
    for row, covariance in rows:
        series[row] = covariance
    return series
