"""How the robots move: what they are told, what they report, where they really are. METHOD §1, §9.

The paper's model, step by step: x⁺ = x + vΔt cosφ + n_x, y⁺ = y + vΔt sinφ + n_y, φ⁺ = φ + ωΔt + n_φ, while
the odometry reports (vΔt, 0, ωΔt).

random-walk: ω ~ U(−1, 1) rad/s each step. Where the step after this one would lead closer than ``margin``
to the border, ω is instead what turns the robot towards the middle within this step; the odometry reports
it like any other. formation: one random walk for all, who start with one heading and turn together.
straight: ω = 0, the border is ignored. static: nothing moves, not even by noise.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import floor

import numpy as np

from dgorl.errors import ConfigurationError
from dgorl.se2 import Array, wrap
from dgorl.simulation.scenario import Scenario

TURN_RATE = 1.0
"""Random walks turn at most this fast [rad/s], but at the border."""


@dataclass(frozen=True)
class Trajectories:
    """True and reported motion of all N robots.

    poses: (steps + 1, N, 3) in the world [m, m, rad]. twists: (steps, N, 2) reported v, ω [m/s, rad/s].
    """

    poses: Array
    twists: Array


def move(scenario: Scenario) -> Trajectories:
    """The team's true poses at every step and the twists its odometry reports."""
    lag = scenario.wheel_lag / scenario.period
    whole, part = floor(lag), lag - floor(lag)
    standing = np.zeros((scenario.robots, 2))
    pending = deque([standing] * (whole + 1), maxlen=whole + 1)
    walk = scenario.generator("commands")
    noise = _noise(scenario)
    poses, twists = [_start(scenario)], []
    carried, carry = scenario.carried(), scenario.generator("teleport")
    for step in range(scenario.steps):
        twists.append(_command(scenario, poses[-1], list(pending), part, walk))
        followed = pending.popleft()
        pending.append(twists[-1])
        pose = _advance(scenario, poses[-1], followed, part)
        pose = _advance(scenario, pose, pending[0], 1.0 - part) + noise[step]
        if carried is not None and step == _step_of(scenario, carried.stamp):
            robot = scenario.names.index(carried.robot)
            pose[robot] = _elsewhere(scenario, pose[robot], carried.metres, carry)
        pose[:, 2] = wrap(pose[:, 2])
        poses.append(pose)
    return Trajectories(np.array(poses), np.array(twists))


def _noise(scenario: Scenario) -> Array:
    """(steps, N, 3); each robot has its own stream, so that a larger team does not move the others."""
    if scenario.motion == "static":
        return np.zeros((scenario.steps, scenario.robots, 3))
    draws = [scenario.generator(f"motion {name}").normal(size=(scenario.steps, 3)) for name in scenario.names]
    return np.stack(draws, axis=1) * scenario.odometry_sigma


def _start(scenario: Scenario) -> Array:
    """Start poses (N, 3): anywhere inside the margin, formations in the middle half of the area."""
    draws = np.array([scenario.generator(f"start {name}").uniform(size=3) for name in scenario.names])
    edge = scenario.area / 4 if scenario.motion == "formation" else min(scenario.margin, scenario.area / 4)
    poses = np.empty_like(draws)
    poses[:, :2] = edge + draws[:, :2] * (scenario.area - 2 * edge)
    heading = draws[:1, 2] if scenario.motion == "formation" else draws[:, 2]
    poses[:, 2] = wrap(2 * np.pi * heading)
    return poses


def _command(scenario: Scenario, poses: Array, pending: list[Array], part: float, walk: np.random.Generator) -> Array:
    """Twists (N, 2) commanded now, to be followed after those pending."""
    twists = np.zeros((scenario.robots, 2))
    if scenario.motion == "static":
        return twists
    twists[:, 0] = scenario.speed
    if scenario.motion == "straight":
        return twists
    together = scenario.motion == "formation"
    draws = walk.uniform(-TURN_RATE, TURN_RATE, size=1 if together else scenario.robots)
    twists[:, 1] = draws
    # Where this command takes hold: once those still pending have been followed.
    begin = _advance(scenario, poses, pending[0], part)
    for earlier in pending[1:]:
        begin = _advance(scenario, begin, earlier, 1.0)
    end = _advance(scenario, begin, twists, 1.0)
    ahead = _advance(scenario, end, twists, 1.0)[:, :2]
    low, high = scenario.margin, scenario.area - scenario.margin
    leaving = np.any((ahead < low) | (ahead > high), axis=1)
    if together and leaving.any():
        middle = (end[:, :2].min(axis=0) + end[:, :2].max(axis=0)) / 2
        heading = np.arctan2(np.sin(begin[:, 2]).mean(), np.cos(begin[:, 2]).mean())
        twists[:, 1] = _turn(scenario, middle[None], np.array([heading]))
    elif leaving.any():
        twists[leaving, 1] = _turn(scenario, end[leaving, :2], begin[leaving, 2])
    return twists


def _turn(scenario: Scenario, positions: Array, headings: Array) -> Array:
    """The ω that turns within one step towards the middle of the area [rad/s]."""
    inward = scenario.area / 2 - positions
    return wrap(np.arctan2(inward[:, 1], inward[:, 0]) - headings) / scenario.period


def _advance(scenario: Scenario, poses: Array, twists: Array, part: float) -> Array:
    """Poses after ``part`` of a step with these reported twists, without noise."""
    way, turn = (twists * (scenario.wheel_scale * scenario.period * part)).T
    x, y, heading = poses.T
    return np.stack([x + way * np.cos(heading), y + way * np.sin(heading), heading + turn], axis=-1)


def _step_of(scenario: Scenario, stamp: float) -> int:
    """The step that ends at ``stamp`` or is the first to end after it."""
    return int(np.searchsorted(np.arange(1, scenario.steps + 1) * scenario.period, stamp))


def _elsewhere(scenario: Scenario, pose: Array, metres: float, carry: np.random.Generator) -> Array:
    """A pose ``metres`` away in a random direction, inside the area, with a random heading."""
    for _ in range(1000):
        direction, heading = carry.uniform(-np.pi, np.pi, size=2)
        place = pose[:2] + metres * np.array([np.cos(direction), np.sin(direction)])
        if np.all((place >= 0) & (place <= scenario.area)):
            return np.array([*place, heading])
    raise ConfigurationError(f"teleport: no place in the area is {metres:g} m away from the robot")
