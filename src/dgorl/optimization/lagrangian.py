"""min Σ f_i s.t. c(x) ≤ 0 through the paper's regularised Lagrangian. METHOD §5.

L = Σ f_i + μᵀc − (γ/2) |μ|², one μ per bound, the paper's N absorbed in μ and γ. For a fixed μ the minimum over the
poses is that of the same graph with relative-pose factors of information μ more: any solver finds it. μ follows the
paper's dual step; γ goes to 0, as at γ > 0 the optimum exceeds a bound by γ μ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dgorl.configuration import Solver
from dgorl.optimization import native
from dgorl.optimization.constraints import Constraints
from dgorl.optimization.problem import Indices, Problem, RelativePoses, Solution
from dgorl.optimization.solver import solve
from dgorl.se2 import Array

EXCESS = 1e-7
"""A bound counts as kept within this [m]; γ μ is driven below it."""
STEP = 1e-9
"""Largest last step of an optimisation with multipliers [m, rad]: the excess is read off its optimum."""
ROUNDS = 50
"""At most this many dual steps."""
GAMMA = 1e-3
"""First γ, in units of the dual's curvature; each round divides it by 100 ..."""
HARMLESS = 0.05
"""... until γ μ is this share of ``EXCESS``."""


@dataclass(frozen=True)
class Constrained:
    """An optimum under constraints: its multipliers μ (M,), largest excess [m], the last γ, and dual steps taken.

    The solution's cost and covariance are those of Σ f_i alone: a bound says nothing of the spread inside it.
    Its reason is ``converged`` only if every bound is kept and every μ belongs to a bound that is reached.
    """

    solution: Solution
    multipliers: Array
    violation: float
    gamma: float
    rounds: int


def constrained(
    problem: Problem, constraints: Constraints, select: Indices, tolerance: float, solver: Solver = "native"
) -> Constrained:
    """Optimise as :func:`~dgorl.optimization.solver.solve` does, then until every bound is kept.

    Where the plain optimum keeps them it is returned as it is. Raises ValueError and MissingExtraError as solve does.
    """
    plain = solve(problem, select, tolerance, solver)
    if not len(constraints) or constraints.values(plain.poses).max() <= 0:
        return Constrained(plain, np.zeros(len(constraints)), 0.0, 0.0, 0)
    dual = _Dual(problem, constraints, solver)
    point, gamma, rounds = dual.point(np.zeros(len(constraints)), plain.poses), 0.0, 0
    iterations, reason = plain.iterations, "max_iterations"
    while rounds < ROUNDS:
        rounds += 1
        curvature = dual.curvature(point)
        scale = float(np.diag(curvature).max())
        gamma = max(GAMMA * scale * 100.0 ** (1 - rounds), HARMLESS * EXCESS / max(point.multipliers.max(), EXCESS / scale))
        following = dual.step(point, curvature, gamma)
        if following is None:
            reason = "stalled"
            break
        point = following
        iterations += point.iterations
        if point.unsettled(0.0) < EXCESS:
            reason = "converged"
            break
    cost = native.graph(problem).cost(point.poses)
    covariance = native.covariance(problem, point.poses, select)
    solution = Solution(point.poses, cost, iterations, reason, covariance)
    return Constrained(solution, point.multipliers, float(max(point.excess.max(), 0.0)), gamma, rounds)


@dataclass(frozen=True)
class _Point:
    """Multipliers μ, the poses that minimise Σ f_i + μᵀc, that minimum, and c there."""

    multipliers: Array
    poses: Array
    lagrangian: float
    excess: Array
    iterations: int

    def unsettled(self, gamma: float) -> float:
        """How far the dual is from its maximum [m]: c = γμ where μ > 0, c ≤ 0 where μ = 0."""
        slope = self.excess - gamma * self.multipliers
        return float(np.where(self.multipliers > 0, np.abs(slope), np.maximum(slope, 0.0)).max())


