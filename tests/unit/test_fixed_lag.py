"""GTSAM's fixed-lag smoother against DGORL: one optimum, one covariance, where both solve the same graph."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dgorl import se2
from dgorl.baselines.fixed_lag import FixedLagTeam, SmootherState
from dgorl.baselines.fixed_lag_readings import tangent
from dgorl.configuration import Configuration, merge
from dgorl.errors import MissingExtraError
from dgorl.estimate import Status
from dgorl.localizer import Team, TeamNow
from dgorl.logs import Log
from dgorl.measurements import WORLD, Displacement, Measurement, Range, RelativePose, known_at
from dgorl.optimization.linearization import parts
from dgorl.optimization.problem import Loss, Problem, Scalars
from dgorl.replay import known_starts
from dgorl.se2 import Array
from dgorl.simulation.recording import simulate
from dgorl.simulation.scenario import Scenario

needs_gtsam = pytest.mark.skipif(importlib.util.find_spec("gtsam") is None, reason="gtsam is not installed")

EXACT: Mapping[str, Any] = {"relinearize": 1e-6, "steps": 8}
"""iSAM2 run to convergence at every update"""
ANTENNAS = {"default": [0.2, 0.1, 0.3], "r2": [-0.3, 0.1, 0.6]}

State = SmootherState | TeamNow


def recorded(seed: int = 10001, **changes: Any) -> Log:
    options: dict[str, Any] = {"robots": 3, "steps": 24, "area": 30.0, "sensors": ("range",), "seed": seed}
    return simulate(Scenario(**(options | changes)))


def configured(log: Log, **changes: Any) -> Configuration:
    return merge(merge(Configuration(), log.configuration, "log"), changes, "test")


def fed(team: Team | FixedLagTeam, measurements: list[Measurement]) -> list[tuple[float, State]]:
    """The team's state at every half second until the last measurement."""
    waiting, states = sorted(measurements, key=known_at), []
    for k in range(int(2 * known_at(waiting[0])), int(2 * known_at(waiting[-1])) + 1):
        while waiting and known_at(waiting[0]) <= k / 2:
            team.add(waiting.pop(0))
        states.append((k / 2, team.update(k / 2)))
    return states


def measurements_of(log: Log) -> list[Measurement]:
    return [*known_starts(log), *log.measurements]


def apart(log: Log, ours: Team, theirs: FixedLagTeam) -> Array:
    """Largest differences at the last tick: position [m], heading [rad], covariance relative to its largest entry."""
    (now, mine), (_, other) = fed(ours, measurements_of(log))[-1], fed(theirs, measurements_of(log))[-1]
    found = []
    for ego in log.robots:
        a, b = ours.view(ego, mine, now), theirs.view(ego, other, now)  # type: ignore[arg-type]
        assert sorted(a) == sorted(b) == sorted({*log.robots, WORLD} - {ego})
        for peer in a:
            p, q = a[peer], b[peer]
            assert p.pose is not None
            assert q.pose is not None
            assert p.covariance is not None
            assert q.covariance is not None
            turned = abs(float(se2.wrap(p.pose[2] - q.pose[2])))
            spread = float(np.abs(p.covariance - q.covariance).max() / np.abs(p.covariance).max())
            found.append((float(np.hypot(*(p.pose - q.pose)[:2])), turned, spread))
            assert p.status == q.status
    return np.asarray(np.max(found, axis=0))


