"""g2o from Python: g2opy's own vertices and relative poses, the range edge it lacks written in Python."""

from __future__ import annotations

import time
from functools import cache
from math import hypot, log
from typing import Any

import numpy as np

from dgorl.errors import MissingExtraError, pip_install
from dgorl.evaluation.solvers.run import Run, bare
from dgorl.optimization.problem import Indices, Problem
from dgorl.radio import MINIMUM_DISTANCE


def optimize(problem: Problem, newest: Indices, iterations: int) -> Run:
    """g2o's Levenberg–Marquardt with its own first damping, which Python cannot set.

    No marginals: g2opy 2.3 raises TypeError. Raises MissingExtraError without g2opy.
    """
    try:
        import g2opy
    except ImportError as error:
        raise MissingExtraError(f"g2o from Python needs g2opy: {pip_install('g2opy')}") from error
    graph = bare(problem)
    began = time.process_time()
    optimizer = g2opy.SparseOptimizer()
    optimizer.set_algorithm(g2opy.OptimizationAlgorithmLevenberg(g2opy.BlockSolverX(g2opy.LinearSolverEigenX())))
    vertices = []
    for k, pose in enumerate(problem.initial.tolist()):
        vertex = g2opy.VertexSE2()
        vertex.set_id(k)
        vertex.set_estimate(g2opy.SE2(*pose))
        vertex.set_fixed(bool(problem.fixed[k]))
        optimizer.add_vertex(vertex)
        vertices.append(vertex)
    relative = zip(graph.start, graph.end, graph.delta.tolist(), graph.information, strict=True)
    for i, j, delta, information in relative:
        edge = g2opy.EdgeSE2()
        edge.set_vertex(0, vertices[i])
        edge.set_vertex(1, vertices[j])
        edge.set_measurement(g2opy.SE2(*delta))
        edge.set_information(information)
        optimizer.add_edge(edge)
    reading = _edge_type()
    radio = problem.radio if graph.kind == "rssi" else None
    kept = [
        reading(vertices[i], vertices[j], value, sigma, radio)
        for i, j, value, sigma in zip(graph.i, graph.j, graph.value.tolist(), graph.sigma.tolist(), strict=True)
    ]
    for edge in kept:
        optimizer.add_edge(edge)
    optimizer.initialize_optimization()
    built = time.process_time()
    taken = optimizer.optimize(iterations)
    ended = time.process_time()
    poses = np.array([vertex.estimate().to_vector() for vertex in vertices])
    return Run(poses, 1e3 * (built - began), 1e3 * (ended - built), None, taken)


@cache
def _edge_type() -> Any:
    """A class of range and RSSI edges. radio: A [dBm] and η of the path-loss model, None for ranges [m]."""
    import g2opy

    class Reading(g2opy.VariableVectorXEdge):  # type: ignore[misc]
        def __init__(self, a: Any, b: Any, value: float, sigma: float, radio: tuple[float, float] | None) -> None:
            super().__init__()
            self.a, self.b, self.value, self.radio = a, b, value, radio
            self.loss = 0.0 if radio is None else 10 * radio[1] / log(10)
            self.set_dimension(1)
            self.resize(2)
            self.set_vertex(0, a)
            self.set_vertex(1, b)
            self.set_information(np.full((1, 1), sigma**-2))

        def off(self) -> tuple[float, float, float]:
            (ax, ay, _), (bx, by, _) = (v.estimate().to_vector().tolist() for v in (self.a, self.b))
            return ax - bx, ay - by, hypot(ax - bx, ay - by)

        def compute_error(self) -> None:
            _, _, distance = self.off()
            if self.radio is None:
                error = distance - self.value
            else:
                error = self.value - self.radio[0] + self.loss * log(max(distance, MINIMUM_DISTANCE))
            self.error = np.array([error])

        def linearize_oplus(self) -> None:
            x, y, distance = self.off()
            scale = 1 / max(distance, 1e-3)
            if self.radio is not None:
                scale = self.loss / distance**2 if distance > MINIMUM_DISTANCE else 0.0
            # Steps are along the world's axes.
            self.set_jacobian(0, np.array([[scale * x, scale * y, 0.0]], order="F"))
            self.set_jacobian(1, np.array([[-scale * x, -scale * y, 0.0]], order="F"))

    return Reading
