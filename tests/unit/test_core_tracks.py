"""Tracks: odometry preintegrated between keyframes, located, bridged, carried on; the team seen from one robot."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dgorl import Displacement, Odometry, _core, se2
from dgorl.configuration import Motion
from dgorl.tracks import Trail, motion_values, odometry_row
from tests.unit.reference import random_information

MOTION = Motion(maximum_speed=2.0, maximum_turn_rate=1.0)
FAST = Motion(maximum_speed=20.0, maximum_turn_rate=20.0)
UPPER = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


def trail_of(odometry: Sequence[Odometry | Displacement], motion: Motion = MOTION) -> Any:
    trail = _core.Trail(motion_values(motion))
    trail.extend(np.array(sorted(odometry_row(m) for m in odometry)))
    return trail


def random_steps(count: int, seed: int, span: float = 0.5) -> tuple[list[Displacement], np.ndarray, np.ndarray]:
    """Displacements that fill ``span`` seconds, their motions and the covariances of their right perturbations."""
    rng = np.random.default_rng(seed)
    deltas, noises = rng.uniform(-1, 1, (count, 3)), random_information(rng, count) * 1e-4
    bounds = np.linspace(0, span, count + 1)
    rows = []
    for k, (delta, noise) in enumerate(zip(deltas, noises, strict=True)):
        turn = np.eye(3)
        turn[:2, :2] = se2.rotation(delta[2])
        stated = (turn @ noise @ turn.T)[UPPER]
        rows.append(Displacement("r1", bounds[k], bounds[k + 1], *delta, covariance=tuple(stated)))
    return rows, deltas, noises


def test_preintegration_composes_motion_and_noise() -> None:
    """Σ ← Ad(δ⁻¹) Σ Ad(δ⁻¹)ᵀ + Q, METHOD §1."""
    rows, deltas, noises = random_steps(5, seed=0)
    expected, covariance = np.zeros(3), np.zeros((3, 3))
    for delta, noise in zip(deltas, noises, strict=True):
        expected = se2.compose(expected, delta)
        ad = se2.adjoint(se2.inverse(delta))
        covariance = ad @ covariance @ ad.T + noise
    track = trail_of(rows, FAST).tracks[0]
    delta, information = _core.odometry([track], [0], [1])
    np.testing.assert_allclose(se2.between(expected, delta[0]), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(information[0]), covariance, rtol=1e-8)
    np.testing.assert_array_equal(information[0], information[0].T)


@pytest.mark.parametrize("turns", [-2, -1, 1])
def test_whole_turns_of_a_displacement_mean_nothing(turns: int) -> None:
    """A turn is a difference of headings: it is brought to ±π before the wheels' scale is applied."""
    motion = Motion(angular_scale=0.9)
    near = Displacement("r1", 0.0, 0.5, 0.3, 0.1, 0.4)
    far = Displacement("r1", 0.0, 0.5, 0.3, 0.1, 0.4 + 2 * np.pi * turns)
    (delta, information), (expected, certain) = (
        _core.odometry(trail_of([row], motion).tracks, [0], [1]) for row in (far, near)
    )
    np.testing.assert_allclose(delta, expected, atol=1e-12)
    np.testing.assert_allclose(expected[0, 2], 0.36, atol=1e-12)
    np.testing.assert_allclose(information, certain, rtol=1e-9)


def test_preintegrated_covariance_is_that_of_sampled_motion() -> None:
    rows, deltas, noises = random_steps(4, seed=3)
    delta, information = _core.odometry(trail_of(rows, FAST).tracks, [0], [1])
    rng, x = np.random.default_rng(1), np.zeros((200_000, 3))
    for step, noise in zip(deltas, noises, strict=True):
        x = se2.compose(se2.compose(x, step), se2.exp(rng.multivariate_normal(np.zeros(3), noise, len(x))))
    sampled = np.cov(se2.log(se2.between(delta[0], x)).T)
    covariance = np.linalg.inv(information[0])
    np.testing.assert_allclose(sampled, covariance, atol=0.02 * np.abs(covariance).max())


