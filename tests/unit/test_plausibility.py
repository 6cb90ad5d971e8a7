"""What doctor says of units and of clocks that step: found where they are wrong, silent where all is well."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from dgorl import logs
from dgorl.findings import Level
from dgorl.logs import Log, in_order
from dgorl.logs.checkup import checkup
from dgorl.measurements import Displacement, Measurement, Odometry, Range
from dgorl.simulation import Scenario, simulate
from tests.recordings import case, recording

TEAM = Scenario(robots=3, area=12.0, sensors=("range",), steps=180, odometry_noise=0.1, seed=3)


@pytest.fixture(scope="module")
def team() -> Log:
    return simulate(TEAM)


def changed(log: Log, change: object) -> Log:
    made: Iterable[Measurement | None] = (change(m) for m in log.measurements)  # type: ignore[operator]
    return replace(log, measurements=in_order(m for m in made if m is not None))


def said(log: Log) -> list[tuple[Level, str, str]]:
    """All but what is well, and what these logs are silent about."""
    return [(f.level, f.what, f.advice) for f in checkup(log) if f.level != Level.OK]


def test_a_clean_log_is_plausible(team: Log) -> None:
    assert said(team) == []


@pytest.mark.parametrize(
    ("change", "what", "advice"),
    [
        (
            lambda m: replace(m, range=m.range * 1000) if isinstance(m, Range) else m,
            "range: median ",
            "did you mean `ranging: {scale: 0.001}`?",
        ),
        (
            lambda m: replace(m, range=m.range * 100) if isinstance(m, Range) else m,
            "range: median ",
            "did you mean `ranging: {scale: 0.01}`?",
        ),
        (lambda m: replace(m, sigma=60.0) if isinstance(m, Range) else m, "range: median σ 60 m", "a variance"),
        (lambda m: replace(m, sigma=2e-5) if isinstance(m, Range) else m, "range: median σ 2e-05 m", "a variance"),
        (
            lambda m: replace(m, dtheta=m.dtheta * 57.3) if isinstance(m, Displacement) else m,
            "r1: turns at ",
            "degrees? Then record radians",
        ),
        (
            lambda m: replace(m, dx=m.dx * 1000) if isinstance(m, Displacement) else m,
            "r1: drives at ",
            "did you mean `motion: {linear_scale: 0.001}`, for mm?",
        ),
        (
            lambda m: replace(m, dx=m.dx * 100) if isinstance(m, Displacement) else m,
            "r1: drives at ",
            "did you mean `motion: {linear_scale: 0.01}`, for cm?",
        ),
        (
            lambda m: Odometry(m.robot, m.start, m.end, m.dx * 30, 0.1) if isinstance(m, Displacement) else m,
            "r1: drives at ",
            "is that so? Then set `motion: {maximum_speed: ",
        ),
        (
            lambda m: (
                replace(m, dx=-8.8, dy=0.0) if isinstance(m, Displacement) and (m.robot, m.start) == ("r2", 20.0) else m
            ),
            "r2: an impossible step: 8.8 m and ",
            "left out: no motion is so much faster",
        ),
    ],
)
def test_units_that_are_wrong(team: Log, change: object, what: str, advice: str) -> None:
    lines = said(changed(team, change))
    assert any(w.startswith(what) and a.startswith(advice) for _, w, a in lines), lines
    assert {level for level, _, _ in lines} == {Level.NOTE}


def test_information_for_covariance(team: Log) -> None:
    def stated(m: Measurement) -> Measurement:
        inverse = (400.0, 0.0, 0.0, 400.0, 0.0, 900.0)
        return replace(m, covariance=inverse) if isinstance(m, Displacement) else m

    assert all("an information matrix?" in advice for _, _, advice in said(changed(team, stated)))
    assert len(said(changed(team, stated))) == 3


def set_forward(m: Measurement, robot: str, since: float, by: float, everything: bool) -> Measurement:
    """A robot's clock jumps: its odometry's stamps, or all of its stamps."""
    if isinstance(m, Displacement) and m.robot == robot and m.start >= since - 1e-9:
        return replace(m, start=m.start + by, end=m.end + by)
    if everything and isinstance(m, Range) and m.robot == robot and m.stamp > since:
        return replace(m, stamp=m.stamp + by)
    return m


@pytest.mark.parametrize("everything", [False, True])
@pytest.mark.parametrize(("robot", "since", "by"), [("r1", 30.0, 3.0), ("r3", 42.0, 8.0)])
def test_a_clock_that_steps(team: Log, robot: str, since: float, by: float, everything: bool) -> None:
    stepped = changed(team, lambda m: set_forward(m, robot, since, by, everything))
    problems = [what for level, what, _ in said(stepped) if level == Level.PROBLEM]
    named = f"odometry of {robot} and the ranges that name {robot} disagree in time by {by:.1f} s from {since:g} s on"
    assert [what.partition(":")[0] for what in problems] == [named]


@pytest.mark.parametrize(("robot", "since", "length"), [("r1", 30.0, 3.0), ("r3", 42.0, 8.0), ("r2", 25.0, 1.6)])
def test_a_robot_that_drives_on_unseen(team: Log, robot: str, since: float, length: float) -> None:
    """A pause is no step: what comes after it fits as it is stamped."""

    def lost(m: Measurement) -> Measurement | None:
        gone = isinstance(m, Displacement) and m.robot == robot and since <= m.start + 1e-9 < since + length
        return None if gone else m

    assert [what for level, what, _ in said(changed(team, lost)) if level == Level.PROBLEM] == []


@pytest.mark.parametrize(
    ("name", "level", "fragments"),
    [
        ("clock_jump_5s", Level.PROBLEM, ["odometry of b and the ranges that name b disagree in time by 5.0 s"]),
        ("clock_1h_off", Level.PROBLEM, ["odometry of b (3624.67 to ", "the clocks differ by 3625 s"]),
        ("held_gap", Level.NOTE, ["b: odometry is missing 1 times for over 1 s, longest for 39.0 s from 21 s on"]),
        ("encoder_reset", Level.NOTE, ["b: an impossible step: 33.2 m and 0.058 rad in 0.1 s at 40 s"]),
        ("omega_in_degrees", Level.NOTE, ["a: turns at ", "rad/s, more than the 2 of"]),
        ("information_for_covariance.pyfg", Level.NOTE, ["A: its odometry states a σ of 100 m a row"]),
        ("ranges_in_mm", Level.NOTE, ["range: median 6.5 km"]),
        ("peer_without_odometry", Level.NOTE, ["c: no odometry, so nobody can locate it"]),
    ],
)
def test_cases(name: str, level: Level, fragments: list[str]) -> None:
    lines = [what for at, what, _ in said(logs.read(case(name))) if at == level]
    assert any(all(fragment in what for fragment in fragments) for what in lines), lines


@pytest.mark.parametrize("name", ["tiers/tiers.pyfg", "murp16", "mrclam9", "mrclam5a.pyfg", "tiers/two_robots"])
def test_recordings_are_plausible(name: str) -> None:
    for level, what, _ in said(logs.read(Path(recording(name)))):
        assert level == Level.NOTE
        if "times in a second" in what:  # a fast radio, no doubtful one
            continue
        assert not any(word in what for word in ("impossible", "turns", "drives", "range:", "states")), what
