"""Whether a robot's odometry jumps in time where the ranges that name it do not.

After a pause in its stamps a robot either drove on unseen, or its clock was set. What comes after tells: ranges to the
others fit its odometry as stamped, or as stamped earlier by the pause. The relative pose is free in both cases, so that
neither where the robots stand nor what was lost in the pause matters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dgorl import _core
from dgorl.configuration import Configuration
from dgorl.measurements import Displacement, Odometry, Range
from dgorl.se2 import Array

LEAST_STEP = 1.0
"""A pause is longer [s]."""
WINDOW = 30.0
"""So much after it is looked at [s]."""
READINGS = (12, 80)
"""A pair needs so many ranges in it; of more, these are spread over it."""
BETTER = 3.0
"""The misfit has to be so many times smaller with the clock set back."""
GOOD, BAD = 0.5, 0.2
"""... and small then, large before [m]."""
STARTS = 12
"""Headings and directions tried, each."""
STEPS = 25
"""Gauss–Newton steps from each of them."""
PAUSES = 4
"""The longest pauses of a robot that are looked at."""


@dataclass(frozen=True)
class Path:
    """A robot's odometry chained to a path: positions (T, 2) at stamps (T,); where it pauses, a new path begins."""

    stamps: Array
    positions: Array
    pauses: Array
    """(P, 2) from when to when nothing is known [s]"""

    def covers(self, first: float, last: float) -> bool:
        """Whether there is no pause from ``first`` to ``last`` [s]."""
        inside = self.stamps[0] <= first and last <= self.stamps[-1]
        return bool(inside and not np.any((self.pauses[:, 0] < last) & (self.pauses[:, 1] > first)))

    def at(self, stamps: Array) -> Array:
        """Positions (T, 2) at stamps (T,)."""
        return np.stack([np.interp(stamps, self.stamps, self.positions[:, k]) for k in (0, 1)], axis=1)


@dataclass(frozen=True)
class ClockStep:
    """``robot``'s odometry goes on after ``length`` [s] of pause from ``stamp`` [s] on as if there had been none.

    misfit: of the ranges [m], as stamped and as if there had been no pause.
    """

    robot: str
    stamp: float
    length: float
    misfit: tuple[float, float]


class Distance(NamedTuple):
    """A range as it is used [m]."""

    robot: str
    peer: str
    stamp: float
    metres: float


def path_of(rows: Sequence[Odometry | Displacement]) -> Path:
    """The path that a robot's rows, sorted by their starts, add up to."""
    stamps, deltas, pauses = [rows[0].start], [], []
    for m in rows:
        if m.start - stamps[-1] > LEAST_STEP:
            pauses.append((stamps[-1], m.start))
        if m.end <= stamps[-1]:
            continue
        share = (m.end - max(stamps[-1], m.start)) / (m.end - m.start)
        if m.start > stamps[-1]:
            stamps.append(m.start)
            deltas.append((0.0, 0.0, 0.0))
        deltas.append(_delta(m, share))
        stamps.append(m.end)
    positions = _core.chain(np.zeros(3), np.array(deltas))[:, :2]
    return Path(np.array(stamps), positions, np.array(pauses).reshape(-1, 2))


def clock_steps(paths: Mapping[str, Path], ranges: Sequence[Range], configuration: Configuration) -> list[ClockStep]:
    """The pauses that are steps of a clock, by robot."""
    ranging = configuration.ranging
    metres = [Distance(m.robot, m.peer, m.stamp, ranging.scale * m.range + ranging.offset) for m in ranges]
    found = []
    for robot, path in paths.items():
        own = [m for m in metres if robot in (m.robot, m.peer)]
        order = np.argsort(path.pauses[:, 0] - path.pauses[:, 1], kind="stable")
        for start, end in path.pauses[order[:PAUSES]]:
            step = _judged(robot, paths, own, (float(start), float(end)))
            if step is not None:
                found.append(step)
    return sorted(found, key=lambda step: (step.robot, step.stamp))


def _delta(m: Odometry | Displacement, share: float) -> tuple[float, float, float]:
    if isinstance(m, Odometry):
        length, turn = m.v * (m.end - m.start) * share, m.omega * (m.end - m.start) * share
        return length * np.cos(turn / 2), length * np.sin(turn / 2), turn
    return m.dx * share, m.dy * share, m.dtheta * share


