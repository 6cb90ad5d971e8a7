"""Odd logs: empty, alone, silent, standing, on one spot, gaps, new epochs. Nothing crashes, nothing is claimed."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import Configuration, Displacement, Localizer, Odometry, Range, RelativePose, Rssi, Status, se2
from dgorl.measurements import WORLD
from dgorl.places import MISSED

TWIST = np.array([0.5, 0.0, 0.2])
"""how all drive, x, y, turn a second"""

PRIOR = (0.0025, 0.0, 0.0, 0.0025, 0.0, 0.0003)


def start(robot, x, y, theta, stamp=0.0, covariance=PRIOR):
    return RelativePose(WORLD, robot, stamp, x, y, theta, covariance, prior=True)


def drive(robot, begin, end, v=0.5, omega=0.2, epoch=0):
    return [Odometry(robot, k / 2, (k + 1) / 2, v, omega, epoch) for k in range(int(2 * begin), int(2 * end))]


def ranges(a, b, begin, end, distance, step=0.5):
    return [Range(a, b, t, distance, 0.1) for t in np.arange(begin, end + 1e-9, step)]


def localizer_with(robot, measurements, **configuration):
    localizer = Localizer(robot, Configuration(**configuration))
    for measurement in measurements:
        localizer.add(measurement)
    return localizer


def test_nothing_known():
    assert dict(Localizer("r1").update(10.0)) == {}
    assert Localizer("r1").update(10.0).graph.edges == ()


def test_one_robot_knows_only_the_world():
    estimate = localizer_with("r1", [start("r1", 1.0, 2.0, 0.0), *drive("r1", 0, 10, omega=0.0)]).update(10.0)
    assert list(estimate) == [WORLD]
    np.testing.assert_allclose(se2.inverse(estimate[WORLD].pose), [6.0, 2.0, 0.0], atol=1e-6)


def test_without_starts_peers_are_ambiguous_with_their_places_or_isolated_without_a_pose():
    odometry = [*drive("r1", 0, 10), *drive("r2", 0, 10), *drive("r3", 0, 10)]
    estimate = localizer_with("r1", [*odometry, *ranges("r1", "r2", 0.5, 10, 4.0)]).update(10.0)
    assert estimate["r2"].status == Status.AMBIGUOUS
    assert estimate["r3"].status == Status.ISOLATED
    places = estimate["r2"].hypotheses
    assert len(places) > 1
    assert sum(place.probability for place in places) == pytest.approx(1.0 - MISSED)
    np.testing.assert_array_equal(estimate["r2"].pose, places[0].pose)
    assert estimate["r3"].pose is None
    for peer in ("r2", "r3"):
        assert estimate[peer].reason
        assert estimate[peer].resolve_by


def test_without_ranges_known_starts_fade_into_unobservable():
    starts = [start("r1", 0, 0, 0), start("r2", 3, 0, 0)]
    localizer = localizer_with("r1", [*starts, *drive("r1", 0, 900), *drive("r2", 0, 900)], history=1000)
    statuses = [localizer.update(t)["r2"].status for t in (5.0, 900.0)]
    assert statuses == [Status.TRACKED, Status.UNOBSERVABLE]
    assert "exceeds" in localizer.update(900.0)["r2"].reason


@pytest.mark.parametrize("window", [30.0, "all"])
def test_a_silent_peer_ages_then_is_isolated_and_its_return_is_not_guessed(window):
    measurements = [start("r1", 0, 0, 0), start("r2", 3, 0, 0), *drive("r1", 0, 240)]
    measurements += [*drive("r2", 0, 20), *drive("r2", 200, 240), *ranges("r1", "r2", 0.5, 20, 3.0)]
    measurements += ranges("r1", "r2", 200.5, 240, 3.0)
    localizer = localizer_with("r1", measurements, window=window)
    young, late, gone, back = (localizer.update(t)["r2"] for t in (20.0, 25.0, 60.0, 230.0))
    assert young.status == Status.TRACKED
    assert late.age == pytest.approx(5.0)
    assert late.pose is not None
    assert np.trace(late.covariance) > 2 * np.trace(young.covariance)  # it has driven alike for 20 s
    assert gone.status == Status.ISOLATED
    assert gone.pose is None
    assert back.status == Status.AMBIGUOUS


def test_a_short_gap_is_bridged_with_the_motion_limits():
    """20 s without odometry: tracked through it, the uncertainty grows, ranges bring it back."""
    measurements = [start("r1", 0, 0, 0), start("r2", 3, 0, 0), start("r3", 0, 3, 0)]
    for robot in ("r1", "r3"):
        measurements += drive(robot, 0, 60, v=0.0, omega=0.0)
    measurements += drive("r2", 0, 20, v=0.0, omega=0.0) + drive("r2", 40, 60, v=0.0, omega=0.0)
    measurements += ranges("r1", "r2", 0.5, 60, 3.0) + ranges("r3", "r2", 0.5, 60, np.hypot(3, 3))
    localizer = localizer_with("r1", measurements)
    before, after = (localizer.update(t)["r2"] for t in (20.0, 60.0))
    assert before.status == Status.TRACKED
    np.testing.assert_allclose(after.pose[:2], [3.0, 0.0], atol=0.3)
    assert after.covariance[2, 2] > 100 * before.covariance[2, 2]


def test_a_new_epoch_forgets_where_the_robot_was():
    odometry = [*drive("r1", 0, 40), *drive("r2", 0, 20), *drive("r2", 20, 40, epoch=1)]
    starts = [start("r1", 0, 0, 0), start("r2", 3, 0, 0)]
    contact = ranges("r1", "r2", 0.5, 40, 3.0)
    localizer = localizer_with("r1", [*starts, *odometry, *contact])
    assert localizer.update(20.0)["r2"].status == Status.TRACKED
    assert localizer.update(25.0)["r2"].status == Status.AMBIGUOUS
    x, y, theta = se2.compose([3.0, 0.0, 0.0], se2.exp(20.0 * TWIST)).tolist()  # as far from r1 as the ranges say
    localizer.add(start("r2", x, y, theta, stamp=20.0))
    assert localizer.update(25.5)["r2"].status == Status.TRACKED


def test_a_robot_that_never_moves_is_located():
    vague = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    measurements = [start("r1", 0, 0, 0), start("r2", 2.5, 0.5, 0, covariance=vague)]
    measurements += drive("r1", 0, 40, v=0.5, omega=0.25)
    measurements += drive("r2", 0, 40, v=0.0, omega=0.0)
    t = np.arange(0.5, 40.1, 0.5)
    r1 = np.stack([2 * np.sin(0.25 * t), 2 - 2 * np.cos(0.25 * t)], axis=1)
    measurements += [Range("r1", "r2", s, float(np.hypot(*(p - [3.0, 0.0]))), 0.1) for s, p in zip(t, r1, strict=True)]
    estimate = localizer_with("r1", measurements).update(40.0)
    expected = se2.between([*r1[-1], 10.0], [3.0, 0.0, 0.0])
    np.testing.assert_allclose(estimate["r2"].pose[:2], expected[:2], atol=0.1)
    assert estimate["r2"].status == Status.POSITION  # ranges do not tell where a standing robot looks


def test_two_robots_on_one_spot():
    measurements = [start("r1", 0, 0, 0), start("r2", 0, 0, 0)]
    measurements += drive("r1", 0, 30, v=0, omega=0) + drive("r2", 0, 30, v=0, omega=0)
    measurements += [Range("r1", "r2", k / 2, 0.0, 0.1) for k in range(1, 61)]
    measurements += [Rssi("r1", "r2", k / 2, -10.0) for k in range(1, 61)]
    localizer = localizer_with("r1", measurements)
    for now in np.arange(0.5, 30.5, 0.5):
        estimate = localizer.update(float(now))["r2"]
        assert np.isfinite(estimate.pose).all()
        assert np.isfinite(estimate.covariance).all()
        assert np.hypot(*estimate.pose[:2]) < 0.3


def test_measurements_without_odometry_wait_for_it():
    localizer = localizer_with("r1", [start("r1", 0, 0, 0), start("r2", 3, 0, 0), *ranges("r1", "r2", 0.5, 5, 3.0)])
    before = localizer.update(5.0)
    assert list(before) == ["r2"]
    assert before["r2"].status == Status.ISOLATED
    assert before["r2"].pose is None
    for measurement in [*drive("r1", 0, 5), *drive("r2", 0, 5)]:
        localizer.add(measurement)
    assert localizer.update(5.0)["r2"].status == Status.TRACKED


def test_overlapping_and_touching_odometry_is_counted_once():
    whole = [Displacement("r1", k / 2, (k + 1) / 2, 0.25, 0.0, 0.0) for k in range(20)]
    doubled = whole + [Displacement("r1", k / 2 + 0.1, (k + 1) / 2, 0.2, 0.0, 0.0) for k in range(20)]
    poses = []
    for odometry in (whole, doubled):
        estimate = localizer_with("r1", [start("r1", 0, 0, 0), *odometry]).update(10.0)
        poses.append(se2.inverse(estimate[WORLD].pose))
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-9)
    np.testing.assert_allclose(poses[0], [5.0, 0.0, 0.0], atol=1e-6)


def test_antennas_are_lever_arms_and_heights():
    """Ranges between antennas 1 m ahead and 3 m apart in height place the robots' bodies."""
    antennas = {"r1": (1.0, 0.0, 0.0), "r2": (0.0, 0.0, 3.0)}
    measurements = [start("r1", 0, 0, 0), start("r2", 5.0, 0.0, 0)]
    measurements += drive("r1", 0, 20, 0, 0) + drive("r2", 0, 20, 0, 0) + ranges("r1", "r2", 0.5, 20, 5.0)
    estimate = localizer_with("r1", measurements, antennas=antennas).update(20.0)
    np.testing.assert_allclose(estimate["r2"].pose[:2], [5.0, 0.0], atol=1e-3)