@given(st.lists(st.floats(0.011, 1.7), min_size=1, max_size=12), st.floats(-0.4, 0.4))
def test_keyframes_cut_steps_of_any_length(lengths: list[float], omega: float) -> None:
    """However long its rows, odometry of one twist gives the same keyframes."""
    bounds = np.concatenate([[0.0], np.cumsum(lengths)])
    rows = [Odometry("r1", a, b, 0.7, omega) for a, b in itertools.pairwise(bounds)]
    track = trail_of(rows).tracks[0]
    assert (track.first, track.last) == (0, int(np.floor(2 * track.end)))
    delta, information = _core.odometry([track], [0], [track.last])
    np.testing.assert_allclose(delta, np.tile(se2.exp([0.35, 0.0, omega / 2]), (track.last, 1)), atol=1e-9)
    if track.last:
        whole = trail_of([Odometry("r1", k / 2, (k + 1) / 2, 0.7, omega) for k in range(track.last)])
        _, expected = _core.odometry(whole.tracks, [0], [track.last])
        # Only the sideways noise differs: heading lost in an earlier step of the interval turns what follows.
        found, expected = (np.linalg.inv(m)[:, [0, 2], [0, 2]] for m in (information, expected))
        np.testing.assert_allclose(found, expected, rtol=0.05)


@given(st.floats(0.0, 4.0))
def test_stamps_are_located_on_the_way(stamp: float) -> None:
    track = trail_of([Odometry("r1", k, k + 1, 0.5, 0.3) for k in range(4)]).tracks[0]
    keyframe, offset = track.locate(stamp)
    assert keyframe == min(int(2 * stamp), 8)
    travelled = se2.compose(se2.exp(np.array([0.25, 0, 0.15]) * keyframe), offset)
    np.testing.assert_allclose(travelled, se2.exp(np.array([0.5, 0, 0.3]) * stamp), atol=1e-9)
    number, keyframes, offsets = _core.locate([None, trail_of([Odometry("r1", 0, 4, 0.5, 0.3)])], [1, 0], [stamp] * 2)
    assert keyframes[0] == keyframe
    np.testing.assert_allclose(offsets[0], offset, atol=1e-9)
    assert number.tolist() == [-1, -1]


def test_wheel_scale_and_lag_move_and_shift() -> None:
    motion = Motion(linear_scale=0.9, angular_scale=1.1, lag=0.2)
    track = trail_of([Odometry("r1", 0.0, 2.0, 1.0, 0.5)], motion).tracks[0]
    assert (track.begin, track.end) == (0.2, 2.2)
    keyframe, offset = track.locate(1.2)
    travelled = se2.compose(_core.chain(np.zeros(3), _core.odometry([track], [0], [keyframe])[0])[-1], offset)
    np.testing.assert_allclose(travelled, se2.exp([0.9, 0.0, 0.55]), atol=1e-9)


def test_noise_grows_with_time_turning_and_distance() -> None:
    motion = Motion(heading_per_second=0.1, heading_per_radian=0.2, heading_per_metre=0.3, forward_per_metre=0.4,
                    lateral_per_metre=0.5, position_per_second=0.6)  # fmt: skip
    step = [Odometry("r1", 0.0, 0.5, 0.8, 0.0)]
    _, information = _core.odometry(trail_of(step, motion).tracks, [0], [1])
    expected = [0.36 * 0.5 + 0.16 * 0.4, 0.36 * 0.5 + 0.25 * 0.4, 0.01 * 0.5 + 0.09 * 0.4]
    np.testing.assert_allclose(np.linalg.inv(information[0]), np.diag(expected), rtol=1e-9)
    turn = [Odometry("r1", 0.0, 0.5, 0.0, 1.0)]
    _, information = _core.odometry(trail_of(turn, motion).tracks, [0], [1])
    np.testing.assert_allclose(1 / information[0, 2, 2], 0.01 * 0.5 + 0.04 * 0.5, rtol=1e-9)


