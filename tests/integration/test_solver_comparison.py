"""The solvers that are compared find the same optimum, and their times are said of the same work."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dgorl import se2
from dgorl.errors import MissingExtraError
from dgorl.evaluation.solvers import AGREEMENT, PEERS, SolverTable, compare_solvers, compiled, cpp_g2o
from dgorl.evaluation.solvers.graphs import KEYFRAMES, solver_graphs
from dgorl.optimization import native


@pytest.fixture(scope="module")
def table() -> SolverTable:
    return compare_solvers(graphs=2, seed=7, sensors=("rssi", "range"), repeats=1)


@pytest.mark.parametrize("solver", ["native", *PEERS])
def test_same_optimum(table: SolverTable, solver: str) -> None:
    if solver in table.missing:
        pytest.skip(table.missing[solver])
    rows = [row for row in table.rows if row.solver == solver]
    assert len(rows) == 2 * 2 * 2  # graphs, sensors, starts
    for row in rows:
        assert abs(row.off) < AGREEMENT, row
        assert row.poses == 5 * KEYFRAMES
        assert row.total_ms > 0  # each from a run of its own: on a busy machine either is the longer
        assert row.optimise_ms > 0


def test_summary_is_of_the_rows(table: SolverTable) -> None:
    for entry in table.summary():
        times = [
            r.optimise_ms
            for r in table.rows
            if (r.sensor, r.start, r.solver) == (entry.sensor, entry.start, entry.solver)
        ]
        assert entry.optimise_ms == pytest.approx(np.median(times))
        assert entry.mean_ms == pytest.approx(np.mean(times))
        assert entry.solver != "native" or entry.ratio == entry.total_ratio == 1.0
    assert all(solver in table.text() for solver in {row.solver for row in table.rows})


def test_another_optimum_is_told_from_the_best(table: SolverTable) -> None:
    """Where a solver ends elsewhere the table says so, and compares times on the other graphs alone."""
    ours = [row for row in table.rows if (row.sensor, row.start, row.solver) == ("rssi", "tracking", "native")]
    near, far = (replace(row, solver="peer", total_ms=3 * row.total_ms) for row in ours)
    near, far = replace(near, off=1e-7), replace(far, off=5e-3)
    _, some = SolverTable((*ours, near, far), {}).summary()
    assert (some.reached, some.graphs, some.disagreement) == (1, 2, 1e-7)
    assert some.total_ratio == pytest.approx(3.0)
    lost = SolverTable((ours[1], far), {})
    _, none = lost.summary()
    assert (none.reached, none.ratio, none.disagreement) == (0, None, None)
    assert "0/1" in lost.text()
    assert json.loads(json.dumps(lost.as_dict(), allow_nan=False))["rows"][1]["off"] == 5e-3


def test_marginals_of_g2o_are_the_cores() -> None:
    """So the time of marginals is that of the same blocks; g2o's are in the world's axes, at its last linearisation."""
    graph = solver_graphs(7, "range")[0]
    try:
        run = cpp_g2o.optimize(graph.problem, graph.newest, 8)
    except MissingExtraError as error:
        pytest.skip(str(error))
    turn = np.zeros((15, 15))
    for k, pose in enumerate(run.poses[graph.newest]):
        turn[3 * k : 3 * k + 2, 3 * k : 3 * k + 2] = se2.rotation(pose[2])
        turn[3 * k + 2, 3 * k + 2] = 1.0
    ours = turn @ native.covariance(graph.problem, run.poses, graph.newest) @ turn.T
    assert run.covariance is not None
    np.testing.assert_allclose(run.covariance, ours, atol=1e-4 * float(np.abs(ours).max()))


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(compiled.shutil, "which", lambda _: None)
    with pytest.raises(MissingExtraError, match="compiler"):
        compiled.g2o_library(tmp_path)
    monkeypatch.setattr(compiled.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(compiled, "find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match="pip install g2opy"):
        compiled.g2o_library(tmp_path)
    assert not list(tmp_path.iterdir())
