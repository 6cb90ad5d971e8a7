"""g2o, the paper's solver: the same factors as Python edges of g2opy, the same optimum. METHOD §5."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from dgorl import se2
from dgorl.errors import MissingExtraError, pip_install
from dgorl.optimization.linearization import Linearization
from dgorl.optimization.problem import Problem
from dgorl.se2 import Array

BATCHES = (5, 10, 20, 40, 80, 160)
"""Iterations between two looks at the step. Each batch begins with g2o's own damping, which is large for poses that
are known badly, so they grow."""


def optimize(problem: Problem, tolerance: float) -> tuple[Array, int, str]:
    """Poses (N, 3), iterations and the reason for stopping, from the initial poses.

    tolerance: how far a batch of iterations still moves a pose [m, rad]. Raises MissingExtraError without g2opy.
    """
    try:
        import g2opy
    except ImportError as error:
        raise MissingExtraError(f"the solver g2o needs g2opy: {pip_install('g2opy')}") from error
    optimizer = g2opy.SparseOptimizer()
    optimizer.set_algorithm(g2opy.OptimizationAlgorithmLevenberg(g2opy.BlockSolverX(g2opy.LinearSolverEigenX())))
    vertices = []
    for k, pose in enumerate(problem.initial):
        vertex = g2opy.VertexSE2()
        vertex.set_id(k)
        vertex.set_estimate(g2opy.SE2(*map(float, pose)))
        vertex.set_fixed(bool(problem.fixed[k]))
        optimizer.add_vertex(vertex)
        vertices.append(vertex)

    def read() -> Array:
        return np.array([vertex.estimate().to_vector() for vertex in vertices])

    factors = Linearization(problem, read)
    edges = [_edge_type()(factors, number, vertices) for number in range(len(factors.factors))]
    for edge in edges:
        optimizer.add_edge(edge)
    done, poses = 0, read()
    for batch in BATCHES:
        optimizer.initialize_optimization()  # once a batch ended early, g2o goes on only after this
        ran = optimizer.optimize(batch)
        done += ran
        before, poses = poses, read()
        moved = float(np.abs(poses - before).max())
        if moved < tolerance:
            return poses, done, "converged" if moved > 0 else "stalled"
    return poses, done, "stalled" if ran < batch else "max_iterations"


@cache
def _edge_type() -> Any:
    """A class of edges that ask a linearization; whitened, so that their information is the identity."""
    import g2opy

    class Edge(g2opy.VariableVectorXEdge):  # type: ignore[misc]
        def __init__(self, factors: Linearization, number: int, vertices: list[Any]) -> None:
            super().__init__()
            _, _, ends, dimension = factors.factors[number]
            self.factors, self.number, self.ends = factors, number, [vertices[k] for k in ends]
            self.set_dimension(dimension)
            self.resize(len(ends))
            for place, vertex in enumerate(self.ends):
                self.set_vertex(place, vertex)
            self.set_information(np.eye(dimension))

        def evaluated(self) -> tuple[list[Any], Array, Array]:
            poses = [vertex.estimate().to_vector().tolist() for vertex in self.ends]
            return poses, *self.factors.at(self.number, [tuple(pose) for pose in poses])

        def compute_error(self) -> None:
            self.error = self.evaluated()[1]

        def linearize_oplus(self) -> None:
            poses, _, jacobian = self.evaluated()
            for place, (_, _, theta) in enumerate(poses):
                # Memory by columns down to the strides: what asfortranarray leaves of a single row is refused.
                block = np.empty((len(jacobian), 3), order="F")
                # g2o adds a step to x and y in the world's axes, ours are the body's.
                block[:, :2] = jacobian[:, 3 * place : 3 * place + 2] @ se2.rotation(-theta)
                block[:, 2] = jacobian[:, 3 * place + 2]
                self.set_jacobian(place, block)

    return Edge
