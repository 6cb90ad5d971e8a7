"""What is weak in words, straight paths and their mirror image, and the motion that would tell. METHOD §3."""

from __future__ import annotations

from math import pi, radians

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dgorl import _core, se2
from dgorl.observability_motion import (
    HORIZON,
    STEPS,
    Limits,
    direction,
    mirrored,
    odometry_wander,
    resolve_by,
    straight,
    weak_directions,
)

Array = np.ndarray
PAIR = ("r1", "r3")
STEP_COVARIANCE = np.diag(np.square([0.1, 0.1, radians(0.5)]))


# ---- in words ----


def covariance(pose: Array, along: float, across: float, heading: float) -> Array:
    """(3, 3) in the ego's frame from σ along and across the line of sight [m] and of the heading [rad]."""
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(np.arctan2(pose[1], pose[0]))
    return turn @ np.diag(np.square([along, across, heading])) @ turn.T


@pytest.mark.parametrize(
    ("sigma", "words"),
    [
        ((0.1, 0.1, 0.05), ()),
        ((0.1, 0.1, 1.0), ("its heading",)),
        ((0.1, 3.0, 0.05), ("its bearing from r1",)),
        ((3.0, 0.1, 0.05), ("its distance from r1",)),
        ((0.1, 9.0, 1.0), ("its bearing from r1", "its heading")),
        ((0.1, 1.2, 9.0), ("its heading", "its bearing from r1")),
    ],
)
def test_weak_directions_worst_first(sigma: tuple[float, float, float], words: tuple[str, ...]) -> None:
    for angle in (0.0, 1.0, -2.5):
        pose = np.array([8 * np.cos(angle), 8 * np.sin(angle), 0.3])
        assert weak_directions("r1", pose, covariance(pose, *sigma), 1.0, radians(20)) == words


def test_a_peer_that_may_turn_round_the_ego_as_a_whole() -> None:
    pose = np.array([0.0, 5.0, 1.0])
    swing = np.array([-5.0, 0.0, 1.0]) / 2  # across 2.5 m, heading half a radian
    found = weak_directions("r1", pose, 0.01**2 * np.eye(3) + np.outer(swing, swing), 2.5, 0.5 / 1.01)
    assert found == ("its bearing from r1 with its heading",)


def test_what_is_not_known_at_all_is_weak() -> None:
    nan = 0.01 * np.eye(3)
    nan[2, :] = nan[:, 2] = np.nan
    assert weak_directions("r1", [5.0, 0.0, 0.0], nan, 1.0, 0.3) == ("its heading",)
    everything = weak_directions("r1", [5.0, 0.0, 0.0], np.full((3, 3), np.inf), 1.0, 0.3)
    assert sorted(everything) == ["its bearing from r1", "its distance from r1", "its heading"]


@given(st.floats(-pi, pi), st.floats(-pi, pi))
def test_directions_of_team_motions_are_named_in_the_references_terms(angle: float, heading: float) -> None:
    pose = np.array([6 * np.cos(angle), 6 * np.sin(angle), heading])
    away = se2.rotation(-heading) @ [np.cos(angle), np.sin(angle)]  # in the peer's own axes
    across = se2.rotation(pi / 2) @ away
    assert direction("r1", pose, [*away, 0.1]) == "its distance from r1"
    assert direction("r1", pose, [*-across, 0.1]) == "its bearing from r1"
    assert direction("r1", pose, [*(0.2 * away), -0.9]) == "its heading"
    assert direction("r1", pose, [*across, -1.0]) == "its bearing from r1 with its heading"


# ---- the mirror image ----


def driven(turns: Array, speed: float, rng: np.random.Generator) -> tuple[Array, float]:
    """A path as odometry tells it, noise of the paper's simulator on each 0.5 s step; and its wander."""
    motion = np.column_stack([np.full(len(turns), 0.5 * speed), np.zeros(len(turns)), 0.5 * turns])
    noisy = motion + rng.normal(size=motion.shape) * np.sqrt(np.diag(STEP_COVARIANCE))
    path = _core.chain(np.zeros(3), noisy)[:, :2]
    return path, odometry_wander(noisy, np.broadcast_to(STEP_COVARIANCE, (len(noisy), 3, 3)))


