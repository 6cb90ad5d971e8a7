"""The benchmarks of unknown starts count what they say they count."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from dgorl import Configuration
from dgorl.estimate import PeerHypothesis, Status
from dgorl.evaluation.records import PairRecord
from dgorl.simulation import Scenario

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
A, U, T = Status.AMBIGUOUS, Status.UNOBSERVABLE, Status.TRACKED


@pytest.fixture(scope="module")
def unknown() -> dict:
    return runpy.run_path(str(BENCHMARKS / "unknown.py"))


@pytest.fixture
def record() -> PairRecord:
    """Ambiguous, unobservable, tracked, tracked and 30 m off, tracked and 0.5 m off."""
    truth = np.tile([10.0, 0.0, 0.0], (5, 1))
    pose = truth + np.outer([8, 2, 1, 30, 0.5], [1, 0, 0])
    near = PeerHypothesis(0.3, np.array([11.0, 0, 0]), 0.01 * np.eye(3))
    far = PeerHypothesis(0.7, pose[0], 0.01 * np.eye(3))
    return PairRecord(
        "r1", "r2", 0.5 * np.arange(1, 6), pose, np.tile(np.eye(3), (5, 1, 1)), (A, U, T, T, T), np.ones(5),
        np.zeros(5), ("",) * 5, ("",) * 5, truth, {0: (far, near)},
    )  # fmt: skip


def test_a_pair_is_counted_by_hand(unknown: dict, record: PairRecord) -> None:
    limits = Configuration().status  # max(1 m, 15 % of 10 m): accuracy 1.5 m
    grid = np.array([0.5, 1.5, 2.5])
    least = np.array([np.nan, 4.0, 1.0])[:, None, None] * np.eye(3)
    found = unknown["pair"](record, limits, least, grid, {1: 0, 4: 3, 5: 4})
    assert found["alive"] == {1: True, 4: False, 5: True}
    assert (found["located"], found["wrong"], found["inside"], found["compared"]) == (3, 1, 2, 3)
    assert found["first_wrong_s"] == 2.0
    assert found["worst_m"] == 30.0
    assert found["square"] == pytest.approx(1 + 900 + 0.25)
    assert found["bound_square"] == pytest.approx(8 + 4 + 2)  # logarithms are interpolated
    assert (found["possible_s"], found["found_s"]) == (2.0, 1.5)
    assert unknown["delays"]([{"pairs": [found]}]) == [-0.5]


def test_the_right_hypothesis_needs_not_be_the_best(unknown: dict, record: PairRecord) -> None:
    assert unknown["alive"](record, 0)
    far, _ = record.hypotheses[0]
    record.hypotheses[0] = (far,)
    assert not unknown["alive"](record, 0)
    record.hypotheses[0] = (PeerHypothesis(1.0, far.pose, 4.0 * np.eye(3)),)
    assert unknown["alive"](record, 0)  # 8 m off, 5σ = 10 m


def test_nothing_is_interpolated_across_the_infinite(unknown: dict) -> None:
    grid = np.array([1.0, 2.0, 3.0, 4.0])
    values = np.array([np.nan, 1.0, 4.0, np.nan])
    found = unknown["between_stamps"](grid, values, np.array([0.5, 1.5, 2.0, 2.5, 3.0, 3.5]))
    assert found == pytest.approx([np.inf, np.inf, 1.0, 2.0, 4.0, np.inf])


def test_a_trial_with_known_starts_is_resolved_from_the_first_tick(
    unknown: dict, capsys: pytest.CaptureFixture
) -> None:
    trial = unknown["trial"]
    scenario = Scenario(robots=3, steps=60, area=20.0)
    real = trial.__globals__["replay"]
    trial.__globals__["replay"] = lambda log, configuration, initial: real(log, configuration, initial="known")
    try:
        found = trial(3, scenario, "30")
    finally:
        trial.__globals__["replay"] = real
    assert found["joined_s"] == 0.5
    assert found["together"] == {60: True}
    assert all(p["alive"][60] for p in found["pairs"])
    assert len(found["cpu_ms_joined"]) == 60
    unknown["report"]([found], [60])
    rows = capsys.readouterr().out.splitlines()
    assert "100.00" in next(row for row in rows if row.startswith("b."))
    assert float(next(row for row in rows if row.startswith("d.")).split("bound")[1].split()[0]) < 1
    assert "joined   0.5 s" in unknown["line"](found)
