"""Whatever a peer sends, as long as it is a measurement: update answers, soon, and says nothing that is not finite."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from dgorl import Bearing, Configuration, Displacement, Localizer, Odometry, Range, RelativePose, Rssi
from dgorl.configuration import Motion
from dgorl.crowds import PER_PAIR
from dgorl.errors import MeasurementError
from dgorl.measurements import LARGEST, WORLD
from tests.integration.test_edges import PRIOR, drive, ranges, start

ROBOTS = st.sampled_from(["r1", "r2", "r3"])
PAIRS = st.permutations(["r1", "r2", "r3"]).map(lambda names: names[:2])
STAMPS = st.one_of(st.floats(-5, 45), st.floats(-LARGEST, LARGEST))
ANY = st.one_of(st.floats(-10, 10), st.floats(-LARGEST, LARGEST))
SIGMAS = st.one_of(st.none(), st.floats(1e-6, 10), st.floats(1e-6, LARGEST))
COVARIANCES = st.tuples(*[st.floats(1e-12, LARGEST)] * 3).map(lambda v: (v[0], 0.0, 0.0, v[1], 0.0, v[2]))


def anything():
    span = st.tuples(STAMPS, st.floats(1e-3, 60))
    return st.one_of(
        st.builds(lambda r, s, v, w, e: ("o", r, s, v, w, e), ROBOTS, span, ANY, ANY, st.integers(0, 2)),
        st.builds(lambda r, s, x, y, t, c: ("d", r, s, x, y, t, c), ROBOTS, span, ANY, ANY, ANY, COVARIANCES),
        st.builds(lambda p, s, v: ("s", p, s, v), PAIRS, STAMPS, ANY),
        st.builds(lambda p, s, v, g: ("r", p, s, abs(v), g), PAIRS, STAMPS, ANY, SIGMAS),
        st.builds(lambda p, s, v, g: ("b", p, s, v, g), PAIRS, STAMPS, ANY, SIGMAS),
        st.builds(lambda p, s, x, y, t, c: ("p", p, s, x, y, t, c), PAIRS, STAMPS, ANY, ANY, ANY, COVARIANCES),
    )


def made(what):
    kind, who, when, *rest = what
    if kind in "od":
        begin, duration = when
        if kind == "o":
            return Odometry(who, begin, begin + duration, *rest)
        return Displacement(who, begin, begin + duration, *rest)
    make = {"s": Rssi, "r": Range, "b": Bearing, "p": RelativePose}[kind]
    return make(*who, when, *rest)


@hypothesis_settings(
    deadline=None, max_examples=100, suppress_health_check=[HealthCheck.too_slow], phases=[Phase.reuse, Phase.generate]
)
@given(st.lists(anything(), max_size=12))
def test_update_answers_whatever_arrives(hostile):
    localizer = Localizer("r1")
    for robot, x in (("r1", 0.0), ("r2", 3.0), ("r3", 5.0)):
        localizer.add(start(robot, x, 0.0, 0.0))
        for odometry in drive(robot, 0, 40):
            localizer.add(odometry)
    for measurement in ranges("r1", "r2", 0.5, 40, 3.0):
        localizer.add(measurement)
    for what in hostile:
        try:
            localizer.add(made(what))
        except MeasurementError:
            continue
    for now in (10.0, 25.0, 40.0):
        for peer in localizer.update(now).values():
            assert peer.pose is None or np.isfinite(peer.pose).all()
            assert peer.covariance is None or np.isfinite(peer.covariance).all()


@pytest.mark.parametrize("window", [30.0, "all"])
def test_a_clock_that_jumps_costs_no_time(window):
    """A computer without a battery starts in 1970 and then learns the date."""
    localizer = Localizer("r1", Configuration(window=window))
    for robot in ("r1", "r2"):
        localizer.add(start(robot, 0.0 if robot == "r1" else 3.0, 0.0, 0.0))
        for odometry in drive(robot, 0, 20):
            localizer.add(odometry)
    assert localizer.update(20.0)["r2"].pose is not None
    today = 1.7e9
    for robot in ("r1", "r2"):
        for odometry in drive(robot, today, today + 20):
            localizer.add(odometry)
        localizer.add(start(robot, 0.0 if robot == "r1" else 3.0, 0.0, 0.0, stamp=today))
    began = time.process_time()
    peer = localizer.update(today + 20.0)["r2"]
    assert time.process_time() - began < 5.0
    np.testing.assert_allclose(peer.pose[:2] ** 2 @ [1, 1], 9.0, rtol=0.05)


@pytest.mark.parametrize("window", [30.0, "all"])
@pytest.mark.parametrize("silence", [22.0, 380.0])
def test_a_quiet_stretch_gives_the_same_as_nodes_one_by_one(window, silence):
    measurements = [start("r1", 0, 0, 0), start("r2", 3, 0, 0), *drive("r1", 0, 20), *drive("r2", 0, 20)]
    back = 20.0 + silence
    again = [start("r1", 0, 0, 0, back), start("r2", 4, 0, 0, back)]
    again += [*drive("r1", back, back + 30), *drive("r2", back, back + 30)]
    found = []
    for asked in ((back + 30,), np.arange(1.0, back + 30.5, 1.0)):
        localizer = Localizer("r1", Configuration(history=1000, window=window))
        for measurement in (*measurements, *again):
            localizer.add(measurement)
        for now in asked:
            estimate = localizer.update(float(now))
        found.append(estimate["r2"])
    np.testing.assert_array_equal(found[0].pose, found[1].pose)
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)


def test_odometry_without_any_noise_is_no_singularity():
    silent = {f"{name}": 0.0 for name in vars(Motion()) if "_per_" in name}
    localizer = Localizer("r1", Configuration(motion=Motion(**silent)))
    for measurement in [start("r1", 0, 0, 0), start("r2", 3, 0, 0), *drive("r1", 0, 10), *drive("r2", 0, 10)]:
        localizer.add(measurement)
    estimate = localizer.update(10.0)
    np.testing.assert_allclose(np.hypot(*estimate["r2"].pose[:2]), 3.0, atol=1e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Odometry("r1", 1.7e18, 1.7e18 + 1e9, 0.5, 0.0), "start must be within"),
        (lambda: Odometry("r1", 0.0, 3600.0, 0.5, 0.0), "odometry over 3600 s at once"),
        (lambda: Range("r1", "r2", 0.0, 1.0, 1e-9), "sigma must be at least"),
        (lambda: RelativePose(WORLD, "r1", 0, 0, 0, 0, (1e-30, 0, 0, 1, 0, 1), prior=True), "variances must be"),
        (lambda: RelativePose("r1", WORLD, 0, 0, 0, 0, PRIOR), "the world has no pose"),
        (lambda: RelativePose(WORLD, "r1", 0, 0, 0, 0, PRIOR), "only a prior"),
    ],
)
def test_values_that_cannot_be_true_are_refused(make, message):
    with pytest.raises(MeasurementError, match=message):
        make()


@pytest.mark.parametrize("now", [float("nan"), float("inf"), 1.7e18])
def test_now_is_a_time(now):
    with pytest.raises(ValueError, match="now must be a time"):
        Localizer("r1").update(now)


@pytest.mark.parametrize("exchange", [False, True])
def test_a_thousand_readings_a_second_weigh_as_fifty_whatever_their_order(exchange):
    """A member says a thousand times how far it is; who hears it in another order estimates the same to the bit."""

    def told(order: list[int]) -> tuple[Localizer, list[bytes]]:
        localizer = Localizer("r1")
        for robot, x in (("r1", 0.0), ("r2", 3.0), ("r3", 5.0)):
            localizer.add(start(robot, x, 0.0, 0.0))
            for odometry in drive(robot, 0, 12):
                localizer.add(odometry)
        for measurement in (*ranges("r1", "r2", 0.5, 12, 3.0), *ranges("r1", "r3", 0.5, 12, 5.0)):
            localizer.add(measurement)
        found = []
        for now in (8.0, 12.0):
            for k in order:
                stamp = 5.0 + k / 1000
                if now - 4.0 < stamp <= now:
                    localizer.add(Range("r2", "r1", stamp, 3.0 + 0.1 * (k % 7), 0.1, k // 3 if exchange else None))
            found += [estimate.pose.tobytes() for estimate in localizer.update(now).values()]
        return localizer, found

    numbers = list(range(1, 5001))
    localizer, expected = told(numbers)
    table = localizer.team.history.tables["range"]
    assert len(table) <= 2 * 24 + 5 * PER_PAIR
    shuffled = np.random.default_rng(3).permutation(numbers).tolist()
    assert told(shuffled)[1] == expected