def test_wander_is_the_bend_that_noise_gives_a_straight_path() -> None:
    rng = np.random.default_rng(0)
    bends, wanders = [], []
    for _ in range(300):
        path, wander = driven(np.zeros(60), 1.0, rng)
        centred = path - path.mean(axis=0)
        bends.append(np.linalg.svd(centred, compute_uv=False)[1] ** 2 / len(path))
        wanders.append(wander**2)
    assert np.mean(bends) == pytest.approx(np.mean(wanders), rel=0.15)


@pytest.mark.parametrize(("steps", "speed"), [(20, 0.5), (60, 0.5), (60, 1.0)])
def test_straight_paths_are_known_as_straight_in_spite_of_noise(steps: int, speed: float) -> None:
    rng = np.random.default_rng(1)
    straight_on = [straight(*driven(np.zeros(steps), speed, rng)) for _ in range(200)]
    assert np.mean(straight_on) >= 0.95


@pytest.mark.parametrize(("speed", "turn"), [(0.5, 0.15), (1.0, 0.1), (1.0, -0.1)])
def test_bent_paths_are_not_straight(speed: float, turn: float) -> None:
    rng = np.random.default_rng(2)
    assert np.mean([straight(*driven(np.full(60, turn), speed, rng)) for _ in range(100)]) <= 0.05


def test_standing_is_straight_and_exact_paths_need_no_noise() -> None:
    assert straight(np.zeros((20, 2)), 0.0)
    assert straight(np.outer(np.arange(9.0), [3.0, 4.0]), 0.0)
    assert not straight(np.array([[0.0, 0], [1, 0], [2, 0.01]]), 0.0)
    assert straight(np.array([[0.0, 0], [1, 0]]), 0.0)
    assert odometry_wander(np.zeros((1, 3)), np.eye(3)[None]) == 0.0


def test_one_bent_path_ends_the_mirror_image() -> None:
    line, arc = np.outer(np.arange(9.0), [1.0, 0.0]), np.array([[t, t * t / 9] for t in range(9)])
    assert mirrored([line, line + 3, line @ se2.rotation(1.0).T], [0.01] * 3)
    assert not mirrored([line, line + 3, arc], [0.01] * 3)


# ---- what would help ----


def followed(who: str, what: str, twists: tuple[tuple[float, float], tuple[float, float]]) -> tuple[Array, Array]:
    """Paths (STEPS, 3) of ego and peer in their own frames when one follows a command, the other its twist."""
    v, omega = next(command[1:] for command in Limits().commands() if command[0] == what)
    both = [(v, omega) if who == name else twist for name, twist in zip(PAIR, twists, strict=True)]
    times = HORIZON / STEPS * np.arange(1, STEPS + 1)[:, None]
    ego, peer = (se2.exp(times * [v, 0.0, omega]) for v, omega in both)
    return ego, peer


def gained(pose: Array, information: Array, ego: Array, peer: Array, sigma: float) -> Array:
    """The two smallest eigenvalues (2,), by finite differences of the ranges; slight ones look alike."""

    def ranges(x: Array) -> Array:
        return np.linalg.norm(se2.transform(x, peer[:, :2]) - ego[:, :2], axis=1)

    step = 1e-6
    rows = np.transpose([(ranges(pose + step * e) - ranges(pose - step * e)) / (2 * step) for e in np.eye(3)]) / sigma
    units = np.diag([1.0, 1.0, 1.0 / np.hypot(*pose[:2])])
    return np.linalg.eigvalsh(units @ (information + rows.T @ rows) @ units)[:2] + 1e-3 * STEPS / sigma**2


poses = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3, 3)).map(np.array)
turning = st.tuples(st.floats(0.0, 0.5), st.floats(-0.5, 0.5))