@needs_gtsam
class TestSameOptimum:
    """With a window that covers everything both solve one least-squares problem."""

    @pytest.mark.parametrize("incremental", [True, False])
    def test_ranges(self, incremental: bool) -> None:
        log = recorded()
        configuration = configured(log, window="all")
        theirs = FixedLagTeam(configuration, incremental=incremental, **EXACT)
        assert np.all(apart(log, Team(configuration), theirs) < (1e-3, 1e-4, 2e-3))

    def test_signal_strength_by_callbacks(self) -> None:
        log = recorded(sensors=("rssi",))
        configuration = configured(log, window="all")
        theirs = FixedLagTeam(configuration, rssi="callback", **EXACT)
        assert np.all(apart(log, Team(configuration), theirs) < (1e-4, 1e-5, 2e-3))

    def test_signal_strength_by_native_factors_nearly(self) -> None:
        log = recorded(sensors=("rssi",))
        configuration = configured(log, window="all")
        assert np.all(apart(log, Team(configuration), FixedLagTeam(configuration, **EXACT)) < (0.03, 1e-3, 0.01))

    def test_readings_between_keyframes_and_antennas(self) -> None:
        log = recorded(sensors=("range", "bearing"), period=0.3)
        configuration = configured(log, window="all", antennas=ANTENNAS)
        assert np.all(apart(log, Team(configuration), FixedLagTeam(configuration, **EXACT)) < (1e-3, 1e-4, 2e-3))

    def test_a_kernel_that_gtsam_does_not_have(self) -> None:
        log = recorded(sensors=("rssi",), period=0.3)
        configuration = configured(log, window="all", radio={"kernel": "huber_negative"})
        assert np.all(apart(log, Team(configuration), FixedLagTeam(configuration, **EXACT)) < (1e-3, 1e-4, 2e-3))

    @pytest.mark.parametrize("sensors", [("range",), ("rssi",)])
    def test_by_default_and_with_a_short_window_close(self, sensors: tuple[str, ...]) -> None:
        log = recorded(sensors=sensors, steps=40)
        configuration = configured(log, window=10)
        assert np.all(apart(log, Team(configuration), FixedLagTeam(configuration)) < (0.2, 0.01, 0.05))


@needs_gtsam
def test_the_window_stays_bounded_and_so_does_the_bookkeeping() -> None:
    log = recorded(steps=60)
    team = FixedLagTeam(configured(log, window=5))
    fed(team, measurements_of(log))
    chains, standing = team._additions.chains, set(team._smoother.timestamps())
    assert {key for chain in chains.values() for key in chain.keys.values()} == standing
    assert len(standing) <= 3 * 21  # at most two blocks of 5 s, ends included


@needs_gtsam
def test_a_robot_silent_for_longer_than_the_window_is_gone() -> None:
    log = recorded(steps=40)
    kept = [m for m in measurements_of(log) if not (isinstance(m, Displacement) and m.robot == "r3" and m.end > 3.0)]
    team = FixedLagTeam(configured(log, window=5, status={"age": 100.0}))
    seen = {now: team.view("r1", state, now)["r3"] for now, state in fed(team, kept) if now}  # type: ignore[arg-type]
    assert seen[8.0].pose is not None
    assert seen[20.0].status is Status.ISOLATED
    assert "longer than the window" in seen[20.0].reason


@needs_gtsam
def test_two_runs_are_the_same_bits() -> None:
    log = recorded(sensors=("rssi", "range", "bearing"), steps=40)
    states = []
    for _ in range(2):
        _, state = fed(FixedLagTeam(configured(log, window=10)), measurements_of(log))[-1]
        assert isinstance(state, SmootherState)
        states.append(state)
    assert np.array_equal(states[0].poses, states[1].poses)
    assert np.array_equal(states[0].covariance, states[1].covariance)


@needs_gtsam
def test_a_measurement_added_twice_counts_once() -> None:
    log = recorded()
    once, twice = (FixedLagTeam(configured(log)) for _ in range(2))
    _, a = fed(once, measurements_of(log))[-1]
    _, b = fed(twice, measurements_of(log) * 2)[-1]
    assert isinstance(a, SmootherState)
    assert isinstance(b, SmootherState)
    assert np.array_equal(a.poses, b.poses)


@needs_gtsam
def test_without_a_start_a_robot_is_isolated_and_a_later_one_places_it() -> None:
    log = recorded()
    starts = known_starts(log)
    truth = log.truth["r3"]
    x, y, theta = truth[13, 1:].tolist()
    late = replace(next(s for s in starts if s.robot == "r3"), stamp=6.5, x=x, y=y, theta=theta)
    rest = [*(s for s in starts if s.robot != "r3"), *log.measurements, late]
    team = FixedLagTeam(configured(log))
    states = fed(team, rest)
    seen = {now: team.view("r1", state, now)["r3"] for now, state in states if isinstance(state, SmootherState) and now}
    assert {seen[now].status for now in (1.0, 6.0)} == {Status.ISOLATED}
    assert "no start pose" in seen[6.0].reason
    assert seen[6.0].pose is None
    pose = seen[7.0].pose
    assert pose is not None
    expected = se2.between(log.truth["r1"][14, 1:], truth[14, 1:])
    assert np.hypot(*(pose - expected)[:2]) < 1.0