@pytest.mark.parametrize("gap", [0.5, 1.0])
def test_short_gaps_go_on(gap: float) -> None:
    track = trail_of([Odometry("r1", 0, 1, 0.5, 0.0), Odometry("r1", 1 + gap, 2 + gap, 0.5, 0.0)]).tracks[0]
    delta, _ = _core.odometry([track], [2], [int(2 * (1 + gap))])
    assert _core.chain(np.zeros(3), delta)[-1][0] == pytest.approx(0.5 * gap)


@given(st.floats(0.01, 60.0), st.randoms())
def test_a_gap_ends_the_track_in_whatever_order_its_rows_come(gap: float, chance: Random) -> None:
    """Motion that nobody told of pins nothing: what follows is a track of its own, until late rows fill the gap."""
    before = [Odometry("r1", k / 4, (k + 1) / 4, 0.5, 0.1) for k in range(9)]
    after = [Odometry("r1", 2.25 + gap + k / 4, 2.5 + gap + k / 4, 0.5, 0.1) for k in range(9)]
    rows = [*before, *after]
    chance.shuffle(rows)
    trail = Trail("r1", MOTION)
    for row in rows:
        trail.add([row])
    begins = [0.0] if 2.25 + gap - 2.25 <= 1.0 else [0.0, 2.25 + gap]
    assert [track.key.begin for track in trail.tracks] == begins
    trail.add([Odometry("r1", 2.25, 2.25 + gap, 0.5, 0.1)])
    assert [track.key.begin for track in trail.tracks] == [0.0]


@given(st.integers(3, 20), st.booleans(), st.randoms())
def test_a_jump_is_no_motion_and_ends_the_track_in_whatever_order_it_comes(
    at: int, turns: bool, chance: Random
) -> None:
    """An encoder that is reset, a heading that is corrected: far beyond 2 m/s and 1 rad/s, the limits here."""
    rows: list[Odometry | Displacement] = [Odometry("r1", k / 10, (k + 1) / 10, 1.0, 0.2) for k in range(25)]
    rows[at] = Displacement("r1", at / 10, (at + 1) / 10, *((0.1, 0.0, -2.5) if turns else (-7.0, 0.4, 0.0)))
    chance.shuffle(rows)
    trail = Trail("r1", MOTION)
    for row in rows:
        trail.add([row])
    assert trail.jumps == 1
    assert [(t.key.begin, t.end) for t in trail.tracks] == [(0.0, at / 10), ((at + 1) / 10, 2.5)]


def test_fast_rows_of_bunched_stamps_are_motion() -> None:
    """A row of 0.1 s whose stamps came 2 ms apart seems fast, and a whole turn too much is none."""
    rows = [Displacement("r1", 0.0, 0.1, 0.2, 0.0, 0.0), Displacement("r1", 0.1, 0.102, 0.2, 0.0, 0.0)]
    rows.append(Displacement("r1", 0.102, 0.3, 0.2, 0.0, 2 * np.pi + 0.1))
    trail = Trail("r1", MOTION)
    trail.add(rows)
    assert (len(trail.tracks), trail.jumps) == (1, 0)


@pytest.mark.parametrize("gap", [1.5, 7.0])
def test_a_gap_after_all_before_it_is_forgotten_is_one(gap: float) -> None:
    """Dropped up to its last row, a track is rebuilt empty; what follows the gap is none of it."""
    rows = [Odometry("r1", k / 4, (k + 1) / 4, 0.5, 0.1) for k in range(20)]
    later = [Odometry("r1", 5.0 + gap + k / 4, 5.25 + gap + k / 4, 0.5, 0.1) for k in range(8)]
    trail = Trail("r1", MOTION)
    trail.add(rows)
    trail.forget(12)
    trail.add([*later[:3], *later[4:]])
    assert trail.add([later[3]]) == -np.inf
    assert [track.key.begin for track in trail.tracks if track.core.known(99.0) > 5.0] == [5.0 + gap]


