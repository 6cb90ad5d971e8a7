"""What is not known of a peer, in words, and the motion that would tell: ``reason`` and ``resolve_by``. METHOD §3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike

from dgorl import se2
from dgorl.observability import quarter_turn
from dgorl.se2 import Array

MIRROR = "side (mirror image)"

TAKES_PART = 0.45
"""A direction is named by its parts of at least this share of the largest one."""

BENT = 2.0
"""A path is straight while it bends by less than this many times what odometry noise bends it."""

HORIZON = 10.0
"""Seconds a command is followed."""

STEPS = 10
"""Ranges taken in that time."""

WORTH = 1.02
"""A command replaces one before it in the list for at least this much more information: no coin is tossed."""

SLIGHT = 1e-3
"""Eigenvalues are compared above this share of what all those ranges could add: what is less decides nothing."""


# ---- in words ----


def weak_directions(
    ego: str, pose: ArrayLike, covariance: ArrayLike, position_limit: float, heading_limit: float
) -> tuple[str, ...]:
    """What of a peer is known worse than the limits [m, rad] from its pose (3,) in the ego's frame, worst first.

    covariance: (3, 3) of (x, y, theta) in the ego's frame; infinite or NaN entries: nothing known there. Each is like
    "its heading" or "its bearing from r1 with its heading".
    """
    x, y, _ = np.asarray(pose, dtype=float)
    turn = _polar(x, y) / np.array([position_limit, position_limit, heading_limit])[:, None]
    p = np.array(covariance, dtype=float)
    unknown = ~np.isfinite(np.diag(p))
    p[unknown, :] = p[:, unknown] = 0.0
    p[unknown, unknown] = 1e12
    values, vectors = np.linalg.eigh(turn @ p @ turn.T)
    worst = [k for k in np.argsort(-values) if values[k] > 1.0]
    return tuple(dict.fromkeys(_named(ego, vectors[:, k]) for k in worst))


def direction(ego: str, pose: ArrayLike, motion: ArrayLike) -> str:
    """A motion (3,) of a peer at ``pose`` (3,) in the ego's frame, in words.

    motion: along the peer's own body axes [m] and heading × scale [m], as in
    :class:`~dgorl.observability_information.Weakness`.
    """
    x, y, theta = np.asarray(pose, dtype=float)
    moved = np.array(motion, dtype=float)
    moved[:2] = se2.rotation(theta) @ moved[:2]
    return _named(ego, _polar(x, y) @ moved)


def _polar(x: float, y: float) -> Array:
    """(3, 3): motion along x, y to one along and across the line of sight; heading as it is."""
    d = hypot(x, y)
    c, s = (x / d, y / d) if d > 0 else (1.0, 0.0)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _named(ego: str, along: Array) -> str:
    """along: shares of distance, bearing and heading."""
    words = (f"its distance from {ego}", f"its bearing from {ego}", "its heading")
    size = np.abs(along)
    parts = [k for k in range(3) if size[k] >= TAKES_PART * size.max()]
    return " with ".join(words[k] for k in parts)


# ---- the mirror image ----


def odometry_wander(delta: Array, covariance: Array) -> float:
    """How far odometry noise alone bends a path of K steps off a straight line, root mean square [m].

    delta: (K, 3) motion between successive poses, covariance: (K, 3, 3) of it. Lateral noise adds up, heading noise
    swings all that follows; what a shift and a turn of the whole path make up for does not count.
    """
    count = len(delta)
    if count < 2:
        return 0.0
    way = np.concatenate([[0.0], np.cumsum(np.hypot(delta[:, 0], delta[:, 1]))])
    after = np.arange(count + 1)[:, None] > np.arange(count)  # step k moves the points after it
    lever = np.where(after, way[:, None] - way[:-1], 0.0)
    line, _ = np.linalg.qr(np.column_stack([np.ones(count + 1), way if way[-1] > 0 else np.arange(count + 1)]))
    bend = np.stack([after.astype(float), lever], axis=-1)
    bend -= np.tensordot(line, np.tensordot(line, bend, (0, 0)), 1)
    spread = (np.einsum("tka,tkb->kab", bend, bend) * covariance[:, 1:, 1:]).sum()
    return sqrt(max(float(spread), 0.0) / (count + 1))


def straight(path: Array, wander: float) -> bool:
    """Whether a robot's path (K, 2) [m] is a straight line, or a point, as far as odometry noise lets one tell.

    The second singular value of the centred path, root mean square, against ``BENT`` × wander [m] (from
    :func:`odometry_wander`).
    """
    if len(path) < 3:
        return True
    second = np.linalg.svd(path - path.mean(axis=0), compute_uv=False)[1] / sqrt(len(path))
    return bool(second <= max(BENT * wander, 1e-9))


def mirrored(paths: Sequence[Array], wander: Sequence[float]) -> bool:
    """Whether the mirror image of the team fits as well, whatever ranges are measured: every path is straight."""
    return all(straight(path, noise) for path, noise in zip(paths, wander, strict=True))


# ---- what would help ----

Command = tuple[str, float, float]
"""Text, v [m/s], ω [rad/s]."""


@dataclass(frozen=True)
class Limits:
    """What a robot can do: speed [m/s], turn rate [rad/s]."""

    speed: float = 0.5
    turn_rate: float = 1.0

    def commands(self) -> tuple[Command, ...]:
        """The feasible ones, those that ask least first."""
        turn, circle = min(pi / 2 / HORIZON, self.turn_rate), min(2 * pi / HORIZON, self.turn_rate)
        return (
            ("stand still", 0.0, 0.0),
            ("drive straight on", self.speed, 0.0),
            ("turn left while moving", self.speed, turn),
            ("turn right while moving", self.speed, -turn),
            ("drive a circle", self.speed, circle),
        )


def resolve_by(
    names: tuple[str, str],
    pose: ArrayLike,
    information: ArrayLike,
    range_sigma: float,
    *,
    limits: Limits | None = None,
    twists: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0)),
    range_sigma_per_metre: float = 0.0,
    mirror: bool = False,
) -> str:
    """The command to one of a pair that tells most of their relative pose, like ``r3: turn left while moving``.

    names: ego and peer. pose: T_ego_peer (3,). information: (3, 3) of (x, y, theta) in the ego's frame, what is known
    already. Each second of the next 10 s a range of σ ``range_sigma`` + ``range_sigma_per_metre`` · distance [m] is
    taken, while one robot follows the command and the other keeps its twist (v [m/s], ω [rad/s]) of ``twists``; best is
    the largest λ_min of the information on x, y and heading × distance. While the other stands, no command of one alone
    raises λ_min (rank 2); best is then the largest second eigenvalue. Empty if nothing helps.

    mirror: all has gone straight, and the image mirrored in the ego's line of travel, which no local information knows
    of, is alive. Best is then what tells the two apart, Σ (d − d')²/σ² of their ranges. METHOD §3.
    """
    commands = (limits or Limits()).commands()
    T_ego_peer, count = np.asarray(pose, dtype=float), len(commands)
    driven = np.array([command[1:] for command in commands])
    told = np.array(twists, dtype=float)
    twist_ego = np.concatenate([driven, np.broadcast_to(told[0], (count, 2)), told[:1]])
    twist_peer = np.concatenate([np.broadcast_to(told[1], (count, 2)), driven, told[1:]])
    path_ego, path_peer = _path(twist_ego), _path(twist_peer)
    there = se2.transform(T_ego_peer, path_peer)
    line, moved = there - path_ego, there - T_ego_peer[:2]
    distance = np.maximum(np.linalg.norm(line, axis=-1), 0.1)
    sigma = range_sigma + range_sigma_per_metre * distance
    if mirror:
        image = se2.transform(T_ego_peer * [1.0, -1.0, -1.0], path_peer)
        apart = np.linalg.norm(image - path_ego, axis=-1) - distance
        return _best(names, commands, ((apart / sigma) ** 2).sum(axis=-1))
    u = line / distance[..., None]
    scale = max(hypot(*T_ego_peer[:2]), 0.1)
    rows = np.concatenate([u, (u * quarter_turn(moved)).sum(axis=-1, keepdims=True) / scale], axis=-1)
    rows /= sigma[..., None]
    units = np.array([1.0, 1.0, 1.0 / scale])
    known = np.asarray(information, dtype=float) * np.outer(units, units)
    least = SLIGHT * STEPS / float(sigma.min()) ** 2
    weakest, second, _ = np.linalg.eigvalsh(known + rows.transpose(0, 2, 1) @ rows).T + least
    return _best(names, commands, weakest) or _best(names, commands, second)


def _best(names: tuple[str, str], commands: Sequence[Command], values: Array) -> str:
    """The command of largest value: first the ego's, then the peer's; the last is what comes if nothing changes."""
    best, value = -1, WORTH * max(float(values[-1]), 1e-9)
    for k, found in enumerate(values[:-1].tolist()):
        if found > value:
            best, value = k, WORTH * found
    return "" if best < 0 else f"{names[best // len(commands)]}: {commands[best % len(commands)][0]}"


def _path(twists: Array) -> Array:
    """Positions (C, STEPS, 2) of robots that follow twists (C, 2) from the origin, at the end of each step."""
    times = HORIZON / STEPS * np.arange(1, STEPS + 1)
    half = twists[:, 1:] * times / 2
    chord = twists[:, :1] * times * np.sinc(half / pi)
    return np.stack([chord * np.cos(half), chord * np.sin(half)], axis=-1)