@needs_gtsam
def test_a_measured_pose_places_a_robot() -> None:
    covariance = (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4)
    steps = [Displacement(r, k / 2, k / 2 + 0.5, 0.5, 0.0, 0.0) for r in ("a", "b") for k in range(4)]
    start = RelativePose(WORLD, "a", 0.0, 0.0, 0.0, 0.0, covariance, prior=True)
    seen = RelativePose("a", "b", 1.0, 3.0, 4.0, 0.5, covariance)
    team = FixedLagTeam()
    now, state = fed(team, [start, *steps, seen, Range("a", "b", 1.5, 5.0, 0.1)])[-1]
    assert isinstance(state, SmootherState)
    peer = team.view("a", state, now)["b"]
    assert peer.pose is not None
    assert peer.pose[2] == pytest.approx(0.5, abs=0.02)
    expected = se2.between((1.0, 0.0, 0.0), se2.compose((3.0, 4.0, 0.5), (1.0, 0.0, 0.0)))[:2]
    assert peer.pose[:2] == pytest.approx(expected, abs=0.1)


@needs_gtsam
def test_of_a_thinning_bin_the_first_reading_counts() -> None:
    steps = [Displacement(r, k / 2, k / 2 + 0.5, 0.1, 0.0, 0.0) for r in ("a", "b") for k in range(8)]
    covariance = (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4)
    starts = [
        RelativePose(WORLD, r, 0.0, x, 0.0, 0.0, covariance, prior=True) for r, x in (("a", 0.0), ("b", 5.0))
    ]  # fmt: skip
    ranges = [Range(r, "b" if r == "a" else "a", k / 2, 5.0, 0.1) for k, r in enumerate("abababab", start=1)]
    team = FixedLagTeam(configured(recorded(), window="all", ranging={"thinning": 2.0}))
    fed(team, [*starts, *steps, *ranges])
    factors = team._smoother.getFactors()
    kinds = [type(factors.at(k)).__name__ for k in range(factors.size())]
    assert kinds.count("RangeFactorPose2") == 2  # bins (0, 2] and (2, 4]
    assert kinds.count("BetweenFactorPose2") == 16
    assert kinds.count("PriorFactorPose2") == 2


@needs_gtsam
def test_where_the_time_went() -> None:
    log = recorded(steps=6)
    team = FixedLagTeam(configured(log))
    fed(team, measurements_of(log))
    assert team.smoother_s > 0.0
    assert team.covariance_s > 0.0


@needs_gtsam
def test_now_has_to_be_a_time() -> None:
    with pytest.raises(ValueError, match="now must be a time"):
        FixedLagTeam().update(float("nan"))


@pytest.mark.parametrize("kind", ["rssi", "range"])
def test_the_tangent_has_residual_and_slope_of_the_reading(kind: str) -> None:
    generator = np.random.default_rng(7)
    poses, one = generator.uniform(-10.0, 10.0, (2, 3)), np.ones(1, np.int64)
    value = np.array([-75.0 if kind == "rssi" else 9.0])
    arms = generator.uniform(-0.5, 0.5, (2, 1, 3))
    s = Scalars(kind, 0 * one, one, arms[0], arms[1], np.array([1.5]), value, np.array([2.0]), Loss())
    empty = (0 * one[:0], 0 * one[:0], np.zeros((0, 3)), np.zeros((0, 3, 3)))
    problem = Problem(0 * np.arange(2), np.zeros(2, bool), poses, empty, (s,), radio=(-40.0, 3.0))
    measured, sigma = tangent(s, poses, (-40.0, 3.0))
    for shift in (0.0, 1e-4, -1e-4):  # [m]: beyond first order 1e-8
        moved = poses + np.array([[shift, 0.0, 0.0], [0.0, 0.0, 0.0]])
        ends = se2.compose(moved, arms[:, 0])
        plain = (np.hypot(*(ends[0] - ends[1])[:2]) - measured) / sigma
        exact = parts(problem)[-1](moved).residual[:, 0]
        assert plain == pytest.approx(exact, abs=1e-8)


def test_without_gtsam_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(MissingExtraError, match=r"-m pip install gtsam"):
        FixedLagTeam()