def test_forgetting_round_a_jump_keeps_what_rebuilds_the_rest() -> None:
    rows: list[Odometry | Displacement] = [Odometry("r1", k / 4, (k + 1) / 4, 0.5, 0.1) for k in range(40)]
    rows[20] = Displacement("r1", 5.0, 5.25, 0.0, -9.0, 0.0)
    whole = Trail("r1", MOTION)
    whole.add(rows)
    for before in range(8, 14):
        cut = Trail("r1", MOTION)
        cut.add(rows[:30])
        cut.forget(before)
        cut.add([*rows[30:36], *rows[37:]])
        assert cut.add([rows[36]]) == -np.inf
        assert cut.tracks[-1].key == whole.tracks[-1].key
        span = [cut.tracks[-1].core.first], [19]
        found, expected = (_core.odometry([trail.tracks[-1].core], *span) for trail in (cut, whole))
        np.testing.assert_array_equal(found[0], expected[0])
    only = Trail("r1", MOTION)
    only.add(rows[20:21])
    only.forget(12)
    assert only.tracks == []


def test_tracks_end_with_silence_and_epochs() -> None:
    rows = [
        Odometry("r1", 0, 1, 0.5, 0.0),
        Odometry("r1", 40, 41, 0.5, 0.0),
        Odometry("r1", 41, 42, 0.5, 0.0, epoch=1),
    ]
    tracks = trail_of(rows).tracks
    assert [(t.begin, t.end, t.epoch) for t in tracks] == [(0, 1, 0), (40, 41, 0), (41, 42, 1)]


def test_what_is_known_before_a_stamp() -> None:
    """Odometry counts as known from its start; the row after what is bridged tells of it."""
    track = trail_of([Odometry("r1", 0, 1, 0.5, 0.0), Odometry("r1", 2, 3, 0.5, 0.0)]).tracks[0]
    assert [track.known(t) for t in (0.0, 0.5, 1.5, 2.0, 2.5, 9.0)] == [-np.inf, 0.5, 1.0, 1.0, 2.5, 3.0]
    assert [track.newest(t) for t in (0.5, 1.5, 2.5)] == [1, 2, 5]
    assert [track.next(t) for t in (-1.0, 0.5, 1.0, 1.5, 2.2, 3.0)] == [0.0, 0.5, 2.0, 2.0, 2.2, np.inf]


