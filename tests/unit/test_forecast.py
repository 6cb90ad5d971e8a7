"""A robot whose odometry is late is foreseen from how it has driven: how well, and how honestly."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest

from dgorl import Odometry, _core, se2
from dgorl.configuration import Motion
from dgorl.evaluation.metrics import CHI2_95_2DOF
from dgorl.se2 import Array
from dgorl.tracks import Trail, motion_values

EXACT = Motion(
    heading_per_second=0.0, heading_per_radian=0.0, heading_per_metre=0.0,
    forward_per_metre=0.0, lateral_per_metre=0.0, position_per_second=0.0,
)  # fmt: skip


def driven(twists: Sequence[tuple[float, float]], length: float = 0.5, start: float = 0.0) -> list[Odometry]:
    bounds = start + length * np.arange(len(twists) + 1)
    return [Odometry("r1", a, b, v, w) for (a, b), (v, w) in zip(itertools.pairwise(bounds), twists, strict=True)]


def trail_of(rows: Sequence[Odometry], motion: Motion = EXACT) -> Trail:
    trail = Trail("r1", motion)
    trail.add(rows)
    return trail


def ahead(trail: Trail, now: float, motion: Motion = EXACT) -> tuple[Array, Array]:
    """Motion (3,) from the newest keyframe to ``now``, and its covariance (3, 3)."""
    values, core = motion_values(motion), trail.tracks[-1].core
    poses, covariance = _core.carry([core], now, values, np.zeros((1, 3)), np.zeros((3, 3)))
    return poses[0], covariance


def test_of_a_robot_just_heard_of_the_settings_speak() -> None:
    """Last twist, errors that persist; the position shrinks towards the start as the heading spreads."""
    trail = trail_of(driven([(0.5, 0.2)] * 2))
    for age in (0.01, 0.5, 2.0, 9.0):
        pose, covariance = ahead(trail, 1.0 + age)
        assert pose[2] == pytest.approx(0.2 * age)
        assert np.sqrt(covariance[2, 2]) == pytest.approx(0.5 * age, rel=1e-3)
        assert np.hypot(*pose[:2]) <= np.hypot(*se2.exp(np.array([0.5, 0.0, 0.2]) * age)[:2])
    pose, covariance = ahead(trail, 1.01)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[:2], 0.2 * 0.01, rtol=1e-2)


def test_moments_are_those_of_sampled_motion() -> None:
    """A persisting error of a robot just heard of, its heading known no better than a radian."""
    pose, covariance = ahead(trail_of(driven([(0.5, 0.2)] * 2)), 3.0)
    rng = np.random.default_rng(0)
    twists = np.array([0.5, 0.0, 0.2]) + rng.normal(size=(100_000, 3)) * [0.2, 0.2, 0.5]
    reached = se2.exp(2.0 * twists)
    reached[:, 2] = 2.0 * twists[:, 2]
    np.testing.assert_allclose(pose, reached.mean(axis=0), atol=0.015)
    centred = reached - reached.mean(axis=0)
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(pose[2])
    np.testing.assert_allclose(turn @ covariance @ turn.T, centred.T @ centred / len(centred), atol=0.02)


@pytest.mark.parametrize("length", [0.1, 0.5, 0.7, 1.0])
@pytest.mark.parametrize("memory", [0.0, 3.0])
def test_forecasts_of_random_drivers_are_honest(length: float, memory: float) -> None:
    """Rows of any length, turns that are forgotten at once or after seconds: 95 % ellipses hold about that."""
    keep = float(np.exp(-length / memory)) if memory else 0.0
    rng, inside, total = np.random.default_rng(1), 0, 0
    for _ in range(120):
        turns = [0.0]
        for _ in range(round(44 / length)):
            turns.append(keep * turns[-1] + float(rng.normal()) * 0.5 * np.sqrt(1 - keep**2))
        rows = driven([(0.5, w) for w in turns], length)
        known = round(36 / length)
        trail, truth = trail_of(rows[:known]), trail_of(rows)
        for age in (0.5, 1.0, 2.0, 4.0):
            now = known * length + age
            pose, covariance = ahead(trail, now)
            origin = trail.tracks[0].core.newest(now)
            delta, _ = _core.odometry([truth.tracks[0].core], [origin], [truth.tracks[0].core.newest(now)])
            keyframe, offset = truth.tracks[0].core.locate(now)
            reached = se2.compose(_core.chain(np.zeros(3), delta)[-1], offset)
            assert keyframe == truth.tracks[0].core.newest(now)
            error = se2.between(pose, reached)[:2]
            inside += bool(error @ np.linalg.solve(covariance[:2, :2], error) <= CHI2_95_2DOF)
            total += 1
    assert 0.88 <= inside / total <= 0.99


def test_a_steady_robot_is_foreseen_better_than_the_settings_say() -> None:
    _, covariance = ahead(trail_of(driven([(0.3, 0.1)] * 80)), 42.0)
    assert np.sqrt(covariance[0, 0]) < 0.1 * 0.2 * 2.0
    assert np.sqrt(covariance[2, 2]) < 0.1 * 0.5 * 2.0


def test_beyond_ten_seconds_motion_limits_hold() -> None:
    trail = trail_of(driven([(0.3, 0.1)] * 2))
    (near, small), (far, large) = ahead(trail, 11.0), ahead(trail, 21.0)
    np.testing.assert_allclose(near, far)
    np.testing.assert_allclose(np.diag(large - small)[:2], 10.0**2, rtol=0.01)


def test_forecasts_depend_on_the_last_half_minute_alone() -> None:
    """Forgotten, late, duplicate and later rows leave the same bits."""
    rng = np.random.default_rng(2)
    rows = driven([(float(v), float(w)) for v, w in rng.uniform(-1, 1, (240, 2))], 0.3)
    expected = ahead(trail_of(rows[:200]), 61.0)
    forgotten = trail_of(rows[:150])
    forgotten.forget(int(2 * (61.0 - 35.0)))
    shuffled = trail_of(rows[:100])
    forgotten.add(rows[150:200])
    for k in (190, 120, 150, 101):
        shuffled.add(rows[k:200:2])
    shuffled.add(rows[100:200])
    for trail in (forgotten, shuffled):
        for a, b in zip(ahead(trail, 61.0), expected, strict=True):
            np.testing.assert_array_equal(a, b)


def test_gaps_teach_nothing() -> None:
    """A bridged gap is no sample: what is foreseen after it is as honest as before."""
    steady = driven([(0.3, 0.1)] * 40)
    gap = [*driven([(0.3, 0.1)] * 20), *driven([(0.3, 0.1)] * 18, start=11.0)]
    (pose, small), (other, large) = ahead(trail_of(steady), 21.0), ahead(trail_of(gap), 21.0)
    np.testing.assert_allclose(pose, other, atol=2e-3)
    assert 1.0 < large[2, 2] / small[2, 2] < 1.3
