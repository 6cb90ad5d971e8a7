"""A log written and read again is the same log, to the last bit."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import logs
from dgorl.errors import LogError
from dgorl.logs import Log, Start, in_order
from dgorl.measurements import Bearing, Displacement, Measurement, Odometry, Range, RelativePose, Rssi
from dgorl.simulation import Scenario, simulate

numbers = st.floats(-1e9, 1e9)
positive = st.floats(1e-6, 1e6)
OFFSETS = (-1e6, 0.0, 1.7e9)
"""What a clock may show when a log begins [s]; all of it is on that clock."""


def assert_same(a: Log, b: Log) -> None:
    """Everything but where it lies and what was left out on the way."""
    for field in ("robots", "measurements", "starts", "configuration"):
        assert getattr(a, field) == getattr(b, field)
    assert sorted(a.truth) == sorted(b.truth)
    for robot, rows in a.truth.items():
        np.testing.assert_array_equal(rows, b.truth[robot])


def again(log: Log) -> Log:
    with TemporaryDirectory() as folder:
        logs.write(log, folder)
        return logs.read(folder)


@st.composite
def small_logs(draw: st.DrawFn) -> Log:
    names = st.from_regex(r"\A\w[\w.-]{0,4}\Z")
    robots = draw(st.lists(names, min_size=2, max_size=4, unique=True))
    offset = draw(st.sampled_from(OFFSETS))
    stamps = st.floats(offset, offset + 8e4)
    measurements: list[Measurement] = []
    twists = draw(st.booleans())
    for k, robot in enumerate(robots):
        times = sorted(draw(st.lists(stamps, min_size=2 if k == 0 else 0, max_size=6, unique=True)))
        epoch = 0
        for start, following in pairwise(times):
            end = min(following, start + draw(st.floats(1e-3, 59.0)))
            epoch += draw(st.integers(0, 1))
            if twists:
                measurements.append(Odometry(robot, start, end, draw(numbers), draw(numbers), epoch))
            else:
                xx, yy, tt = draw(positive), draw(positive), draw(positive)
                covariance = draw(st.sampled_from([None, (xx, 0.0, -0.0, yy, 0.0, tt)]))
                step = (draw(numbers), draw(numbers), draw(numbers))
                measurements.append(Displacement(robot, start, end, *step, covariance, epoch))
    pairs = st.permutations(robots).map(lambda order: order[:2])
    sigma = st.none() | positive
    signed, unsigned, exchange = numbers, st.floats(0, 1e6), st.none() | st.integers(0, 2**64)
    for a, b in draw(st.lists(pairs, max_size=8)):
        readings = (
            st.builds(Rssi, st.just(a), st.just(b), stamps, signed),
            st.builds(Range, st.just(a), st.just(b), stamps, unsigned, sigma, exchange),
            st.builds(Bearing, st.just(a), st.just(b), stamps, signed, sigma),
        )
        measurements.append(draw(st.one_of(readings)))
    truth: dict[str, Any] = {}
    for robot in draw(st.sets(st.sampled_from(robots))):
        times = sorted({measurements[0].start, *draw(st.lists(stamps, max_size=4))})
        truth[robot] = np.array([[t, draw(numbers), draw(numbers), draw(numbers)] for t in times])
    pose = st.tuples(numbers, numbers, numbers)
    start = st.builds(Start, stamps, pose) if draw(st.booleans()) else st.builds(Start, st.just(offset), pose)
    starts = draw(st.dictionaries(st.sampled_from(robots), start))
    radio = draw(st.fixed_dictionaries({}, optional={"sigma_db": positive, "rssi_at_1m_dbm": numbers}))
    configuration = draw(st.sampled_from([{}, {"radio": radio}, {"antennas": {robots[0]: [0.5, 1e-7, -1.0]}}]))
    return Log(Path("made"), tuple(robots), in_order(measurements), truth, starts, configuration, {})


@given(small_logs())
@settings(max_examples=150, deadline=None)
def test_small_logs(log: Log) -> None:
    assert_same(log, again(log))


@given(small_logs(), st.randoms())
@settings(max_examples=50, deadline=None)
def test_one_order_whatever_the_order(log: Log, random: Any) -> None:
    shuffled = list(log.measurements)
    random.shuffle(shuffled)
    assert in_order(shuffled) == log.measurements


@pytest.mark.parametrize(
    "scenario",
    [
        Scenario(),
        Scenario(sensors=("rssi", "range", "bearing"), nlos=0.2, teleport="r2@20:5", wheel_lag=0.2, steps=60),
        Scenario(sensors=("range",), motion="formation", period=0.3, robots=3),
        Scenario(sensors=("bearing",), motion="static", comm_range=5.0),
        Scenario(comm_range=1e-3, steps=3),
    ],
)
def test_simulated_logs(scenario: Scenario) -> None:
    log = simulate(scenario)
    assert_same(log, again(log))


def test_a_log_replaces_the_one_before(tmp_path: Path) -> None:
    logs.write(simulate(Scenario(sensors=("rssi", "bearing"), steps=3)), tmp_path / "a" / "log")
    second = simulate(Scenario(sensors=("range",), steps=3))
    logs.write(second, tmp_path / "a" / "log")
    assert_same(second, logs.read(tmp_path / "a" / "log"))
    assert not (tmp_path / "a" / "log" / "bearings.csv").exists()


STEP = Odometry("r1", 0.0, 1.0, 0.0, 0.0)
LATER = Odometry("r1", 1.0, 2.0, 0.0, 0.0)
POSE = RelativePose("r1", "r2", 0.0, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("robots", "measurements", "configuration", "what"),
    [
        (("r1", "r 2"), [STEP], {}, "cannot name a robot `r 2`"),
        (("r1", "r2"), [STEP, POSE], {}, "cannot hold relative poses"),
        (
            ("r1", "r2"),
            [STEP, Displacement("r2", 0.0, 1.0, 0.0, 0.0, 0.0)],
            {},
            "either twists or displacements",
        ),
        (("r1", "r2"), [STEP], {"window": 10}, "cannot hold the setting `window`"),
        (
            ("r1", "r2"),
            [dataclasses.replace(STEP, epoch=1), LATER],
            {},
            "epochs of r1 must follow one another",
        ),
    ],
)
def test_what_a_folder_cannot_hold(
    tmp_path: Path, robots: tuple[str, ...], measurements: list[Measurement], configuration: Any, what: str
) -> None:
    log = Log(Path("made"), robots, tuple(measurements), {}, {}, configuration, {})
    with pytest.raises(LogError, match=what):
        logs.write(log, tmp_path / "log")
    assert not (tmp_path / "log").exists()


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot be written"):
        logs.write(simulate(Scenario(steps=1)), tmp_path / "file")