@given(poses, st.tuples(turning, turning), st.integers(0, 2**31))
def test_the_recommended_command_is_the_best_of_all(
    pose: Array, twists: tuple[tuple[float, float], tuple[float, float]], seed: int
) -> None:
    assume(np.hypot(*pose[:2]) > 7.0)
    root = np.random.default_rng(seed).normal(size=(3, 3))
    information = 0.1 * root @ root.T
    said = resolve_by(PAIR, pose, information, 0.3, twists=twists)
    value = {
        f"{who}: {what}": gained(pose, information, *followed(who, what, twists), 0.3)
        for who in PAIR
        for what, _, _ in Limits().commands()
    }
    times = HORIZON / STEPS * np.arange(1, STEPS + 1)[:, None]
    ego, peer = (se2.exp(times * [v, 0.0, omega]) for v, omega in twists)
    unchanged = gained(pose, information, ego, peer, 0.3)
    best = np.max(list(value.values()), axis=0)
    if best[0] > 1.025 * unchanged[0]:
        assert value[said][0] >= best[0] / 1.025**2
    elif best[0] < 1.015 * unchanged[0]:  # λ_min cannot be helped
        assert value[said][1] >= best[1] / 1.025**2 if said else best[1] <= 1.025 * unchanged[1]


@given(poses)
def test_a_static_team_is_told_to_move(pose: Array) -> None:
    assume(np.hypot(*pose[:2]) > 1.0)
    said = resolve_by(PAIR, pose, 1e-6 * np.eye(3), 0.1)
    assert said
    assert not said.endswith("stand still")
    twists = ((0.0, 0.0), (0.0, 0.0))
    now, then = (
        gained(pose, 1e-6 * np.eye(3), *followed(*command, twists), 0.1)
        for command in (("r1", "stand still"), said.split(": "))
    )
    assert now[1] < 1.1
    assert then[1] > 2 * now[1]  # both standing: rank 1; one moving: rank 2


@given(poses, st.floats(0.2, 0.5), st.floats(0.2, 0.5))
def test_a_mirror_image_is_told_apart_by_a_turn(pose: Array, v_ego: float, v_peer: float) -> None:
    assume(abs(pose[1]) > 1.0)
    twists = ((v_ego, 0.0), (v_peer, 0.0))
    said = resolve_by(PAIR, pose, 100 * np.eye(3), 0.1, twists=twists, mirror=True)
    who, what = said.split(": ")
    assert "turn" in what or "circle" in what

    def apart(name: str, command: str) -> float:
        ego, peer = followed(name, command, twists)
        image = pose * [1.0, -1.0, -1.0]
        distance, other = (np.linalg.norm(se2.transform(x, peer[:, :2]) - ego[:, :2], axis=1) for x in (pose, image))
        return float(((distance - other) ** 2).sum())

    values = {(name, command[0]): apart(name, command[0]) for name in PAIR for command in Limits().commands()}
    assert values[who, what] >= max(values.values()) / 1.05**2
    assert apart("r1", "drive straight on") == pytest.approx(0.0, abs=1e-9)


def test_a_parallel_formation_is_told_to_leave_it() -> None:
    said = resolve_by(PAIR, [0.0, 8.0, 0.0], 1e-6 * np.eye(3), 0.1, twists=((0.5, 0.0), (0.5, 0.0)))
    assert "turn" in said or "circle" in said


def test_nothing_is_asked_for_what_is_known_or_out_of_reach() -> None:
    assert resolve_by(PAIR, [5.0, 2.0, 0.5], 1e6 * np.eye(3), 0.1) == ""
    assert resolve_by(PAIR, [5.0, 2.0, 0.5], np.zeros((3, 3)), 0.1, limits=Limits(0.0, 1.0)) == ""
    assert resolve_by(PAIR, [5.0, 0.0, 0.0], np.eye(3), 0.1, limits=Limits(0.0, 0.0), mirror=True) == ""


def test_readings_that_degrade_with_distance_count_for_less() -> None:
    """Far ranges tell nothing new where σ grows steeply: then nothing is worth it."""
    arguments = (PAIR, [6.0, 0.0, 1.0], np.diag([1.0, 1.0, 6.0**2]), 0.1)
    assert resolve_by(*arguments)
    assert resolve_by(*arguments, range_sigma_per_metre=10.0) == ""