def _judged(
    robot: str, paths: Mapping[str, Path], own: Sequence[Distance], pause: tuple[float, float]
) -> ClockStep | None:
    """Whether a pause is a step: the ranges fit without it, and fitted before it, but do not fit with it."""
    start, end = pause
    length = end - start
    stamped = [(m.stamp, m.stamp) for m in own]
    odometry_set = [(m.stamp + length, m.stamp) for m in own]
    all_set = [(m.stamp, m.stamp - length) if m.robot == robot else (m.stamp + length, m.stamp) for m in own]
    before = _misfits(robot, paths, own, stamped, (start - WINDOW, start))
    after = _misfits(robot, paths, own, stamped, (end, end + WINDOW))
    for moved in (odometry_set, all_set):
        without = _misfits(robot, paths, own, moved, (end, end + WINDOW))
        peers = sorted(before.keys() & after.keys() & without.keys())
        if not peers:
            continue
        usual, bad, good = (float(np.sqrt(np.mean([m[p] ** 2 for p in peers]))) for m in (before, after, without))
        if bad > BAD and good < GOOD and bad > BETTER * good and bad > BETTER * usual:
            return ClockStep(robot, start, length, (bad, good))
    return None


def _misfits(
    robot: str,
    paths: Mapping[str, Path],
    own: Sequence[Distance],
    stamps: Sequence[tuple[float, float]],
    window: tuple[float, float],
) -> dict[str, float]:
    """Peer → how badly its ranges to ``robot`` fit both paths [m], in a window of the robot's clock.

    stamps: of each range, on the robot's clock and on the peer's.
    """
    chosen: dict[str, list[tuple[float, float, float]]] = {}
    for m, (at_robot, at_peer) in zip(own, stamps, strict=True):
        if window[0] <= at_robot <= window[1]:
            peer = m.peer if m.robot == robot else m.robot
            chosen.setdefault(peer, []).append((at_robot, at_peer, m.metres))
    found = {}
    for peer, rows in chosen.items():
        if peer not in paths or len(rows) < READINGS[0]:
            continue
        at_robot, at_peer, distance = np.array(rows)[:: -(-len(rows) // READINGS[1])].T
        covered = [
            path.covers(float(t.min()) + 1e-3, float(t.max()) - 1e-3)
            for path, t in ((paths[robot], at_robot), (paths[peer], at_peer))
        ]
        if all(covered):
            found[peer] = _misfit(paths[peer].at(at_peer), paths[robot].at(at_robot), distance)
    return found


def _misfit(a: Array, b: Array, distance: Array) -> float:
    """The least misfit [m] of distances (K,) from points a (K, 2) to b (K, 2), moved rigidly; a tenth is left out."""
    b = b - b.mean(axis=0)
    angles = np.arange(STARTS) * 2 * np.pi / STARTS
    theta, direction = (x.ravel() for x in np.meshgrid(angles, angles))
    middle = a.mean(axis=0) + float(np.median(distance)) * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    pose = np.column_stack([middle, theta])
    for _ in range(STEPS):
        residual, jacobian = _residuals(pose, a, b, distance)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        normal += 1e-3 * np.eye(3) * (1.0 + np.trace(normal, axis1=1, axis2=2))[:, None, None] / 3
        gradient = jacobian.transpose(0, 2, 1) @ residual[:, :, None]
        pose = pose - np.linalg.solve(normal, gradient)[:, :, 0]
    square = np.sort(_residuals(pose, a, b, distance)[0] ** 2, axis=1)[:, : -(len(distance) // 10) or None]
    return float(np.sqrt(square.mean(axis=1).min()))


def _residuals(pose: Array, a: Array, b: Array, distance: Array) -> tuple[Array, Array]:
    """Residuals (S, K) [m] of poses (S, 3) and their derivatives (S, K, 3)."""
    c, s = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    turned = np.stack([c * b[:, 0] - s * b[:, 1], s * b[:, 0] + c * b[:, 1]], axis=2)
    apart = turned + pose[:, None, :2] - a
    length = np.maximum(np.linalg.norm(apart, axis=2), 1e-6)
    along = apart / length[:, :, None]
    turning = along[:, :, 1] * turned[:, :, 0] - along[:, :, 0] * turned[:, :, 1]
    return length - distance, np.concatenate([along, turning[:, :, None]], axis=2)
