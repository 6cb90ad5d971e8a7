"""Solvers beside one another: the same graphs, the same starts, the same cost, in one run. METHOD §9."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import median

import numpy as np

from dgorl.errors import MissingExtraError
from dgorl.evaluation.solvers import cpp_g2o, python_g2o, python_gtsam
from dgorl.evaluation.solvers.graphs import Sensor, SolverGraph, solver_graphs
from dgorl.evaluation.solvers.run import Run
from dgorl.evaluation.solvers.table import AGREEMENT, SolverRow, SolverTable
from dgorl.optimization import native
from dgorl.team_state import TOLERANCE

Peer = Callable[[SolverGraph, int], Run]


def _native(graph: SolverGraph, iterations: int = native.ITERATIONS) -> Run:
    """The core as a tick calls it. Optimum and marginals are one call: the optimum alone is timed beside it."""
    problem = graph.problem
    began = time.process_time()
    built = native.graph(problem)
    ready = time.process_time()
    built.optimize(problem.initial[None], iterations, TOLERANCE)
    optimised = time.process_time()
    found = built.solve(problem.initial, graph.newest, iterations, TOLERANCE)
    ended = time.process_time()
    optimise, both = 1e3 * (optimised - ready), 1e3 * (ended - optimised)
    return Run(found.poses[0], 1e3 * (ready - began), optimise, both - optimise, int(found.iterations[0]))


PEERS: Mapping[str, Peer] = {
    "native, told": _native,
    "g2o": lambda graph, iterations: cpp_g2o.optimize(graph.problem, graph.newest, iterations),
    "g2opy": lambda graph, iterations: python_g2o.optimize(graph.problem, graph.newest, iterations),
    "gtsam": lambda graph, iterations: python_gtsam.optimize(graph.problem, graph.newest, iterations),
}
SLOW = ("g2opy", "gtsam")
"""Timed fewer times: hundreds of milliseconds a graph."""
MOST_ITERATIONS = 40
"""A peer that needs more to get there is in another optimum."""


def compare_solvers(
    graphs: int = 10,
    seed: int = 0,
    sensors: Sequence[Sensor] = ("rssi",),
    peers: Sequence[str] = tuple(PEERS),
    repeats: int = 10,
) -> SolverTable:
    """CPU times of the native core and its peers on ``graphs`` simulated teams from ``seed`` on, from two starts each.

    The native core stops by itself, as in a tick. A peer is told the first number of its iterations that comes within
    AGREEMENT of the optimum's cost, so it spends nothing on finding out; ``native, told`` is the core on these terms.
    Times are medians over ``repeats`` runs of each graph, 3 at most for those in Python. Peers that are not there are
    left out, with the reason in the table.
    """
    rows: list[SolverRow] = []
    missing: dict[str, str] = {}
    for graph, best in (pair for k in range(graphs) for sensor in sensors for pair in _with_optimum(seed + k, sensor)):
        rows.append(_row(graph, "native", best, list(_runs(graph, _native, native.ITERATIONS, repeats))))
        for name in (peer for peer in peers if peer not in missing):
            try:
                iterations = _enough(graph, PEERS[name], best)
            except MissingExtraError as error:
                missing[name] = str(error)
                continue
            times = min(repeats, 3) if name in SLOW else repeats
            rows.append(_row(graph, name, best, list(_runs(graph, PEERS[name], iterations, times))))
    return SolverTable(tuple(rows), missing)


def _with_optimum(seed: int, sensor: Sensor) -> list[tuple[SolverGraph, float]]:
    """One team's graph from each start, and the cost of its best optimum known: RSSI alone can have others."""
    starts = solver_graphs(seed, sensor)
    costs = [native.graph(graph.problem).optimize(graph.problem.initial[None], 200).cost[0] for graph in starts]
    return [(graph, float(min(costs))) for graph in starts]


def _enough(graph: SolverGraph, peer: Peer, best: float) -> int:
    """The first number of iterations after which the cost is the optimum's, or else the one where it settles."""
    cost = native.graph(graph.problem).cost
    costs: list[float] = []
    while len(costs) < MOST_ITERATIONS:
        costs.append(cost(peer(graph, len(costs) + 1).poses))
        if costs[-1] < best * (1 + AGREEMENT):
            return len(costs)
    return next(k for k, reached in enumerate(costs, 1) if reached <= costs[-1] * (1 + AGREEMENT))


def _runs(graph: SolverGraph, peer: Peer, iterations: int, times: int) -> Iterator[Run]:
    for _ in range(times):
        gc.disable()
        yield peer(graph, iterations)
        gc.enable()


def _row(graph: SolverGraph, solver: str, best: float, runs: Sequence[Run]) -> SolverRow:
    cost = native.graph(graph.problem).cost(runs[0].poses)
    marginals = [run.marginals_ms for run in runs if run.marginals_ms is not None]
    return SolverRow(
        graph=graph.seed,
        sensor=graph.sensor,
        start=graph.start,
        solver=solver,
        poses=int(np.count_nonzero(~graph.problem.fixed)),
        readings=len(graph.problem.scalars[0].value),
        build_ms=median(run.build_ms for run in runs),
        optimise_ms=median(run.optimise_ms for run in runs),
        marginals_ms=median(marginals) if marginals else None,
        total_ms=median(run.total_ms for run in runs),
        iterations=runs[0].iterations,
        cost=cost,
        off=cost / best - 1,
    )
