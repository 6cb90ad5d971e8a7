"""GTSAM: the same factors as Python callbacks, the same optimum. METHOD §5.

Its own between and range factors would not do: another error function, no offsets, heights or one-sided kernels.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dgorl.errors import MissingExtraError, pip_install
from dgorl.optimization.linearization import Linearization
from dgorl.optimization.problem import Problem
from dgorl.se2 import Array

ITERATIONS = 500
"""At most this many of Levenberg–Marquardt."""


def optimize(problem: Problem, tolerance: float) -> tuple[Array, int, str]:
    """Poses (N, 3), iterations and the reason for stopping, from the initial poses.

    tolerance: how far the last iteration moves a pose [m, rad]. Raises MissingExtraError without gtsam.
    """
    try:
        import gtsam
    except ImportError as error:
        raise MissingExtraError(f"the solver gtsam needs gtsam: {pip_install('gtsam')}") from error
    at = _Poses(problem)
    factors = Linearization(problem, at)
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in at.free:
        start.insert(k, gtsam.Pose2(*at.start[k]))
    for number in range(len(factors.factors)):
        factor = _Factor(factors, number, at, problem.fixed.tolist())
        if factor.moving:
            unit = gtsam.noiseModel.Unit.Create(factor.dimension)
            graph.add(gtsam.CustomFactor(unit, [k for _, k in factor.moving], factor))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, _parameters(gtsam))
    poses = np.array(problem.initial)
    for done in range(1, ITERATIONS + 1):
        optimizer.iterate()
        at.values, before = optimizer.values(), poses
        poses = at()
        moved = float(np.abs(poses - before).max())
        if moved < tolerance:
            return poses, done, "converged" if moved > 0 else "stalled"
    return poses, ITERATIONS, "max_iterations"


def _parameters(gtsam: Any) -> Any:
    """Damping in proportion to the diagonal, and no end before the steps are short.

    Where readings fit badly, Gauss–Newton overshoots for good, and a damping that is too small in one direction
    is too large in another: information of odometry and of relative poses differs by 10⁸.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setDiagonalDamping(True)
    parameters.setlambdaInitial(1e-6)
    parameters.setlambdaUpperBound(1e15)
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    return parameters


class _Poses:
    """The poses (N, 3) of the values GTSAM is at: fixed ones are constants of the callbacks."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.free = np.flatnonzero(~problem.fixed).tolist()
        self.start = [tuple(pose) for pose in problem.initial.tolist()]
        self.values: Any = None

    def __call__(self) -> Array:
        poses = np.array(self._problem.initial)
        for k in self.free:
            poses[k] = self.of(k)
        return poses

    def of(self, k: int) -> tuple[float, ...]:
        pose = self.values.atPose2(k)
        return pose.x(), pose.y(), pose.theta()


class _Factor:
    """Residual and Jacobians of one whitened factor, as GTSAM calls for them."""

    def __init__(self, factors: Linearization, number: int, poses: _Poses, fixed: list[bool]) -> None:
        self._factors, self._number, self._poses = factors, number, poses
        _, _, self._ends, self.dimension = factors.factors[number]
        self.moving = [(place, k) for place, k in enumerate(self._ends) if not fixed[k]]

    def __call__(self, _: Any, values: Any, jacobians: Any) -> Array:
        poses = self._poses
        poses.values = values
        own = [poses.start[k] for k in self._ends]
        for place, k in self.moving:
            own[place] = poses.of(k)
        residual, jacobian = self._factors.at(self._number, own)
        if jacobians is not None:
            for column, (place, _) in enumerate(self.moving):
                jacobians[column] = np.asfortranarray(jacobian[:, 3 * place : 3 * place + 3])
        return residual
