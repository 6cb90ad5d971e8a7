"""One function in front of the solvers. METHOD §5."""

from __future__ import annotations

from dgorl.configuration import Solver
from dgorl.optimization import g2o, gtsam, native
from dgorl.optimization.problem import Indices, Problem, Solution

LINEAR = 1e-3
"""The native core converges quadratically, g2o and GTSAM linearly on radio: they stop at a step this much shorter."""
SHORTEST = 1e-9
"""No solver is asked for a shorter step [m, rad]: rounding moves poses as far."""


def solve(problem: Problem, select: Indices, tolerance: float, solver: Solver = "native") -> Solution:
    """Optimise from the initial poses, then the joint covariance of the selected poses in their right tangents.

    tolerance: largest step of the last iteration [m, rad]. All solvers find the same optimum of the same cost.
    Raises ValueError when the graph leaves a pose undetermined, MissingExtraError when the solver is not installed.
    """
    if solver == "native" or problem.fixed.all():
        return native.solve(problem, select, tolerance)
    optimize = g2o.optimize if solver == "g2o" else gtsam.optimize
    poses, iterations, reason = optimize(problem, max(LINEAR * tolerance, SHORTEST))
    # Cost and covariance are the core's: g2opy cannot give marginals, and both would count robust factors by the
    # slope of √ρ in place of the weight ρ' that covariances mean everywhere else.
    covariance = native.covariance(problem, poses, select)
    return Solution(poses, native.graph(problem).cost(poses), iterations, reason, covariance)
