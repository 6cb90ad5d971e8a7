"""Teams whose starts nobody knows: formed, told apart, joined, and never confidently wrong. METHOD §1, §4."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from dgorl import Status, se2
from dgorl.logs.log import Start
from dgorl.measurements import Displacement, Odometry, known_at
from dgorl.replay import replay
from dgorl.tracks import KEYFRAMES_PER_SECOND
from tests.integration.driven import (
    KNOWN,
    SHARE_95,
    arriving,
    bits,
    every,
    explains_itself,
    is_right,
    localizers,
    log_of,
    position_error,
    wandering,
    watched,
)
from tests.integration.teams import settings, simulated

TRIANGLE = ([0, 0], [8, 0], [0, 8])
LINE = ([0, 0], [8, 0], [16, 0])
TWO_PAIRS = ([0, 0], [8, 0], [20, 0], [20, 8])


def never_wrong(log, estimates):
    """Whoever counts as located is within 5σ, whoever does not says why."""
    for estimate in estimates:
        for peer, found in estimate.items():
            assert explains_itself(found), (estimate.stamp, peer, found)
            if found.status in KNOWN:
                error, _, sigma = position_error(log, estimate, peer)
                assert error < 5 * sigma, (estimate.stamp, peer, error, sigma)


def all_located(log, estimate, among=None):
    peers = [peer for peer in log.robots if peer != estimate.robot and (among is None or peer in among)]
    return all(estimate[peer].status in KNOWN and is_right(log, estimate, peer) for peer in peers)


# ---- teams of every size ----


def test_one_robot_has_no_peers():
    log = log_of(np.zeros((1, 3)), np.tile([0.5, 0.1], (60, 1, 1)))
    assert [dict(estimate) for estimate in watched(log, every(1.0, 30.0))] == [{}] * 30


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("homes", [TRIANGLE[:2], TRIANGLE], ids=["two", "three"])
def test_robots_are_located_from_ranges(homes, seed):
    log = wandering(homes, 90.0, seed=seed)
    estimates = watched(log, every(2.5, 90.0))
    never_wrong(log, estimates)
    assert all_located(log, estimates[-1])
    assert all(found.status not in KNOWN for found in estimates[2].values())  # 7.5 s tell nothing


def test_every_robot_sees_the_same_team():
    log = wandering(TRIANGLE, 60.0)
    team, egos = localizers(log)
    for measurement in log.measurements:
        team.add(measurement)
    found = {ego.robot: ego.update(60.0) for ego in egos}
    for a, b in combinations(log.robots, 2):
        assert found[a][b].status is Status.TRACKED
        np.testing.assert_allclose(se2.inverse(found[a][b].pose), found[b][a].pose, atol=1e-9)
        assert is_right(log, found[a], b)


def test_twelve_robots_each_have_a_place_or_a_reason():
    log = simulated(robots=12, steps=30, area=40.0, sensors=("range",))
    team, egos = localizers(log)
    for measurement in log.measurements:
        team.add(measurement)
    for now in every(2.5, 15.0):
        state = team.update(float(now))
        for ego in egos:
            estimate = ego.view(state, float(now))
            assert len(estimate) == 11
            assert all(explains_itself(found) for found in estimate.values())
    assert sum(found.status in KNOWN for found in estimate.values()) >= 6


@pytest.mark.parametrize("homes", [TRIANGLE[:2], TRIANGLE], ids=["two", "three"])
def test_one_candidate_each_is_enough_to_go_on(homes):
    log = wandering(homes, 90.0, seed=1)
    estimates = watched(log, every(2.5, 90.0), candidates=1)
    never_wrong(log, estimates)
    assert all_located(log, estimates[-1])


# ---- who hears whom ----


@pytest.mark.parametrize("silence", [(8.0, 30.0), (40.0, 60.0)], ids=["while ambiguous", "once joined"])
@pytest.mark.parametrize("seed", range(2))
def test_a_link_that_vanishes_and_comes_back(silence, seed):
    """r1 and r2 do not hear one another for a while; r3 hears both."""

    def heard(a, b, stamp):
        return (a, b) != ("r1", "r2") or not silence[0] < stamp <= silence[1]

    log = wandering(TRIANGLE, 90.0, seed=seed, heard=heard)
    estimates = watched(log, every(2.5, 90.0))
    never_wrong(log, estimates)
    assert all_located(log, estimates[-1])


def test_a_pair_that_parts_before_it_is_told_apart():
    """All links go for 25 s while places are still many: they wait, and are joined when the links are back."""

    def heard(a, b, stamp):
        return not 9.0 < stamp <= 34.0

    log = wandering(TRIANGLE[:2], 80.0, seed=0, heard=heard)
    estimates = watched(log, every(2.5, 80.0))
    never_wrong(log, estimates)
    assert all(e["r2"].status not in KNOWN for e in estimates if e.stamp <= 34.0)
    assert all_located(log, estimates[-1])


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("homes", [TWO_PAIRS, (*TWO_PAIRS, [12, 16], [4, 8])], ids=["two and two", "three and three"])
def test_two_groups_that_meet(homes, seed):
    """Each group is joined by itself first, and all of it with the other after they met at 45 s."""
    group = {"r1", "r2"} if len(homes) == 4 else {"r1", "r2", "r6"}

    def heard(a, b, stamp):
        return (a in group) == (b in group) or stamp > 45.0

    log = wandering(homes, 100.0, seed=seed, heard=heard)
    estimates = watched(log, every(2.5, 100.0))
    never_wrong(log, estimates)
    apart = next(e for e in estimates if e.stamp == 45.0)
    assert all_located(log, apart, group)
    assert {apart[peer].status for peer in set(log.robots) - group} == {Status.ISOLATED}
    others = watched(log, [45.0], ego="r3")[0]
    assert all_located(log, others, set(log.robots) - group)
    assert all_located(log, estimates[-1])


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_friends_of_friends_are_located(seed):
    """r1 hears r2, r2 hears r3, r1 and r3 never hear one another."""

    def heard(a, b, stamp):
        return (a, b) != ("r1", "r3")

    log = wandering(LINE, 100.0, seed=seed, heard=heard)
    for ego in ("r1", "r3"):
        estimates = watched(log, every(2.5, 100.0), ego=ego)
        never_wrong(log, estimates)
        assert all(found.status in KNOWN for found in estimates[-1].values())
        for peer in estimates[-1]:
            error, normalised, _ = position_error(log, estimates[-1], peer)
            assert error < 2.0
            assert normalised < 5.0


# ---- signal strength ----


def radio_run(seed):
    """How many located ticks are inside the 95 % ellipse, beyond 5σ, and in all; readings thinned to what is new."""
    log = simulated(robots=3, steps=240, area=20.0, reciprocity=0.8, shadowing_correlation=1.0, seed=seed)
    inside, wrong, located = 0, 0, 0
    for estimate in watched(log, every(2.5, 120.0), radio={"thinning": 2.0}):
        for peer, found in estimate.items():
            if found.status in KNOWN:
                _, normalised, _ = position_error(log, estimate, peer)
                located += 1
                inside += normalised**2 < SHARE_95
                wrong += normalised > 5.0
    return inside, wrong, located


def test_shared_shadowing_does_not_make_it_overconfident():
    """Shadowing that both directions and neighbouring places have in common, stated as ρ and as the thinning."""
    counts = np.array([radio_run(seed) for seed in range(5)])
    inside, wrong, located = counts.sum(axis=0)
    assert located > 150
    assert inside / located > 0.85
    assert wrong / located < 0.03


# ---- a pure function of what is known ----

SECONDS = 70.0


@pytest.fixture(scope="module")
def log():
    """Two groups that meet at 25 s: joins, hypotheses and priors between components."""

    def heard(a, b, stamp):
        return (a in ("r1", "r2")) == (b in ("r1", "r2")) or stamp > 25.0

    return wandering(TWO_PAIRS, SECONDS, seed=1, heard=heard)


@pytest.fixture(scope="module")
def expected(log):
    """What every robot says every 2.5 s, measurements arriving in order."""
    stamps = every(2.5, SECONDS)
    told = arriving(log.measurements, [known_at(m) for m in log.measurements], log, stamps)
    return dict(zip(stamps.tolist(), told, strict=True))


def test_the_reference_run_has_all_kinds_of_statuses(expected):
    found = {peer[0] for told in expected.values() for ego in told.values() for peer in ego.values()}
    assert {Status.ISOLATED, Status.AMBIGUOUS, Status.TRACKED} <= found


def test_all_at_once_and_shuffled_equals_in_order(log, expected):
    measurements = list(log.measurements)
    random.Random(1).shuffle(measurements)
    told = arriving(measurements, [0.0] * len(measurements), log, list(expected))
    assert told == list(expected.values())


def test_duplicates_leave_no_trace(log, expected):
    measurements = [*log.measurements, *log.measurements]
    random.Random(2).shuffle(measurements)
    rng = random.Random(3)
    seen: set[object] = set()
    arrive = []
    for m in measurements:
        arrive.append(known_at(m) + (rng.uniform(0, 30) if m in seen else 0.0))
        seen.add(m)
    assert arriving(measurements, arrive, log, list(expected)) == list(expected.values())


def test_asking_seldom_changes_nothing(log, expected):
    stamps = [20.0, 42.5, SECONDS]
    told = arriving(log.measurements, [known_at(m) for m in log.measurements], log, stamps)
    assert told == [expected[stamp] for stamp in stamps]


@pytest.mark.parametrize(("what", "seed"), [("readings", 0), ("odometry", 1), ("both", 2)])
def test_late_data_rewinds_to_what_it_would_have_been(log, expected, what, seed):
    """A tenth of the data of the first 40 s comes up to 25 s late: in the end nothing tells."""
    rng = random.Random(seed)
    kinds = {"readings": False, "odometry": True}
    arrive = []
    for m in log.measurements:
        wanted = what == "both" or isinstance(m, Odometry | Displacement) == kinds[what]
        delay = rng.uniform(0, 25) if wanted and known_at(m) < 40.0 and rng.random() < 0.1 else 0.0
        arrive.append(known_at(m) + delay)
    stamps = list(expected)
    told = arriving(log.measurements, arrive, log, stamps)
    assert told[4:14] != [expected[stamp] for stamp in stamps[4:14]]
    assert told[-1] == expected[SECONDS]


def test_nothing_of_truth_and_starts_reaches_the_estimate(log):
    """Corrupted truth and starts: with unknown starts, every estimate stays the same bit for bit."""
    lying = replace(
        log,
        truth={robot: rows[:, [0, 2, 1, 3]] * [1, -3, 7, -1] for robot, rows in log.truth.items()},
        starts={robot: Start(0.0, (100.0, -50.0, 2.0)) for robot in log.robots},
    )
    configuration = settings(log, period=5.0)
    told = [
        [
            {ego: bits(estimate) for ego, estimate in tick.estimates.items()}
            for tick in replay(recording, configuration, initial="unknown")
        ]
        for recording in (log, lying)
    ]
    assert told[0] == told[1]
    assert len(told[0]) == SECONDS / 5.0


# ---- limits ----


def node_distances(log, stamps, **changes):
    """Distances between members at the keyframes of every node's window."""
    team, _ = localizers(log, **changes)
    for measurement in log.measurements:
        team.add(measurement)
    found = []
    for now in stamps:
        team.update(float(now))
        for component in team._memo.node(team._memo.due(now)).components:
            for a, b in combinations(component.tracks, 2):
                one, other = component.stretches[a], component.stretches[b]
                first = max(one.first, other.first)
                rows = min(one.first + len(one.poses), other.first + len(other.poses)) - first
                apart = one.poses[first - one.first :][:rows, :2] - other.poses[first - other.first :][:rows, :2]
                found.append(np.hypot(*apart.T))
    return np.concatenate(found)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.9, 0.97])
def test_no_two_members_are_farther_apart_than_the_diameter(seed, share):
    """A limit a little below what the readings say binds, and holds at every keyframe of the nodes' windows.

    Far below it would be a contradiction.
    """
    log = wandering(TRIANGLE, 60.0, seed=seed)
    stamps = every(5.0, 60.0, since=1.0)
    free = node_distances(log, stamps)
    diameter = float(np.quantile(free, share))
    bound = node_distances(log, stamps, limits={"diameter": diameter})
    assert len(bound) > KEYFRAMES_PER_SECOND * 60
    assert bound.max() <= diameter + 1e-6
    assert bound.max() > 0.98 * diameter
