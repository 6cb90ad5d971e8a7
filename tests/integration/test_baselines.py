"""The baselines on simulated teams: right ones are better than none, the same log gives the same bits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dgorl import Configuration
from dgorl.baselines import make
from dgorl.baselines.unknown import WAITING
from dgorl.configuration import merge
from dgorl.errors import DgorlError, LogError
from dgorl.estimate import Status
from dgorl.evaluation.metrics import figures, position_nees
from dgorl.evaluation.records import Records, collect
from dgorl.logs import Log
from dgorl.measurements import Displacement, Range, RelativePose, known_at
from dgorl.replay import replay
from dgorl.simulation import Scenario, simulate

FILTERS = ("dead-reckoning", "naive", "ci", "split-ci", "trn")
SEED = 20_000


@cache
def team(seed: int = SEED, **changes: object) -> Log:
    return simulate(replace(Scenario(robots=4, area=30.0, steps=50, terrain=True, seed=seed), **changes))  # type: ignore[arg-type]


def configuration(log: Log) -> Configuration:
    return merge(Configuration(), log.configuration, "test")


def run(name: str, log: Log, initial: str = "known") -> Records:
    return collect(replay(log, configuration(log), initial=initial, estimator=name), log.truth)


def rmse(records: Records) -> float:
    value = figures(records.between_robots())["all_ticks_position_rmse_m"]
    assert isinstance(value, float)
    return value


def test_readings_and_terrain_help() -> None:
    """Pooled over two teams with ranges: fusion beats dead reckoning, an altimeter besides beats fusion."""
    squares: Mapping[str, list[float]] = {name: [] for name in FILTERS}
    for seed in range(SEED, SEED + 2):
        log = team(seed, sensors=("range",))
        for name, values in squares.items():
            values.append(rmse(run(name, log)) ** 2)
    pooled = {name: float(np.sqrt(np.mean(values))) for name, values in squares.items()}
    assert pooled["naive"] < 0.8 * pooled["dead-reckoning"]
    assert pooled["split-ci"] < pooled["dead-reckoning"]
    assert pooled["split-ci"] <= pooled["ci"] * 1.02
    assert pooled["trn"] < pooled["split-ci"]


@pytest.mark.parametrize("name", ["ci", "split-ci", "trn"])
def test_intersection_claims_no_more_than_it_knows(name: str) -> None:
    inside = [position_nees(r) < 5.99 for r in run(name, team()).between_robots()]
    assert np.mean(inside) > 0.95


def test_dead_reckoning_is_odometry_from_the_start() -> None:
    """The same pose as composing the reported steps: the paper's model, x⁺ = x + vΔt cosφ."""
    log = team(motion="straight")
    records = run("dead-reckoning", log)
    record = records.pairs["r1", "r2"]
    poses = {}
    for robot in ("r1", "r2"):
        x, y, heading = log.starts[robot].pose
        way = sum(m.dx for m in log.measurements if isinstance(m, Displacement) and m.robot == robot)
        poses[robot] = np.array([x + way * np.cos(heading), y + way * np.sin(heading), heading])
    c, s = np.cos(poses["r1"][2]), np.sin(poses["r1"][2])
    expected = np.array([[c, s], [-s, c]]) @ (poses["r2"] - poses["r1"])[:2]
    np.testing.assert_allclose(record.pose[-1, :2], expected, atol=1e-6)


@pytest.mark.parametrize("name", FILTERS)
def test_the_same_bits(name: str) -> None:
    first, second = (run(name, team(steps=10)) for _ in range(2))
    for pair, record in first.pairs.items():
        np.testing.assert_array_equal(record.pose, second.pairs[pair].pose)
        np.testing.assert_array_equal(record.covariance, second.pairs[pair].covariance)


@pytest.mark.parametrize("name", ["dead-reckoning", "split-ci"])
def test_unknown_starts_are_dgorls_first_tracked_poses(name: str) -> None:
    log = team(sensors=("range", "bearing"))
    ours, theirs = run("dgorl", log, "unknown"), run(name, log, "unknown")
    tracked = np.all([ours.pairs["r1", peer].having(Status.TRACKED) for peer in ("r2", "r3", "r4")], axis=0)
    first = int(np.argmax(tracked))
    assert tracked[first]
    assert 0 < first < len(tracked) - 5
    assert "world" not in theirs.of("r1")
    assert ("r1", "world") not in theirs.pairs
    for peer in ("r2", "r3", "r4"):
        record = theirs.pairs["r1", peer]
        assert set(record.reason[:first]) == {WAITING}
        assert record.having(Status.ISOLATED)[:first].all()
        np.testing.assert_allclose(record.pose[first], ours.pairs["r1", peer].pose[first], atol=1e-6)
        assert np.isfinite(record.pose[first:]).all()


