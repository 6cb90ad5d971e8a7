"""Robots that were carried, and readings that lie: noticed, named, and located anew. METHOD §4, break."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dgorl import Configuration, Range, Status, se2
from dgorl.configuration import merge
from dgorl.consistency import chi2_limit
from dgorl.localizer import Team
from dgorl.marginal import settled, without
from dgorl.replay import known_starts
from dgorl.simulation import Scenario, simulate
from tests.integration.driven import KNOWN, every, localizers, position_error, wandering, watched
from tests.integration.teams import simulated

CARRIED = 60.0
SQUARE = ([0, 0], [8, 0], [0, 8], [8, 8])


def within(log, estimate, peer, sigmas=5.0):
    return position_error(log, estimate, peer)[1] < sigmas


# ---- carried ----


@pytest.mark.parametrize(
    ("robots", "seed"),
    [(3, 0), (4, 1), *(pytest.param(n, k, marks=pytest.mark.slow) for n in (3, 4) for k in (2, 3, 4))],
)
def test_a_robot_that_is_carried_is_noticed_and_found_again(robots, seed):
    log = simulated(
        robots=robots, steps=240, area=15.0, sensors=("range",), teleport=f"r2@{CARRIED:g}:10", seed=seed
    )  # fmt: skip
    estimates = watched(log, every(1.0, 120.0))
    before = next(e for e in estimates if e.stamp == CARRIED - 1)
    assert before["r2"].status in KNOWN
    doubted = [e for e in estimates if CARRIED < e.stamp <= CARRIED + 15 and e["r2"].status not in KNOWN]
    assert doubted
    reason = doubted[0]["r2"].reason
    assert "inconsistent" in reason or doubted[0]["r2"].status is Status.AMBIGUOUS
    assert estimates[-1]["r2"].status in KNOWN
    assert within(log, estimates[-1], "r2")


@pytest.mark.parametrize(
    ("at", "seed"),
    [(59.5, 5), (58.0, 6), *(pytest.param(t, k, marks=pytest.mark.slow) for t in (59.5, 56.5) for k in (7, 9, 11))],
)
def test_a_robot_that_is_carried_is_noticed_at_the_next_node(at, seed):
    """By the readings that few of the last 5 s are, as the kernel of ranges rejects them and no step bends."""
    log = simulated(robots=4, steps=130, area=15.0, sensors=("range",), teleport=f"r2@{at:g}:9", seed=seed)
    estimates = watched(log, [at - 1.0, 61.5])
    assert estimates[0]["r2"].status in KNOWN
    assert estimates[1]["r2"].reason.startswith("inconsistent: r2 ")


def test_two_that_hear_only_one_another_are_both_in_doubt():
    """Which of r2 and r4 was carried nobody can know: the others' readings are the same. r4 alone had been cut off."""
    log = simulate(Scenario(steps=130, sensors=("range",), teleport="r2@50:10", seed=5))
    team = Team(merge(Configuration(), log.configuration, "log"))
    for measurement in log.measurements:
        team.add(measurement)
    team.update(62.0)
    assert {key.robot for key in team._memo.node(55.0).suspects} == {"r2", "r4"}
    assert [{key.robot for key in c.tracks} for c in team._memo.node(60.0).components] == [{"r1", "r3", "r5"}]


CUT = CARRIED + 11.0
"""When a robot carried at CARRIED has been cut off: at the second node, first used a second later."""


@pytest.fixture(scope="module", params=range(2))
def carried_r3(request):
    """Four robots, little noise, r3 carried: the log and what r1 says."""
    log = carried(wandering(SQUARE, 110.0, seed=request.param + 1), "r3", CARRIED, (7.0, -6.0, 2.0))
    return log, watched(log, every(1.0, 110.0, since=40.0))


def mates(estimates, since, until):
    return [(e, peer) for e in estimates for peer in ("r2", "r4") if since <= e.stamp <= until]


def test_team_mates_are_right_again_as_soon_as_the_robot_is_cut_off(carried_r3):
    log, estimates = carried_r3
    for e, peer in [*mates(estimates, 0.0, CARRIED), *mates(estimates, CUT, 110.0)]:
        assert e[peer].status in KNOWN
        assert within(log, e, peer), (e.stamp, peer)
    assert estimates[-1]["r3"].status in KNOWN
    assert within(log, estimates[-1], "r3")


def test_team_mates_of_a_suspect_are_not_confidently_wrong(carried_r3):
    log, estimates = carried_r3
    for e, peer in mates(estimates, CARRIED + 6.0, CUT):
        assert e[peer].status not in KNOWN or within(log, e, peer), (e.stamp, peer)


def carried(log, robot, stamp, motion):
    """The log of a robot that was moved by ``motion`` (3,) in its own frame at a stamp, and measured from there on."""
    truth = dict(log.truth)
    rows = truth[robot].copy()
    later = rows[:, 0] > stamp
    last = rows[~later][-1, 1:]
    shift = se2.compose(se2.compose(last, motion), se2.inverse(last))
    rows[later, 1:] = se2.compose(shift, rows[later, 1:])
    truth[robot] = rows
    measurements = []
    for m in log.measurements:
        if isinstance(m, Range) and robot in (m.robot, m.peer) and m.stamp > stamp:
            row = round(m.stamp * 2)
            old = np.hypot(*(log.truth[m.robot][row] - log.truth[m.peer][row])[1:3])
            new = np.hypot(*(truth[m.robot][row] - truth[m.peer][row])[1:3])
            m = replace(m, range=max(m.range - float(old) + float(new), 0.0))
        measurements.append(m)
    return replace(log, measurements=tuple(measurements), truth=truth)


