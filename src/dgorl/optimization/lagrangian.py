"""min Σ f_i s.t. c(x) ≤ 0 through the paper's regularised Lagrangian. METHOD §5.

L = Σ f_i + μᵀc − (γ/2) |μ|², one μ per bound, the paper's N absorbed in μ and γ. For a fixed μ the minimum over the
poses is that of the same graph with relative-pose factors of information μ more: any solver finds it. μ follows the
paper's dual step; γ goes to 0, as at γ > 0 the optimum exceeds a bound by γ μ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dgorl import se2
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
ROUNDS = 100
"""At most this many dual steps."""
PULL = 0.1
"""Where the dual cannot rise: first information of factors that hold the poses to the last ones [1/m², 1/rad²] ..."""
PULLS = 5
"""... and how many times it may grow tenfold."""
HOPELESS = 1e12
"""No bound is worth a multiplier like this: they contradict one another."""
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
    best = point = dual.point(np.zeros(len(constraints)), plain.poses)
    iterations, reason, gamma, pull, rounds = plain.iterations, "max_iterations", 0.0, 0.0, 0
    while reason == "max_iterations" and rounds < ROUNDS:
        if pull:
            dual = replace(dual, centre=point.poses, pull=pull)
            point = dual.point(point.multipliers, point.poses)
        curvature = dual.curvature(point)
        scale = float(np.diag(curvature).max())
        harmless = HARMLESS * EXCESS / max(point.multipliers.max(), EXCESS / scale)
        gamma = max(GAMMA * scale * 100.0**-rounds, harmless)
        rounds += 1
        following = dual.step(point, curvature, gamma)
        if following is None:
            pull = max(10 * pull, PULL)
            if pull >= PULL * 10.0**PULLS or not problem.fixed.any():
                reason = "stalled"
            continue
        moved = float(np.abs(following.poses - point.poses).max())
        point, pull = following, pull / 2 if pull > PULL / 100 else 0.0
        iterations += point.iterations
        best = min(best, point, key=lambda p: p.unsettled(0.0))
        if point.unsettled(0.0) < EXCESS and (not pull or pull * moved < EXCESS):
            reason = "converged"
        elif point.multipliers.max() > HOPELESS:
            reason = "infeasible"
    cost = native.graph(problem).cost(best.poses)
    covariance = native.covariance(problem, best.poses, select)
    solution = Solution(best.poses, cost, iterations, reason, covariance)
    return Constrained(solution, best.multipliers, float(max(best.excess.max(), 0.0)), gamma, rounds)


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


@dataclass(frozen=True)
class _Dual:
    """The dual function of μ, min over the poses of L: its values, its curvature, the paper's steps on it.

    With ``pull``, L has ½ pull |x − centre|² more: far from what the readings say, L alone may have no minimum
    near, only a saddle. The centre follows the poses, so the optimum is the same.
    """

    problem: Problem
    constraints: Constraints
    solver: Solver
    centre: Array | None = None
    pull: float = 0.0

    def point(self, multipliers: Array, start: Array) -> _Point:
        """The dual at μ, the poses found from ``start``."""
        weighted = replace(self.weighted(multipliers), initial=start)
        found = solve(weighted, np.zeros(0, np.int64), STEP, self.solver)
        lagrangian = found.cost - float(multipliers @ self.constraints.limit) / 2
        return _Point(multipliers, found.poses, lagrangian, self.constraints.values(found.poses), found.iterations)

    def curvature(self, point: _Point) -> Array:
        """∂c H⁻¹ ∂cᵀ (K, K) of the K bounds that are reached: minus the second derivative of the dual.

        H with all second derivatives: with Gauss–Newton's, which suits readings that fit, ten rounds became fifty.
        """
        reached = _reached(point)
        bounds = self.constraints[reached]
        gradients = np.zeros((len(reached), len(point.poses), 3))
        for end, part in ((bounds.i, slice(3)), (bounds.j, slice(3, 6))):
            gradients[np.arange(len(reached)), end] += bounds.gradients(point.poses)[:, part]
        free = gradients[:, ~self.problem.fixed].reshape(len(reached), -1)
        hessian, _ = native.graph(self.weighted(point.multipliers)).hessian(point.poses, exact=True)
        return np.asarray(free @ np.linalg.solve(hessian, free.T))

    def step(self, point: _Point, curvature: Array, gamma: float) -> _Point | None:
        """μ⁺ = max(0, (1 − ηγ) μ + η c) with η the inverse of the dual's curvature, on the bounds that are reached.

        With a number for η this creeps. With η = (∂c H⁻¹ ∂cᵀ + γ)⁻¹ it is Newton's step, and max(0, ·) is taken as the
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

    def weighted(self, multipliers: Array) -> Problem:
        """The problem with the factors of μᵀc, and those of the pull; bounds without a multiplier add none."""
        counted = np.flatnonzero(multipliers)
        parts = [self.constraints[counted].factors(multipliers[counted])] if len(counted) else []
        if self.centre is not None:
            free, held = np.flatnonzero(~self.problem.fixed), np.flatnonzero(self.problem.fixed)[:1]
            delta, still = se2.between(self.centre[held], self.centre[free]), np.zeros((len(free), 3))
            pull = np.tile(self.pull * np.eye(3), (len(free), 1, 1))
            parts.append(RelativePoses(np.repeat(held, len(free)), free, still, still, delta, pull))
        if self.problem.relative_poses is not None:
            parts.append(self.problem.relative_poses)
        if not parts:
            return self.problem
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return replace(self.problem, relative_poses=RelativePoses(*map(np.concatenate, columns)))


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
