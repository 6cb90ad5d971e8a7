"""Records and metrics against cases worked out by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from dgorl.estimate import Estimate, OptimizedGraph, PeerEstimate, PeerHypothesis, Status
from dgorl.evaluation import metrics
from dgorl.evaluation.records import PairRecord, Records, collect, truth_at
from dgorl.measurements import WORLD

T, P, U, I = Status.TRACKED, Status.POSITION, Status.UNOBSERVABLE, Status.ISOLATED  # noqa: E741


def record(
    errors: Sequence[tuple[float, float, float]],
    status: Sequence[Status],
    variance: float = 1.0,
    **changes: Any,
) -> PairRecord:
    n = len(errors)
    truth = np.tile([3.0, -2.0, 3.1], (n, 1))
    pose = truth + np.array(errors)
    pose[[s is I for s in status]] = np.nan
    values: dict[str, Any] = {
        "ego": "a", "peer": "b", "t": 10 + 0.5 * np.arange(n), "pose": pose,
        "covariance": np.tile(variance * np.eye(3), (n, 1, 1)), "status": tuple(status),
        "probability": np.ones(n), "age": np.zeros(n), "reason": ("",) * n, "resolve_by": ("",) * n,
        "truth": truth,
    }  # fmt: skip
    return PairRecord(**values | changes)


def test_figures_count_the_ticks_they_say() -> None:
    r = record(
        [(9, 9, 9), (8, 6, 0), (0, 2, 1.0), (3, 0, 0.5), (0, 1, -0.5), (0, 0, 0.5)],
        [I, U, P, T, T, T],
    )
    f = metrics.figures([r])
    assert f["position_rmse_m"] == pytest.approx(np.sqrt((4 + 9 + 1 + 0) / 4))
    assert f["position_median_m"] == pytest.approx(1.5)
    assert f["heading_rmse_deg"] == pytest.approx(np.degrees(0.5))
    assert f["all_ticks_position_rmse_m"] == pytest.approx(np.sqrt((100 + 4 + 9 + 1 + 0) / 5))
    assert f["all_ticks_heading_rmse_deg"] == pytest.approx(np.degrees(np.sqrt((0 + 1 + 0.75) / 5)))
    assert f["tracked_fraction"] == pytest.approx(4 / 6)
    assert f["wrong_fraction"] == pytest.approx(2 / 4)
    assert f["coverage_95"] == pytest.approx(3 / 4)  # 9 > 5.99
    assert f["nees_mean"] == pytest.approx((9.25 + 1.25 + 0.25) / 3)
    assert f["nees_median"] == pytest.approx(1.25)
    assert metrics.time_to_track(r) == 1.0


def test_heading_error_wraps() -> None:
    r = record([(0, 0, 2 * np.pi - 0.1)], [T])
    assert metrics.heading_error(r) == pytest.approx([-0.1])


def test_position_error_is_in_the_ego_frame() -> None:
    """Two robots, the ego turned by 90°: its estimate and truth differ by a vector in its own axes."""
    truth = {"a": np.array([[0.0, 0, 0, np.pi / 2]]), "b": np.array([[0.0, 0, 5, 0]])}
    seen = PeerEstimate(np.array([5.5, 0.25, -np.pi / 2]), np.eye(3), T, 1.0, 0.0)
    r = collect([tick(0.0, {"a": {"b": seen}})], truth).pairs["a", "b"]
    assert r.truth[0] == pytest.approx([5, 0, -np.pi / 2])
    assert metrics.position_error(r)[0] == pytest.approx([0.5, 0.25])


def test_errors_pool_over_pairs_not_over_their_means() -> None:
    one, other = record([(1, 0, 0)] * 3, [T] * 3), record([(3, 0, 0)], [T])
    assert metrics.figures([one, other])["position_rmse_m"] == pytest.approx(np.sqrt((3 + 9) / 4))


def test_without_truth_only_status_is_known() -> None:
    r = record([(0, 0, 0)] * 4, [T, T, P, U], truth=np.full((4, 3), np.nan))
    f = metrics.figures([r])
    assert f.pop("tracked_fraction") == 0.75
    assert f.pop("truth_fraction") == 0.0
    assert set(f.values()) == {None}


def test_nothing_located_gives_none() -> None:
    f = metrics.figures([record([(1, 0, 0)], [U])])
    assert (f["position_rmse_m"], f["tracked_fraction"], f["coverage_95"]) == (None, 0.0, None)
    assert f["all_ticks_position_rmse_m"] == 1.0
    assert metrics.time_to_track(record([(1, 0, 0)], [U])) is None
    assert set(metrics.figures([]).values()) == {None}


def test_nees_uses_the_whole_covariance() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    covariance, error = root @ root.T, np.array([0.3, -0.2, 0.1])
    r = record([tuple(error)], [T], covariance=covariance[None])
    assert metrics.nees(r) == pytest.approx([error @ np.linalg.inv(covariance) @ error])
    assert metrics.position_nees(r) == pytest.approx([error[:2] @ np.linalg.inv(covariance[:2, :2]) @ error[:2]])


def test_bound_is_the_larger_half_axis_of_the_ellipse() -> None:
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = np.eye(3)
    covariance[:2, :2] = turn @ np.diag([4.0, 0.25]) @ turn.T
    r = record([(0, 0, 0)], [T], covariance=covariance[None])
    assert metrics.bound_95(r) == pytest.approx([2 * np.sqrt(stats.chi2.ppf(0.95, 2))])


def test_constant_is_the_quantile() -> None:
    assert pytest.approx(stats.chi2.ppf(0.95, 2)) == metrics.CHI2_95_2DOF


@pytest.mark.parametrize("count", [3, 12, 60, 1000])
@pytest.mark.parametrize("level", [0.9, 0.95])
def test_band_of_the_mean_nees(count: int, level: float) -> None:
    low, high = metrics.nees_band(count, 3, level)
    tail = (1 - level) / 2
    assert low == pytest.approx(stats.chi2.ppf(tail, 3 * count) / count, rel=0.01)
    assert high == pytest.approx(stats.chi2.ppf(1 - tail, 3 * count) / count, rel=0.01)


def test_nees_per_tick_takes_the_tracked_pairs() -> None:
    one = record([(1, 0, 0), (2, 0, 0), (5, 0, 0)], [T, T, U])
    other = record([(0, 0, 0), (9, 0, 0), (9, 0, 0)], [T, P, P])
    t, mean, count = metrics.nees_per_tick([one, other])
    assert t.tolist() == [10.0, 10.5]
    assert mean == pytest.approx([0.5, 4.0])
    assert count.tolist() == [2, 1]
    assert len(metrics.nees_per_tick([])[0]) == 0


def test_predicted_over_measured() -> None:
    r = record([(3, 4, 0), (0, 5, 0)], [T, P], variance=0.5)
    assert metrics.predicted_over_measured([r]) == pytest.approx(1 / 5)
    assert metrics.predicted_over_measured([record([(1, 0, 0)], [U])]) is None


def test_bootstrap_resamples_whole_trials() -> None:
    alike = [np.array([1.0, 9.0]), np.array([9.0, 1.0])]
    assert metrics.bootstrap_rmse(alike) == pytest.approx((np.sqrt(5), np.sqrt(5)))
    rng = np.random.default_rng(0)
    trials = [rng.normal(size=40) ** 2 * rng.uniform(0.5, 2) for _ in range(30)]
    low, high = metrics.bootstrap_rmse(trials)
    assert low < np.sqrt(np.mean(np.concatenate(trials))) < high
    assert metrics.bootstrap_rmse(trials) == (low, high)
    assert metrics.bootstrap_rmse([np.array([]), np.array([4.0])]) == (2.0, 2.0)


def test_truth_is_interpolated_on_the_circle_and_not_across_gaps() -> None:
    rows = np.array([[0, 0, 0, 3.0], [1, 2, 0, -3.0], [3, 2, 4, 0.0]])
    at = np.array([-0.5, 0.0, 0.5, 1.0, 2.0, 3.0, 3.5])
    pose = truth_at({"a": rows}, "a", at)
    assert np.isnan(pose[[0, 4, 6]]).all()
    assert pose[1] == pytest.approx([0, 0, 3.0])
    assert pose[2, :2] == pytest.approx([1, 0])
    assert np.cos(pose[2, 2]) == pytest.approx(-1)
    assert pose[3] == pytest.approx([2, 0, -3.0])
    assert pose[5] == pytest.approx([2, 4, 0.0])


def test_truth_of_the_world_and_of_strangers() -> None:
    t = np.array([0.0, 1.0])
    assert truth_at({}, WORLD, t).tolist() == [[0, 0, 0], [0, 0, 0]]
    assert np.isnan(truth_at({}, "a", t)).all()
    one = truth_at({"a": np.array([[1.0, 5, 6, 0]])}, "a", t)
    assert np.isnan(one[0]).all()
    assert one[1].tolist() == [5, 6, 0]


def test_a_peer_not_heard_of_yet_has_isolated_rows() -> None:
    here = PeerEstimate(np.array([1.0, 0, 0]), np.eye(3), T, 1.0, 0.0)
    r = collect([tick(0.0, {"a": {}}), tick(0.5, {"a": {"b": here}})], {}).pairs["a", "b"]
    assert r.t.tolist() == [0.0, 0.5]
    assert r.status == (I, T)
    assert np.isnan(r.pose[0]).all()
    assert r.reason[0] == "nothing heard yet"
    assert metrics.time_to_track(r) == 0.5


def test_the_summary_says_how_it_ended_and_why() -> None:
    lost = PeerEstimate(None, None, I, 0.0, 12.0, "no odometry from b for 12 s", "restore the link")
    ticks = [tick(0.5 * k, {"a": {"b": lost}}) for k in range(2)]
    seen = metrics.summarize(collect(iter(ticks), {}))["egos"]["a"]["peers"]["b"]
    assert (seen["status"], seen["reason"], seen["resolve_by"]) == ("isolated", lost.reason, lost.resolve_by)
    assert seen["time_to_track_s"] is None


def test_hypotheses_are_kept_by_tick() -> None:
    places = tuple(PeerHypothesis(p, np.array([x, 0, 0]), np.eye(3)) for p, x in ((0.7, 1.0), (0.3, 2.0)))
    unsure = PeerEstimate(places[0].pose, np.eye(3), Status.AMBIGUOUS, 0.7, 0.0, hypotheses=places)
    here = PeerEstimate(np.array([1.0, 0, 0]), np.eye(3), T, 1.0, 0.0)
    record = collect([tick(0.5 * k, {"a": {"b": seen}}) for k, seen in enumerate((here, unsure))], {}).pairs["a", "b"]
    assert record.hypotheses == {1: places}
    assert not record.located[1]
    assert record.pose[1, 0] == 1.0


def test_summary_leaves_the_world_out() -> None:
    here = PeerEstimate(np.array([1.0, 0, 0]), np.eye(3), T, 1.0, 0.0)
    gone = PeerEstimate(None, None, I, 0.0, np.inf, "nothing heard", "come closer")
    ticks = [tick(0.5 * k, {"a": {"b": here if k else gone, WORLD: here}}) for k in range(4)]
    truth = {"a": np.array([[0.0, 0, 0, 0], [1.0, 0, 0, 0]]), "b": np.array([[0.0, 1, 0, 0], [1.0, 1, 0, 0]])}
    records: Records = collect(iter(ticks), truth)
    summary = metrics.summarize(records)
    assert summary["ticks"] == 4
    assert list(summary["egos"]) == ["a"]
    assert list(summary["egos"]["a"]["peers"]) == ["b"]
    seen = summary["egos"]["a"]["peers"]["b"]
    assert seen["time_to_track_s"] == 0.5
    assert (seen["status"], seen["reason"], seen["resolve_by"]) == ("tracked", "", "")
    assert seen["truth_fraction"] == 0.75
    assert summary["egos"]["a"]["tick_ms"] == pytest.approx({"median": 2.0, "p99": 2.0})
    assert summary["egos"]["a"]["rejected"] == {"too late": 2}
    assert summary["team"]["position_rmse_m"] == 0.0
    assert summary["team"]["tracked_fraction"] == 0.75


def tick(stamp: float, seen: Mapping[str, Mapping[str, PeerEstimate]]) -> Any:
    nothing = OptimizedGraph({}, (), np.zeros((0, 0)))
    estimates = {ego: Estimate(ego, stamp, peers, {"too late": 2}, lambda: nothing) for ego, peers in seen.items()}
    return SimpleNamespace(stamp=stamp, estimates=estimates, cpu_s=dict.fromkeys(seen, 0.002))