def test_a_relative_pose_joins_a_robot_without_a_start():
    measurements = [start("r1", 0, 0, 0), *drive("r1", 0, 20), *drive("r2", 0, 20)]
    seen = RelativePose("r1", "r2", 10.0, 2.0, 1.0, 0.5, PRIOR)
    localizer = localizer_with("r1", [*measurements, seen, *ranges("r1", "r2", 0.5, 20, 3.0)])
    assert localizer.update(9.5)["r2"].status == Status.AMBIGUOUS
    assert localizer.update(10.0)["r2"].status == Status.TRACKED
    np.testing.assert_allclose(localizer.update(10.0)["r2"].pose, [2.0, 1.0, 0.5], atol=0.6)


def test_members_leave_one_after_the_other():
    """The reference of the prior goes silent first; the others go on without it."""
    measurements = [start(f"r{k}", 2.0 * k, 0, 0) for k in (1, 2, 3)]
    measurements += drive("r1", 0, 30, 0, 0) + drive("r2", 0, 90, 0, 0) + drive("r3", 0, 120, 0, 0)
    measurements += ranges("r1", "r2", 0.5, 30, 2.0) + ranges("r2", "r3", 0.5, 90, 2.0)
    localizer = localizer_with("r3", measurements)
    poses = [localizer.update(t)["r2"] for t in (30.0, 60.0, 90.0)]
    assert [p.status for p in poses] == [Status.TRACKED] * 3
    assert localizer.update(85.0)["r1"].status == Status.ISOLATED
    assert localizer.update(120.0)["r2"].status == Status.ISOLATED
