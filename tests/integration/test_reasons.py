"""Reasons are true: robots without odometry, clocks that differ, odometry that tells nothing."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest

from dgorl import Localizer, Odometry, Range, RelativePose, Rssi, Status, logs
from dgorl.configuration import Configuration, merge
from dgorl.evaluation.records import collect
from dgorl.measurements import Displacement
from dgorl.replay import replay
from dgorl.simulation import Scenario, simulate
from tests.recordings import case


def driven(localizer: Localizer, robot: str, begin: float, seconds: int = 20) -> None:
    for k in range(2 * seconds):
        localizer.add(Odometry(robot, begin + k / 2, begin + k / 2 + 0.5, 0.4, 0.1 if robot < "b" else -0.2))


@pytest.mark.parametrize(
    "named",
    [
        Range("a", "quiet", 3.0, 4.0, 0.1),
        Rssi("quiet", "a", 3.0, -60.0),
        Range("quiet", "b", 3.0, 4.0, 0.1),
        RelativePose("world", "quiet", 0.0, 1.0, 2.0, 0.0, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0), prior=True),
    ],
)
def test_a_robot_that_is_only_named(named: Range | Rssi | RelativePose) -> None:
    localizer = Localizer("a")
    driven(localizer, "a", 0.0)
    driven(localizer, "b", 0.0)
    assert "quiet" not in localizer.update(2.0)  # nobody has named it yet, but for a known start
    localizer.add(named)
    seen = localizer.update(10.0)["quiet"]
    assert (seen.status, seen.pose, seen.age) == (Status.ISOLATED, None, inf)
    assert (seen.reason, seen.resolve_by) == ("no odometry from quiet", "send the odometry of quiet")
    driven(localizer, "quiet", 10.0)
    assert localizer.update(15.0)["quiet"].reason != seen.reason


def test_of_its_peers_a_robot_without_odometry_says_so() -> None:
    localizer = Localizer("quiet")
    driven(localizer, "a", 0.0)
    localizer.add(Range("quiet", "a", 3.0, 4.0, 0.1))
    assert localizer.update(10.0)["a"].reason == "no odometry of our own"
    assert "quiet" not in localizer.update(10.0)


def test_a_robot_nobody_heard_of_is_a_key_error_that_says_who_is_known() -> None:
    localizer = Localizer("a")
    driven(localizer, "a", 0.0)
    driven(localizer, "b", 0.0)
    with pytest.raises(KeyError, match="a has heard of no robot 'z' until 5 s; of b"):
        localizer.update(5.0)["z"]
    assert localizer.update(5.0).get("z") is None
    assert "z" not in localizer.update(5.0)


@pytest.mark.parametrize("off", [-130.0, 95.0, 7200.0])
@pytest.mark.parametrize("odd", ["a", "b"])
def test_clocks_that_differ(off: float, odd: str) -> None:
    """One robot's odometry is stamped at another time than the readings that name it; both say so when it is known."""
    localizer = {name: Localizer(name) for name in "ab"}
    for each in localizer.values():
        for name in "ab":
            driven(each, name, off if name == odd else 0.0)
        for k in range(40):
            each.add(Range("a", "b", k / 2, 5.0, 0.1))
    for now in (20.0, 20.0 + off) if off > 0 else (20.0 + off, 20.0):
        last = {name: each.update(now) for name, each in localizer.items()}
    reason = f"the clocks differ by {abs(off):.0f} s: readings name {odd} when it has no odometry"
    assert last["a"]["b"].reason == last["b"]["a"].reason == reason
    assert last["a"]["b"].status == Status.ISOLATED


def test_who_comes_later_has_no_other_clock() -> None:
    localizer = Localizer("a")
    driven(localizer, "a", 0.0, 300)
    driven(localizer, "b", 200.0, 100)
    for k in range(100):
        localizer.add(Range("a", "b", 200.0 + k, 5.0, 0.1))
    assert "clocks" not in localizer.update(250.0)["b"].reason
    assert "clocks" not in localizer.update(320.0)["b"].reason


def test_odometry_that_tells_nothing_is_not_called_straight() -> None:
    """Robots that drive curves, whose odometry states that it is good to 30 m."""
    log = simulate(Scenario(robots=3, area=15.0, sensors=("range",), steps=100, odometry_noise=0.2, seed=4))
    vague = [
        replace(m, covariance=(900.0, 0.0, 0.0, 900.0, 0.0, 400.0)) if isinstance(m, Displacement) else m
        for m in log.measurements
    ]
    localizer = Localizer("r1")
    for m in vague:
        localizer.add(m)
    for k in range(1, 101):
        estimate = localizer.update(k / 2)
    ambiguous = [seen for seen in estimate.values() if seen.status == Status.AMBIGUOUS]
    assert ambiguous
    assert not any("driven straight" in seen.reason for seen in ambiguous)
    assert any("too uncertain to tell how the robots drove" in seen.reason for seen in ambiguous)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("clock_1h_off", "the clocks differ by 3625 s"),
        ("peer_without_odometry", "no odometry from c"),
        ("omega_in_degrees", "odometry of "),
        ("information_for_covariance.pyfg", "too uncertain to tell"),
    ],
)
def test_cases(name: str, words: str) -> None:
    log = logs.read(case(name))
    configuration = merge(Configuration(), {**log.configuration, "period": 2.0}, name)
    records = collect(replay(log, configuration, initial="unknown"), log.truth)
    reasons = [record.reason[-1] for record in records.between_robots()]
    assert any(words in reason for reason in reasons), reasons
    assert not any("driven straight" in reason for record in records.between_robots() for reason in record.reason[20:])