def test_what_starts_share_only_widens() -> None:
    """The stated start covariance is DGORL's own, but for the millimetre the frame is known to."""
    log = team(sensors=("range", "bearing"))
    ours, theirs = run("dgorl", log, "unknown"), run("dead-reckoning", log, "unknown")
    record, start = theirs.pairs["r1", "r3"], ours.pairs["r1", "r3"]
    first = int(np.argmax(np.isfinite(record.pose[:, 0])))
    np.testing.assert_allclose(record.covariance[first], start.covariance[first], rtol=0.02, atol=1e-3)


def test_readings_between_ticks_count_at_their_own_time() -> None:
    """A tick of 0.5 s or of 2 s: the same readings, the same poses where both have a tick."""
    log = team(sensors=("range",), steps=24)
    fine = configuration(log)
    coarse = replace(fine, period=2.0)
    a = collect(replay(log, fine, estimator="split-ci"), log.truth).pairs["r1", "r2"]
    b = collect(replay(log, coarse, estimator="split-ci"), log.truth).pairs["r1", "r2"]
    common = np.isin(a.t, b.t)
    assert common.sum() == len(b.t) == 6
    np.testing.assert_allclose(a.pose[common], b.pose, atol=1e-9)


def test_a_reading_that_comes_late_still_counts() -> None:
    """Known 1 s after its stamp, when the filter is two keyframes further: it moves the estimate where it should."""
    log = team(sensors=("range",), steps=24)
    last = max(m.stamp for m in log.measurements if isinstance(m, Range))
    kept = [m for m in log.measurements if not isinstance(m, Range) or m.stamp == last - 1.0]
    poses = {}
    for late in (False, True, None):
        estimator = make("naive", log, configuration(log))
        waiting = sorted(kept, key=lambda m: known_at(m) + bool(late) * isinstance(m, Range))
        for start in log.starts:
            x, y, theta = log.starts[start].pose
            p = (0.04, 0.0, 0.0, 0.04, 0.0, 0.01)
            estimator.add(RelativePose("world", start, 0.0, x, y, theta, p, prior=True))
        for k in range(1, 25):
            while waiting and known_at(waiting[0]) + bool(late) * isinstance(waiting[0], Range) <= 0.5 * k:
                measurement = waiting.pop(0)
                if late is not None or not isinstance(measurement, Range):
                    estimator.add(measurement)
            state = estimator.update(0.5 * k)
        pose = estimator.view("r1", state, 12.0)["r2"].pose
        assert pose is not None
        poses[late] = pose
    np.testing.assert_allclose(poses[True], poses[False], atol=0.25 * np.abs(poses[None] - poses[False]).max())


def test_inputs_that_are_missing() -> None:
    log = team(steps=4)
    settings = configuration(log)
    with pytest.raises(LogError, match=r"trn needs an elevation map, terrain\.npz"):
        make("trn", replace(log, terrain=None), settings)
    with pytest.raises(LogError, match=r"trn needs altitudes, altitude\.csv"):
        make("trn", replace(log, altitudes=()), settings)
    with pytest.raises(DgorlError, match="trn needs `--initial known`"):
        make("trn", log, settings, initial="unknown")
    with pytest.raises(DgorlError, match="no start pose for r1"):
        replay(replace(log, starts={}), settings, estimator="ci")
    with pytest.raises(DgorlError, match="no estimator is called `splitci`; did you mean `split-ci`"):
        make("splitci", log, settings)


def test_our_own_estimator_never_sees_the_terrain() -> None:
    log = team(steps=20)
    bare = replace(log, terrain=None, altitudes=())
    with_it, without = run("dgorl", log), run("dgorl", bare)
    for pair, record in with_it.pairs.items():
        np.testing.assert_array_equal(record.pose, without.pairs[pair].pose)
