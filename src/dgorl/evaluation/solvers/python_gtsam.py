"""GTSAM from Python: its own relative poses and ranges; RSSI, which it lacks, as a factor in Python."""

from __future__ import annotations

import time
from math import cos, hypot, log, sin
from typing import Any

import numpy as np

from dgorl.errors import MissingExtraError, pip_install
from dgorl.evaluation.solvers.run import Bare, Run, bare
from dgorl.optimization.problem import Indices, Problem
from dgorl.radio import MINIMUM_DISTANCE


def optimize(problem: Problem, newest: Indices, iterations: int) -> Run:
    """GTSAM's Levenberg–Marquardt, then the joint marginals of the newest poses.

    Raises MissingExtraError without gtsam, ValueError where a fixed pose is not the world's.
    """
    try:
        import gtsam
    except ImportError as error:
        raise MissingExtraError(f"GTSAM from Python needs gtsam: {pip_install('gtsam')}") from error
    if problem.initial[problem.fixed].any():
        raise ValueError("solvers are compared with the world fixed at the origin")
    graph = bare(problem)
    began = time.process_time()
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in np.flatnonzero(~problem.fixed).tolist():
        values.insert(k, gtsam.Pose2(*problem.initial[k].tolist()))
    for i, j, delta, information in zip(
        graph.start.tolist(), graph.end.tolist(), graph.delta.tolist(), graph.information, strict=True
    ):
        noise, measured = gtsam.noiseModel.Gaussian.Information(information), gtsam.Pose2(*delta)
        if problem.fixed[i]:
            factors.add(gtsam.PriorFactorPose2(j, measured, noise))
        else:
            factors.add(gtsam.BetweenFactorPose2(i, j, measured, noise))
    _add_readings(gtsam, factors, graph, problem.radio)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(1e-6)
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters)
    built = time.process_time()
    found = optimizer.optimize()
    optimised = time.process_time()
    marginals = gtsam.Marginals(factors, found)
    covariance = marginals.jointMarginalCovariance(newest.tolist()).fullMatrix()
    ended = time.process_time()
    poses = np.array(problem.initial)
    for k in np.flatnonzero(~problem.fixed).tolist():
        pose = found.atPose2(k)
        poses[k] = pose.x(), pose.y(), pose.theta()
    times = 1e3 * (built - began), 1e3 * (optimised - built), 1e3 * (ended - optimised)
    return Run(poses, *times, optimizer.iterations(), covariance)


def _add_readings(gtsam: Any, factors: Any, graph: Bare, radio: tuple[float, float]) -> None:
    at_1m, loss = radio[0], 10 * radio[1] / log(10)
    for i, j, value, sigma in zip(
        graph.i.tolist(), graph.j.tolist(), graph.value.tolist(), graph.sigma.tolist(), strict=True
    ):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        if graph.kind == "range":
            factors.add(gtsam.RangeFactorPose2(i, j, value, noise))
            continue

        def error(factor: Any, values: Any, jacobians: Any, value: float = value) -> Any:
            a, b = (values.atPose2(key) for key in factor.keys())  # noqa: SIM118
            x, y = a.x() - b.x(), a.y() - b.y()
            distance = max(hypot(x, y), MINIMUM_DISTANCE)
            if jacobians is not None:
                scale = loss / distance**2 if distance > MINIMUM_DISTANCE else 0.0
                for place, sign, pose in ((0, scale, a), (1, -scale, b)):
                    c, s = cos(pose.theta()), sin(pose.theta())  # steps are along the body's axes
                    jacobians[place] = np.array([[sign * (c * x + s * y), sign * (c * y - s * x), 0.0]], order="F")
            return np.array([value - at_1m + loss * log(distance)])

        factors.add(gtsam.CustomFactor(noise, [i, j], error))
