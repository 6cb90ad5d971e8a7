"""What one run of a solver gives, and a problem's factors without what the compared graphs do not have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dgorl.optimization.problem import Indices, Problem
from dgorl.se2 import Array


@dataclass(frozen=True)
class Run:
    """Poses (N, 3), CPU times [ms], iterations, and the newest poses' joint covariance in the solver's own tangents.

    marginals_ms is None where a solver cannot give them.
    """

    poses: Array
    build_ms: float
    optimise_ms: float
    marginals_ms: float | None
    iterations: int
    covariance: Array | None = None

    @property
    def total_ms(self) -> float:
        return self.build_ms + self.optimise_ms + (self.marginals_ms or 0.0)


@dataclass(frozen=True)
class Bare:
    """Relative poses from start to end (M,), odometry first; readings of one kind between i and j. C-contiguous."""

    start: Indices
    end: Indices
    delta: Array
    information: Array
    kind: str
    i: Indices
    j: Indices
    value: Array
    sigma: Array


def bare(problem: Problem) -> Bare:
    """The factors as solvers without offsets, kernels and dense priors take them. Raises ValueError if it has such."""
    relative = problem.relative_poses
    if problem.priors or relative is None or relative.at_i.any() or relative.at_j.any() or len(problem.scalars) != 1:
        raise ValueError("solvers are compared on graphs with known starts, one sensor and no dense prior")
    readings = problem.scalars[0]
    if readings.at_i.any() or readings.at_j.any() or readings.height.any() or readings.loss.kernel != "none":
        raise ValueError("solvers are compared on readings at keyframes, without kernels")
    i, j, delta, information = problem.odometry
    return Bare(
        start=_flat(np.concatenate([i, relative.i])),
        end=_flat(np.concatenate([j, relative.j])),
        delta=np.concatenate([delta, relative.delta]),
        information=np.concatenate([information, relative.information]),
        kind=readings.kind,
        i=_flat(readings.i),
        j=_flat(readings.j),
        value=np.ascontiguousarray(readings.value, dtype=float),
        sigma=np.ascontiguousarray(readings.sigma, dtype=float),
    )


def _flat(indices: Indices) -> Indices:
    return np.ascontiguousarray(indices, dtype=np.int64)