# ---- clean runs ----


def clean_runs(seed):
    """A team with the paper's odometry noise, and one with little."""
    yield simulated(robots=4, steps=240, area=15.0, sensors=("range",), seed=seed)
    yield wandering(SQUARE, 120.0, seed=seed)


def test_nobody_is_called_inconsistent_in_a_clean_run():
    for log in clean_runs(0):
        for estimate in watched(log, every(2.5, 120.0)):
            assert not any("inconsistent" in found.reason for found in estimate.values())


@pytest.mark.slow
def test_hardly_anybody_is_called_inconsistent_in_many_clean_runs():
    """At most one node in a hundred, and one run in ten in which somebody is cut off."""
    doubts, cut_off, nodes = 0, 0, 0
    for seed in range(10):
        for log in clean_runs(seed):
            estimates = watched(log, every(5.0, 120.0, since=1.0))
            doubts += sum(any("inconsistent" in p.reason for p in e.values()) for e in estimates)
            cut_off += any(p.status is Status.AMBIGUOUS for e in estimates if e.stamp > 60 for p in e.values())
            nodes += len(estimates)
    assert doubts / nodes < 0.01
    assert cut_off <= 2


def test_the_limit_is_the_quantile_of_chi_squared():
    from scipy.stats import chi2

    for dof in (3, 10, 100):
        assert chi2_limit(dof) == pytest.approx(chi2.isf(1e-4, dof), rel=0.05)


# ---- readings that lie ----


@pytest.mark.parametrize(("liar", "seed"), [("r2", 0), ("r3", 1)])
def test_a_robot_whose_ranges_are_too_long_is_named(liar, seed):
    """+5 m on all ranges of one robot from 60 s on."""
    log = wandering(SQUARE, 90.0, seed=seed)
    lying = [
        replace(m, range=m.range + 5.0) if isinstance(m, Range) and liar in (m.robot, m.peer) and m.stamp > 60 else m
        for m in log.measurements
    ]
    estimates = watched(replace(log, measurements=tuple(lying)), every(1.0, 90.0))
    assert not any("inconsistent" in p.reason for e in estimates if e.stamp <= 60 for p in e.values())
    named = [e for e in estimates if 60 < e.stamp <= 75 and e[liar].reason.startswith(f"inconsistent: {liar} ")]
    assert named
    first = named[0]
    assert first[liar].status is Status.UNOBSERVABLE
    assert "wait" in first[liar].resolve_by
    blamed = {p.reason.split()[1] for p in first.values() if "inconsistent" in p.reason}
    assert blamed == {liar}


# ---- what is left when one is taken out ----


def test_without_a_robot_the_others_keep_their_poses_and_what_was_known_of_them():
    log = wandering(SQUARE, 60.0)
    team, _ = localizers(log)
    for measurement in log.measurements:
        team.add(measurement)
    team.update(61.0)
    (component,) = team._memo.node(55.0).components
    low, keyframe = team._memo.low(55.0), 100
    gone = component.tracks[1]
    rest = without(team.history, component, gone, low, keyframe)
    assert gone not in rest.stretches
    assert set(rest.tracks) == set(component.tracks) - {gone}
    assert all(gone not in (p.reference, *p.members) for p in rest.priors)
    # The same window with the robot, up to the same keyframe.
    cut = replace(
        component,
        stretches={k: s._replace(poses=s.poses[: keyframe - s.first + 1]) for k, s in component.stretches.items()},
    )
    whole = settled(team.history, cut, low, keyframe / 2, keyframe / 2).component
    at = {key: whole.stretches[key].poses[keyframe - whole.stretches[key].first] for key in whole.tracks}
    reference = rest.tracks[0]
    for key in rest.tracks:
        left = {k: rest.stretches[k].poses[keyframe - rest.stretches[k].first] for k in (reference, key)}
        np.testing.assert_allclose(
            se2.between(left[reference], left[key]), se2.between(at[reference], at[key]), atol=1e-6
        )
    # The prior on the others is the marginal of the whole one.
    (mine,), (full,) = rest.priors, whole.priors
    assert full.reference == mine.reference
    rows = [3 * full.members.index(key) + k for key in mine.members for k in range(3)]
    expected = np.linalg.inv(full.information)[np.ix_(rows, rows)]
    np.testing.assert_allclose(np.linalg.inv(mine.information), expected, rtol=1e-3, atol=1e-9)


def test_a_window_that_has_just_begun_at_a_node():
    """The first node may see two keyframes a robot: no step of theirs is old enough to be tested."""
    log = simulate(Scenario(robots=5, steps=6))
    team = Team(merge(Configuration(), log.configuration, "log"))
    for measurement in [*known_starts(log), *log.measurements]:
        stamps = {
            name: getattr(measurement, name) + 4.56 for name in ("start", "end", "stamp") if hasattr(measurement, name)
        }
        team.add(replace(measurement, **stamps))
    state = team.update(7.57)
    assert all(peer.status in KNOWN for peer in team.view("r1", state, 7.57).values())
