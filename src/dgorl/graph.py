"""The optimised graph G_o as a result that can be drawn: poses, newest edges with residuals, adjacency. METHOD §5."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dgorl import se2
from dgorl.estimate import Edge, OptimizedGraph
from dgorl.optimization.problem import Loss, Problem, Scalars
from dgorl.radio import MINIMUM_DISTANCE
from dgorl.relative import Relative
from dgorl.se2 import Array
from dgorl.team_state import TeamState
from dgorl.tracks import Track, TrackKey

RECENT = 5.0
"""Edges older than this [s] are not drawn."""


def optimized_graph(
    robot: str, own: Track | None, state: TeamState | None, relative: Mapping[TrackKey, Relative]
) -> OptimizedGraph:
    """G_o of the component ``robot`` stands in, in its frame; the robot alone while nothing is joined."""
    if state is None or own is None:
        return OptimizedGraph({robot: np.zeros(3)}, (), np.zeros((1, 1)))
    poses = {robot: np.zeros(3), **{key.robot: seen.pose for key, seen in relative.items()}}
    names = sorted({key.robot for key in state.window.layout})
    adjacency = np.zeros((len(names), len(names)))
    newest: dict[tuple[str, str, str], Edge] = {}
    robots = [key.robot for key, (_, _, count) in state.window.layout.items() for _ in range(count)]
    for scalars, stamps in zip(state.window.problem.scalars, state.window.stamps, strict=True):
        residual = residuals(state.window.problem, scalars, state.solution.poses)
        weight = weights(residual, scalars.loss)
        for i, j, stamp, e, w in zip(scalars.i, scalars.j, stamps, residual, weight, strict=True):
            a, b, kind = robots[i], robots[j], scalars.kind
            row, column = names.index(a), names.index(b)
            adjacency[row, column] += 1
            adjacency[column, row] += 1
            if stamp >= state.stamp - RECENT:
                newest[a, b, kind] = Edge(a, b, kind, float(stamp), float(e), float(w))
    return OptimizedGraph(dict(sorted(poses.items())), tuple(newest.values()), adjacency)


def residuals(problem: Problem, s: Scalars, poses: Array) -> Array:
    """Normalised residuals (M,) of one kind's readings at ``poses`` (N, 3) [σ]. METHOD §2."""
    end_i, end_j = se2.compose(poses[s.i], s.at_i), se2.compose(poses[s.j], s.at_j)
    if s.kind == "bearing":
        seen = se2.between(end_i, end_j)
        return np.asarray(se2.wrap(np.arctan2(seen[:, 1], seen[:, 0]) - s.value) / s.sigma)
    distance = np.sqrt(np.sum((end_i[:, :2] - end_j[:, :2]) ** 2, axis=1) + s.height**2)
    if s.kind == "rssi":
        at_1m, exponent = problem.radio
        expected = at_1m - 10 * exponent * np.log10(np.maximum(distance, MINIMUM_DISTANCE))
        return np.asarray((s.value - expected) / s.sigma)
    return np.asarray((distance - s.value) / s.sigma)


def weights(residual: Array, loss: Loss) -> Array:
    """Robust weights ρ'(e²) (M,), 1 for full trust."""
    e = np.abs(residual)
    if loss.kernel.startswith("huber"):
        weight = np.minimum(1.0, loss.width / np.maximum(e, 1e-12))
    elif loss.kernel.startswith("cauchy"):
        weight = 1.0 / (1.0 + (e / loss.width) ** 2)
    else:
        return np.ones_like(e)
    return np.where(residual > 0, 1.0, weight) if loss.kernel.endswith("negative") else weight


def losses(residual: Array, loss: Loss) -> Array:
    """Robust costs 2ρ(e²) (M,) in place of e²."""
    e = np.abs(residual)
    if loss.kernel.startswith("huber"):
        cost = np.where(e <= loss.width, e**2, loss.width * (2 * e - loss.width))
    elif loss.kernel.startswith("cauchy"):
        cost = loss.width**2 * np.log1p((e / loss.width) ** 2)
    else:
        return np.asarray(e**2)
    return np.where(residual > 0, e**2, cost) if loss.kernel.endswith("negative") else cost
