"""What is said of peers that cannot be told apart, and whether following the advice helps. METHOD §3."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import Configuration, Odometry, Range, Status, Team, se2
from dgorl.configuration import merge
from dgorl.places import MISSED
from tests.integration.driven import (
    KNOWN,
    PERIOD,
    every,
    explains_itself,
    is_right,
    log_of,
    watched,
)
from tests.integration.teams import simulated

STRAIGHT = np.array([0.5, 0.0])


def steps(seconds):
    return int(seconds / PERIOD)


def straight(seconds, robots):
    return np.tile(STRAIGHT, (steps(seconds), robots, 1))


def ambiguous_throughout(estimates, reason):
    """Never located; from 10 s on always ambiguous, for the reason, with places and help."""
    for estimate in estimates:
        for found in estimate.values():
            assert found.status not in KNOWN, (estimate.stamp, found)
            assert explains_itself(found)
            if estimate.stamp >= 10.0:
                assert found.status is Status.AMBIGUOUS
                assert reason in found.reason
                assert found.hypotheses
                assert sum(place.probability for place in found.hypotheses) == pytest.approx(1.0 - MISSED)
                assert found.probability == found.hypotheses[0].probability
                np.testing.assert_array_equal(found.pose, found.hypotheses[0].pose)


@pytest.mark.parametrize("robots", [2, 3, 4])
def test_a_team_that_stands_is_never_located(robots):
    log = simulated(motion="static", sensors=("range",), robots=robots, steps=100)
    estimates = watched(log, every(5.0, 50.0))
    ambiguous_throughout(estimates, "no robot has moved")
    for found in estimates[-1].values():
        robot, _, command = found.resolve_by.partition(": ")
        assert robot in log.robots
        assert command not in ("", "stand still")


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("robots", [2, 3])
def test_a_team_that_drives_straight_is_never_located(robots, seed):
    """Straight lines in all directions: all but the side is known."""
    rng = np.random.default_rng(seed)
    starts = np.column_stack([rng.uniform(-8, 8, (robots, 2)), rng.uniform(-np.pi, np.pi, robots)])
    log = log_of(starts, straight(60.0, robots), seed=seed)
    estimates = watched(log, every(5.0, 60.0))
    ambiguous_throughout(estimates, "mirror")
    for found in estimates[-1].values():
        assert found.resolve_by


FORMATION = np.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0], [-3.0, 2.0, 0.0]])


def test_a_symmetric_formation_stays_ambiguous():
    """All straight ahead at one speed: the image mirrored in the line of travel fits as well, for ever."""
    log = log_of(FORMATION, straight(75.0, 3))
    estimates = watched(log, every(5.0, 75.0))
    ambiguous_throughout(estimates, "mirror")


def commanded(advice):
    """Robot and twist of advice like ``r2: turn left while moving``, as ``dgorl.observability_motion`` means it."""
    robot, _, command = advice.partition(": ")
    turn = np.pi / 2 / 10
    twists = {
        "stand still": (0.0, 0.0),
        "drive straight on": (0.5, 0.0),
        "turn left while moving": (0.5, turn),
        "turn right while moving": (0.5, -turn),
        "drive a circle": (0.5, 2 * np.pi / 10),
    }
    return robot, twists[command]


def found_far(log, estimate, peer):
    """Within 15 % of the distance, as `tracked` promises, and 5σ: the mirror image is farther off."""
    return is_right(log, estimate, peer, metres=0.15 * float(np.hypot(*estimate[peer].pose[:2])))


CROSSING = np.array([[0.0, 0.0, 0.0], [4.0, -8.0, 1.2]])
ABREAST = np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
MIRRORED = np.array([[0.0, 0.0, 0.2], [0.0, 5.0, -0.2]])


@pytest.mark.parametrize(("ego", "seed"), [("r1", 0), ("r2", 1), pytest.param("r1", 2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("starts", [CROSSING, ABREAST, MIRRORED], ids=["crossing", "abreast", "mirror-symmetric"])
def test_following_the_advice_resolves_the_mirror_image(starts, seed, ego):
    """Straight for 30 s, then 40 s as advised: the peer is located, on the right side."""
    peer = {"r1": "r2", "r2": "r1"}[ego]
    before = watched(log_of(starts, straight(30.0, 2), seed=seed), [30.0], ego=ego)[0][peer]
    assert before.status is Status.AMBIGUOUS
    robot, twist = commanded(before.resolve_by)
    after = straight(40.0, 2)
    after[:, int(robot[1:]) - 1] = twist
    log = log_of(starts, np.concatenate([straight(30.0, 2), after]), seed=seed)
    estimates = watched(log, every(5.0, 70.0), ego=ego)
    assert all(e[peer].status not in KNOWN for e in estimates if e.stamp <= 30.0)
    assert estimates[-1][peer].status in KNOWN
    assert found_far(log, estimates[-1], peer)


@pytest.mark.parametrize("seed", range(2))
def test_following_the_advice_locates_those_who_stood(seed):
    """Two robots stand for 20 s. Who is told to drive is followed and asked again every 10 s."""
    starts = np.array([[0.0, 0.0, 0.5], [6.0, 3.0, -2.0]])
    twists = np.zeros((steps(20.0), 2, 2))
    for _ in range(8):
        log = log_of(starts, twists, seed=seed)
        found = watched(log, [len(twists) * PERIOD])[0]["r2"]
        if found.status in KNOWN:
            break
        following = np.zeros((steps(10.0), 2, 2))
        if found.resolve_by:
            robot, twist = commanded(found.resolve_by)
            following[:, int(robot[1:]) - 1] = twist
        twists = np.concatenate([twists, following])
    assert found.status in KNOWN
    assert found_far(log, watched(log, [len(twists) * PERIOD])[0], "r2")


def test_a_located_peers_status_follows_its_posterior():
    """A robot that stands is `position` at best: ranges never tell where it looks."""
    circle = np.tile([0.5, 0.2], (steps(60.0), 1))
    standing = np.zeros((steps(60.0), 2))
    log = log_of(np.array([[0.0, 0.0, 0.0], [5.0, 2.0, 1.0]]), np.stack([circle, standing], axis=1))
    estimates = watched(log, every(2.5, 60.0))
    found = estimates[-1]["r2"]
    assert found.status is Status.POSITION
    assert "heading" in found.reason
    assert found.resolve_by.startswith("r2: ")
    assert is_right(log, estimates[-1], "r2")
    assert {e["r2"].status for e in estimates} <= {Status.AMBIGUOUS, Status.POSITION, Status.UNOBSERVABLE}
    # Seen by the one that stands: the other's pose turns with its own unknown heading.
    other = watched(log, [60.0], ego="r2")[0]["r1"]
    assert other.status is Status.UNOBSERVABLE
    assert "bearing" in other.reason
    assert np.isfinite(se2.inverse(other.pose)).all()


def test_contact_is_of_the_last_history_seconds():
    team = Team(merge(Configuration(), {"history": 10.0, "window": 5.0}, "test"))
    for robot in ("a", "b"):
        for k in range(50):
            team.add(Odometry(robot, k / 2, k / 2 + 0.5, 0.3, 0.1))
    team.add(Range("a", "b", 12.0, 5.0, 0.1))
    said = {now: team.view("a", team.update(now), now)["b"].status for now in (11.0, 15.0, 22.0, 22.5)}
    assert list(said.values()) == [Status.ISOLATED, Status.AMBIGUOUS, Status.AMBIGUOUS, Status.ISOLATED]