def test_forgetting_and_late_rows_keep_the_rest() -> None:
    """Dropping the past, then rebuilding for a late row, gives the keyframes that were there."""
    rows = [Odometry("r1", k / 4, (k + 1) / 4, 0.5, 0.1 * k) for k in range(40)]
    whole, cut = Trail("r1", MOTION), Trail("r1", MOTION)
    whole.add(rows)
    assert cut.add(rows[:30]) == 0.0  # where its track begins
    cut.forget(8)
    assert cut.add(rows[31:]) == np.inf
    assert cut.add([rows[30]]) == -np.inf
    (a,), (b,) = whole.tracks, cut.tracks
    assert a.key == b.key
    assert b.core.first == 8
    for expected, found in zip(_core.odometry([a.core], [8], [20]), _core.odometry([b.core], [8], [20]), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_forgetting_keeps_a_long_row_that_holds_short_ones() -> None:
    rows = [Odometry("r1", 0.0, 9.0, 0.5, 0.1), *(Odometry("r1", k, k + 0.5, 0.4, 0.0) for k in range(1, 8))]
    trail = Trail("r1", MOTION)
    trail.add(rows)
    trail.forget(16)
    trail.add([Odometry("r1", 9.0, 10.0, 0.5, 0.1)])
    expected = _core.odometry([trail.tracks[0].core], [16], [18])
    assert trail.add([Odometry("r1", 8.5, 8.75, 0.4, 0.0)]) == -np.inf  # tells nothing, but rebuilds
    for known, found in zip(expected, _core.odometry([trail.tracks[0].core], [16], [18]), strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-12)


@pytest.mark.parametrize("cut", [16, 17, 18])
def test_forgetting_inside_what_is_bridged_keeps_what_rebuilds_it(cut: int) -> None:
    rows = [Odometry("r1", k / 4, (k + 1) / 4, 0.5, 0.1) for k in (*range(33), *range(37, 57))]
    whole, part = Trail("r1", MOTION), Trail("r1", MOTION)
    whole.add(rows)
    part.add(rows[:-2])
    part.forget(cut)
    part.add(rows[-1:])
    assert part.add(rows[-2:-1]) == -np.inf
    (a,), (b,) = whole.tracks, part.tracks
    assert (a.key, a.core.last) == (b.key, b.core.last)
    span = [b.core.first], [b.core.last]
    for expected, found in zip(_core.odometry([a.core], *span), _core.odometry([b.core], *span), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_relative_poses_and_their_covariance() -> None:
    """Against sampling: T_ego_j of jointly perturbed poses."""
    rng = np.random.default_rng(4)
    poses = rng.uniform(-3, 3, (3, 3))
    root = rng.normal(size=(9, 9)) * 0.01
    found, covariances = _core.relative(poses, root @ root.T, 1)
    np.testing.assert_allclose(found, se2.between(poses[1], poses), atol=1e-12)
    samples = (root @ rng.normal(size=(9, 100_000))).T.reshape(-1, 3, 3)
    moved = se2.compose(poses, se2.exp(samples))
    seen = se2.between(moved[:, 1:2], moved)
    for j in (0, 2):
        error = seen[:, j] - found[j]
        error[:, 2] = se2.wrap(error[:, 2])
        np.testing.assert_allclose(np.cov(error.T), covariances[j], atol=0.03 * np.abs(covariances[j]).max())
    np.testing.assert_allclose(covariances[1], 0, atol=1e-15)


def test_chain_composes() -> None:
    deltas = np.random.default_rng(5).uniform(-2, 2, (6, 3))
    start = np.array([1.0, -2.0, 3.0])
    poses = _core.chain(start, deltas)
    np.testing.assert_allclose(se2.between(poses[:-1], poses[1:]), [*deltas], atol=1e-12)
    np.testing.assert_array_equal(poses[0], start)
    np.testing.assert_array_equal(_core.chain(start, np.zeros((0, 3))), start[None])


TRACK = trail_of([Odometry("r1", 0, 2, 0.5, 0.2)]).tracks[0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: _core.chain(np.zeros(2), np.zeros((1, 3))), "start: must have shape"),
        (lambda: _core.chain(np.full(3, np.nan), np.zeros((1, 3))), "start: must be finite"),
        (lambda: _core.chain(np.zeros(3), np.full((1, 3), np.inf)), "deltas: must be finite"),
        (lambda: _core.Trail(np.zeros(12)), "motion: must have shape"),
        (lambda: _core.Trail(np.full(13, np.nan)), "motion: must be finite"),
        (lambda: _core.Trail(np.ones(13)).extend(np.zeros((1, 12))), "rows: must have shape"),
        (lambda: _core.Trail(np.ones(13)).extend(np.full((1, 13), np.inf)), "rows: must be finite"),
        (lambda: _core.Trail(np.ones(13)).extend(np.zeros((1, 13))), "rows: must end after they start"),
        (lambda: _core.locate([], [0], [0.0]), "robots: index out of range"),
        (lambda: _core.locate([None], [0, 0], [0.0]), "stamps: must have shape"),
        (lambda: _core.locate([None], [0], [np.nan]), "stamps: must be finite"),
        (lambda: _core.odometry([TRACK], [0], [5]), "first, last: must be keyframes of the track"),
        (lambda: _core.odometry([TRACK], [3], [2]), "first, last: must be keyframes of the track"),
        (lambda: _core.odometry([TRACK], [], [1]), "first, last: must have one entry per track"),
        (lambda: _core.relative(np.zeros((2, 3)), np.zeros((6, 6)), 2), "ego: index out of range"),
        (lambda: _core.relative(np.zeros((2, 3)), np.zeros((3, 3)), 0), "covariance: must have shape"),
        (
            lambda: _core.carry([TRACK], 2.0, np.ones(13), np.zeros((2, 3)), np.zeros((3, 3))),
            "poses: must have shape",
        ),
    ],
)
def test_wrong_arguments_are_refused(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()