class _Dual:
    """The dual function of μ, min over the poses of L: its values, its curvature, the paper's steps on it."""

    def __init__(self, problem: Problem, constraints: Constraints, solver: Solver) -> None:
        self._problem, self._constraints, self._solver = problem, constraints, solver

    def point(self, multipliers: Array, start: Array) -> _Point:
        """The dual at μ, the poses found from ``start``."""
        weighted = replace(self._weighted(multipliers), initial=start)
        found = solve(weighted, np.zeros(0, np.int64), STEP, self._solver)
        lagrangian = found.cost - float(multipliers @ self._constraints.limit) / 2
        return _Point(multipliers, found.poses, lagrangian, self._constraints.values(found.poses), found.iterations)

    def curvature(self, point: _Point) -> Array:
        """∂c H⁻¹ ∂cᵀ (K, K) of the K bounds that are reached: minus the second derivative of the dual.

        H with all second derivatives: with Gauss–Newton's, which suits readings that fit, ten rounds became fifty.
        """
        reached = _reached(point)
        bounds = self._constraints[reached]
        gradients = np.zeros((len(reached), len(point.poses), 3))
        for end, part in ((bounds.i, slice(3)), (bounds.j, slice(3, 6))):
            gradients[np.arange(len(reached)), end] += bounds.gradients(point.poses)[:, part]
        free = gradients[:, ~self._problem.fixed].reshape(len(reached), -1)
        hessian, _ = native.graph(self._weighted(point.multipliers)).hessian(point.poses, exact=True)
        return np.asarray(free @ np.linalg.solve(hessian, free.T))

    def step(self, point: _Point, curvature: Array, gamma: float) -> _Point | None:
        """μ⁺ = max(0, (1 − ηγ) μ + η c) with η the inverse of the dual's curvature, on the bounds that are reached.

        With a number for η this creeps. With η = (∂c P ∂cᵀ + γ)⁻¹ it is Newton's step, and max(0, ·) is taken as the
        maximum of the dual's quadratic model over μ ≥ 0. The step is halved until the dual rises; None if it cannot.
        """
        rows = _reached(point)
        mu = point.multipliers[rows]
        model = curvature + gamma * np.eye(len(rows))
        change = nonnegative(model, curvature @ mu + point.excess[rows], mu) - mu
        slope = float((point.excess[rows] - gamma * mu) @ change)
        length = 1.0
        while length > 1e-3:
            multipliers = point.multipliers.copy()
            multipliers[rows] = np.maximum(mu + length * change, 0.0)
            following = self.point(multipliers, point.poses)
            rise = _value(following, gamma) - _value(point, gamma)
            # Near the maximum the dual is flat within rounding: there the bounds tell whether it got better.
            flat = abs(slope) < 1e-9 * (1 + abs(point.lagrangian))
            if rise > 1e-4 * length * slope or (flat and following.unsettled(gamma) < point.unsettled(gamma)):
                return following
            length /= 2
        return None

    def _weighted(self, multipliers: Array) -> Problem:
        """The problem with the factors of μᵀc; bounds without a multiplier add none."""
        counted = np.flatnonzero(multipliers)
        if not len(counted):
            return self._problem
        factors, known = self._constraints[counted].factors(multipliers[counted]), self._problem.relative_poses
        if known is not None:
            pairs = zip(vars(known).values(), vars(factors).values(), strict=True)
            factors = RelativePoses(*(np.concatenate(pair) for pair in pairs))
        return replace(self._problem, relative_poses=factors)


def _reached(point: _Point) -> Indices:
    return np.flatnonzero((point.multipliers > 0) | (point.excess > 0))


def _value(point: _Point, gamma: float) -> float:
    return point.lagrangian - gamma / 2 * float(point.multipliers @ point.multipliers)


def nonnegative(matrix: Array, vector: Array, start: Array) -> Array:
    """The x ≥ 0 (K,) that minimises ½ xᵀAx − bᵀx, A (K, K) positive definite, by Lawson and Hanson's active sets.

    From ``start`` ≥ 0, and with no entry held at 0 at first: most bounds that are reached stay so.
    """
    x, free = start.copy(), np.ones(len(vector), dtype=bool)
    enough = 1e-12 * np.abs(vector).max(initial=0.0)
    for _ in range(10 * len(vector)):
        while free.any():
            wanted = np.zeros(len(x))
            wanted[free] = np.linalg.solve(matrix[np.ix_(free, free)], vector[free])
            sinking = free & (wanted <= 0)
            if not sinking.any():
                x = wanted
                break
            length = float((x[sinking] / (x[sinking] - wanted[sinking] + 1e-300)).min())
            x = x + length * (wanted - x)
            free &= ~(sinking & (x <= 1e-14 * x.max()))
            x[~free] = 0.0
        gain = np.where(free, -np.inf, vector - matrix @ x)
        if gain.max(initial=-np.inf) <= enough:
            break
        free[int(gain.argmax())] = True
    return x
