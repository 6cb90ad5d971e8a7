"""Two robots pass one another, and no measurement tells on which side: neither is located until one does."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import Configuration, Status, se2
from dgorl.configuration import merge
from dgorl.evaluation.metrics import position_error as errors
from dgorl.evaluation.metrics import position_sigma
from dgorl.evaluation.records import collect
from dgorl.expansion.passing import CLOSE, passings
from dgorl.logs import read
from dgorl.replay import replay
from dgorl.tracks import TrackKey
from tests.integration.driven import KNOWN, PERIOD, every, log_of, position_error, true_relative, walks, watched
from tests.recordings import case

MET = 60.0
"""When they set out to pass one another [s]."""


def to(pose, goal, speed):
    """Twists to a goal: a turn on the spot, then straight on."""
    way = goal - pose[:2]
    turn = float(se2.wrap(np.arctan2(way[1], way[0]) - pose[2]))
    turns, steps = max(int(abs(turn) / 0.4), 1), int(np.hypot(*way) / (speed * PERIOD))
    return [(0.0, turn / turns / PERIOD)] * turns + [(np.hypot(*way) / steps / PERIOD, 0.0)] * steps


def head_on(seed, *, aside=0.7, robots=2, heard=lambda a, b, stamp: True):
    """r1 and r2 learn where they are, drive apart, and straight at one another, ``aside`` [m] to the left; then wander.

    A third robot drives as r1 does, 3 m beside it.
    """
    starts, first = walks(np.array([[0.0, 0.0], [7.0, 0.0]]), 100, radius=3.0, seed=seed)
    at = starts
    for twist in first:
        at = se2.compose(at, se2.exp(np.column_stack([twist[:, 0], [0, 0], twist[:, 1]]) * PERIOD))
    paths = []
    for pose, side, y in zip(at, (-1.0, 1.0), (0.0, aside), strict=True):
        path = []
        for x in (3.5 + 12 * side, 3.5 - 12 * side):
            for v, omega in to(pose, np.array([x, y]), 0.6):
                path.append((v, omega))
                pose = se2.compose(pose, se2.exp(np.array([v, 0.0, omega]) * PERIOD))
        paths.append(path)
    longest = max(map(len, paths))
    straight = np.array([[(0.0, 0.0)] * (longest - len(path)) + path for path in paths]).transpose(1, 0, 2)
    bends = np.full((60, 2, 2), 0.4)
    bends[:, :, 1] = 0.5 * np.sin(np.arange(60)[:, None] / 6 + [0.0, 2.0])
    twists = np.concatenate([first, straight, bends])
    if robots == 3:
        beside = se2.compose(starts[0], [0.0, 3.0, 0.0])
        starts, twists = np.vstack([starts, beside]), np.concatenate([twists, twists[:, :1]], axis=1)
    return log_of(starts, twists, seed=seed, heard=heard)


def last_meeting(log):
    apart = np.hypot(*(log.truth["r1"] - log.truth["r2"])[:, 1:3].T)
    apart[: int(MET / PERIOD)] = np.inf
    return float(log.truth["r1"][np.argmin(apart), 0])


@pytest.fixture(scope="module", params=[(0, 0.7), pytest.param((3, 1.1), marks=pytest.mark.slow)])
def two(request):
    seed, aside = request.param
    log = head_on(seed, aside=aside)
    return log, watched(log, every(0.5, float(log.truth["r1"][-1, 0])))


def test_nobody_is_located_on_the_wrong_side(two):
    log, estimates = two
    for e in estimates:
        if e["r2"].status in KNOWN:
            error, normalised, _ = position_error(log, e, "r2")
            assert error < 2.0 or normalised < 5.0, e.stamp


def test_both_sides_are_kept_and_the_reason_names_who_met(two):
    log, estimates = two
    met = last_meeting(log)
    after = [e for e in estimates if met + 2 <= e.stamp <= met + 8]
    assert after
    for e in after:
        peer = e["r2"]
        assert peer.status is Status.AMBIGUOUS
        assert peer.reason == "r1 and r2 have passed one another: on which side is not known yet"
        assert len(peer.hypotheses) >= 2
        right = true_relative(log, "r1", "r2", e.stamp)
        near = [h for h in peer.hypotheses if np.hypot(*(h.pose - right)[:2]) < 1.5]
        assert sum(h.probability for h in near) > 0.01


def test_who_turns_is_found_again(two):
    log, estimates = two
    assert estimates[-1]["r2"].status in KNOWN
    assert position_error(log, estimates[-1], "r2")[1] < 5.0


def test_who_is_on_one_side_of_both_stays_located():
    """r3 drives beside r1 and does not hear r2: where r2 is, is open for both, where they are is not."""
    log = head_on(0, robots=3, heard=lambda a, b, stamp: {a, b} != {"r2", "r3"} or stamp < 50)
    met = last_meeting(log)
    after = [e for e in watched(log, every(0.5, met + 8.0)) if e.stamp >= met + 2]
    assert any(e["r2"].status is Status.AMBIGUOUS for e in after)
    assert sum(e["r3"].status not in KNOWN for e in after) <= 1  # for a moment the sides differ in where r3 is, too


def test_robots_that_meet_are_not_called_located_on_the_wrong_side_in_a_clean_log():
    log = read(case("clean_log_wrong_place"))
    records = collect(replay(log, merge(Configuration(), log.configuration, "log"), initial="unknown"), log.truth)
    for record in records.between_robots():
        error = np.hypot(*errors(record).T)
        wrong = record.located & (error > 2.0) & (error > 5 * position_sigma(record.covariance))
        assert not wrong.any(), record.t[wrong]
        assert record.located.mean() > 0.6


def test_a_passing_is_where_two_are_nearest():
    a, b, c = (TrackKey(name, 0, 0.0) for name in "abc")
    along = np.arange(20.0) - 10
    zero = np.zeros(20)
    poses = np.concatenate([
        np.column_stack([along, zero, zero]),
        np.column_stack([-along[4:], zero[4:] + 1.0, zero[4:]]),
        np.column_stack([along + 30, zero, zero]),
    ])  # fmt: skip
    layout = {a: (0, 100, 20), b: (20, 104, 16), c: (36, 100, 20)}
    (found,) = passings(layout, poses, 100)
    assert (found.pair, found.keyframe, found.distance) == ((a, b), 110, 1.0)
    np.testing.assert_allclose(found.apart, [0.0, 1.0])
    assert passings(layout, poses, 113) == []
    near = {a: (0, 100, 10), b: (20, 104, 6)}  # ends while they come nearer, 2.2 m apart
    (found,) = passings(near, poses, 100)
    assert found.keyframe == 109
    assert found.distance < CLOSE
