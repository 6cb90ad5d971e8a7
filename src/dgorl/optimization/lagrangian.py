"""min Σ f_i s.t. c(x) ≤ 0 through the paper's regularised Lagrangian. METHOD §5.

L = Σ f_i + μᵀc − (γ/2) |μ|², one μ per bound, the paper's N absorbed in μ and γ; the paper's dual step
μ⁺ = max(0, (1 − ηγ) μ + η c) with η = ρ and γ driven to 0, as at γ > 0 the optimum exceeds a bound by γ μ.

The step is taken at c of the poses it leads to, those that minimise Σ f_i + ½ ρ Σ max(0, c + (1 − ργ) μ / ρ)²: there
the slope of Σ f_i + μ⁺ᵀc vanishes. So no step is too long, whatever ρ, and where L alone has only a saddle ρ holds the
poses. That minimum is the optimum of the same graph with one-sided ranges more: any solver finds it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dgorl.configuration import Solver
from dgorl.optimization import native
from dgorl.optimization.constraints import Constraints
from dgorl.optimization.problem import Indices, Problem, Solution
from dgorl.optimization.solver import solve
from dgorl.se2 import Array

EXCESS = 1e-7
"""A bound counts as kept within this [m]; γ μ is driven below it."""
STEP = 1e-9
"""Largest last step of an optimisation under bounds [m, rad]: the excess is read off its optimum."""
ROUNDS = 40
"""At most this many rounds; windows take 5 to 15."""
ITERATIONS = 1500
"""No further round after this many iterations of the solver; windows take 50 to 500."""
STILL = 1e-4
"""No dual step is taken while the solver ran out of iterations and still moved the poses this far [m, rad]."""
NEAR = 1.0
"""Bounds that are this far from being reached are left out [m], until they are nearer."""
FIRST = 1e3
"""The first ρ [1/m²]: that of a range good to 3 cm ..."""
GROWTH = 10.0
"""... times this ..."""
SHRINKING = 0.25
"""... wherever a step leaves more than this share of what bounds were off ..."""
LAST = 1e9
"""... up to this: bounds that are exceeded even so contradict one another."""
GAMMA = 0.01
"""First γ, in units of 1/ρ; each round divides it by 100 ..."""
HARMLESS = 0.05
"""... until γ μ is this share of ``EXCESS``."""


@dataclass(frozen=True)
class Constrained:
    """An optimum under constraints: its multipliers μ (M,), largest excess [m], the last γ, and rounds taken.

    The solution's cost and covariance are those of Σ f_i alone: a bound says nothing of the spread inside it.
    Its reason is ``converged`` only if every bound is kept and every μ belongs to a bound that is reached. Otherwise
    the poses are those of the round that exceeds the bounds least, and the reason says what ended the search:
    ``infeasible``, no ρ was enough, or ``max_iterations``.
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
    excess = constraints.values(plain.poses)
    best = point = _Point(np.zeros(len(excess)), plain.poses, excess, True)
    near = np.zeros(len(excess), dtype=bool)
    iterations, rho, gamma, rounds, reason = plain.iterations, FIRST, 0.0, 0, "max_iterations"
    while reason == "max_iterations" and rounds < ROUNDS and iterations < ITERATIONS:
        harmless = HARMLESS * EXCESS / max(float(point.multipliers.max()), 1.0)
        gamma = min(GAMMA / rho, max(GAMMA / rho * 100.0**-rounds, harmless))
        rounds += 1
        near |= point.excess > -NEAR
        rows = np.flatnonzero(near)
        kept = (1 - rho * gamma) * point.multipliers
        bounds = constraints[rows].factors(point.poses, kept[rows] / rho, rho)
        held = replace(problem, initial=point.poses, scalars=(*problem.scalars, bounds))
        found = solve(held, np.zeros(0, np.int64), STEP, solver)
        iterations += found.iterations
        excess = constraints.values(found.poses)
        settled = found.reason in ("converged", "stalled")
        arrived = settled or float(np.abs(found.poses - point.poses).max()) < STILL
        multipliers = np.where(near, np.maximum(0.0, kept + rho * excess), 0.0) if arrived else point.multipliers
        before, point = point.off, _Point(multipliers, found.poses, excess, settled)
        best = min(best, point, key=lambda p: (max(p.violation, EXCESS), p.off))
        if point.settled and point.off < EXCESS:
            best, reason = point, "converged"
        elif arrived and point.off > SHRINKING * before:
            rho *= GROWTH
            reason = "infeasible" if rho > LAST else reason
    cost = native.graph(problem).cost(best.poses)
    covariance = native.covariance(problem, best.poses, select)
    solution = Solution(best.poses, cost, iterations, reason, covariance)
    return Constrained(solution, best.multipliers, best.violation, gamma, rounds)


@dataclass(frozen=True)
class _Point:
    """Multipliers μ, poses, c there, and whether the slope of Σ f_i + μᵀc vanishes there."""

    multipliers: Array
    poses: Array
    excess: Array
    settled: bool

    @property
    def violation(self) -> float:
        """Largest excess [m]."""
        return max(float(self.excess.max()), 0.0)

    @property
    def off(self) -> float:
        """How far bounds are from being settled [m]: c = 0 where μ > 0, c ≤ 0 where μ = 0."""
        return float(np.where(self.multipliers > 0, np.abs(self.excess), np.maximum(self.excess, 0.0)).max())
