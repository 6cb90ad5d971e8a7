"""The native solver: a problem's arrays handed to the C++ core. METHOD §5."""

from __future__ import annotations

from typing import get_args

import numpy as np

from dgorl import _core, se2
from dgorl.configuration import Kernel
from dgorl.optimization.problem import Indices, Problem, Scalars, Solution
from dgorl.se2 import Array

_KERNELS = {name: getattr(_core, name.upper()) for name in get_args(Kernel)}
ITERATIONS = 200
"""At most this many. Ticks take 4; radio alone on a short window, far from the optimum, can take more than 50."""


def graph(problem: Problem) -> _core.Graph:
    """The core's graph of a problem. Raises ValueError naming the argument that is wrong."""
    g = _core.Graph(problem.slots, problem.fixed)
    g.add_odometry(*problem.odometry)
    poses = problem.relative_poses
    if poses is not None:
        g.add_relative_poses(poses.i, poses.j, poses.at_i, poses.at_j, poses.delta, poses.information)
    for scalars in problem.scalars:
        _add_scalars(g, scalars, problem.radio)
    for prior in problem.priors:
        g.add_prior(prior.reference, prior.members, prior.relative, prior.information, prior.gradient)
    return g


def solve(problem: Problem, select: Indices, tolerance: float) -> Solution:
    """Optimise from the initial poses, then the joint covariance of the selected poses in their right tangents.

    tolerance: largest step of the last iteration [m, rad].
    Raises ValueError when the graph leaves a pose undetermined.
    """
    found = graph(problem).solve(problem.initial, select, max_iterations=ITERATIONS, step_tolerance=tolerance)
    return Solution(
        found.poses[0],
        float(found.cost[0]),
        int(found.iterations[0]),
        found.reason[0],
        np.asarray(found.covariance),
    )


def covariance(problem: Problem, poses: Array, select: Indices) -> Array:
    """Joint covariance (3m, 3m) of the selected poses with all factors linearised at ``poses``."""
    return graph(problem).covariance(poses, select)


def _add_scalars(g: _core.Graph, s: Scalars, radio: tuple[float, float]) -> None:
    kernel, width = _KERNELS[s.loss.kernel], s.loss.width
    point_i, point_j = np.ascontiguousarray(s.at_i[:, :2]), np.ascontiguousarray(s.at_j[:, :2])
    ends = (s.i, s.j, point_i, point_j, s.height)
    if s.kind == "rssi":
        at_1m, exponent = (np.full(len(s.i), value) for value in radio)
        g.add_rssi(*ends, s.value, at_1m, exponent, s.sigma, kernel, width)
    elif s.kind == "range":
        g.add_ranges(*ends, s.value, s.sigma, kernel, width)
    else:
        g.add_bearings(s.i, s.j, s.at_i, point_j, s.value, s.sigma, kernel, width)


def marginalize(
    problem: Problem, poses: Array, slot: int, reference: int, world: int | None
) -> tuple[Indices, Array, Array, Array]:
    """What everything before ``slot`` says of the poses there, relative to pose ``reference``. METHOD §1.

    Returns members (m,), their relative poses (m, 3), information (3m, 3m) and gradient (3m,). The world, fixed, is
    a member like the others: that it moves by δ is the same as that all others move by −Ad(X_j⁻¹X_w)δ.
    """
    kept, information, gradient = graph(problem).marginalize(poses, slot)
    kept = np.asarray(kept)
    if world is None:
        members = kept[kept != reference]
        rows = (3 * np.flatnonzero(kept != reference)[:, None] + np.arange(3)).ravel()
        relative = se2.between(poses[reference], poses[members])
        return members, relative, information[np.ix_(rows, rows)], gradient[rows]
    others = kept[kept != reference]
    change = np.zeros((3 * len(kept), 3 * len(kept)))
    moved = -se2.adjoint(se2.between(poses[kept], poses[world]))
    for row, index in enumerate(kept):
        change[3 * row : 3 * row + 3, -3:] = moved[row]
        if index != reference:
            column = int(np.flatnonzero(others == index)[0])
            change[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] = np.eye(3)
    members = np.concatenate([others, [world]])
    relative = se2.between(poses[reference], poses[members])
    information = change.T @ information @ change
    return members, relative, (information + information.T) / 2, change.T @ gradient
