"""Logs without a fault, of many kinds: their noise is exactly what the default configuration takes them to have.

The simulator of the package moves a team in steps of half a second with the paper's noise. This one shares no code with
it: wheels at 2 to 50 Hz, with the wheel noise of the configuration, and ranges or signal strength at their own rates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from pathlib import Path

import numpy as np

from dgorl import Configuration, Odometry, Range, Rssi, se2
from dgorl.logs.log import Log, in_order
from dgorl.measurements import Measurement
from dgorl.radio import range_to_rssi
from dgorl.se2 import Array

TURNS, CORRELATION = 0.35, 2.0
"""Spread of the turn rates [rad/s], and for how long one lasts [s]."""


@dataclass(frozen=True)
class CleanTeam:
    """Robots that wander in a square; wheels and hertz: rows of odometry and readings a pair has in a second."""

    seed: int
    robots: int
    seconds: float
    sensor: str
    """range or rssi"""
    wheels: float
    hertz: float
    sigma: float
    """of ranges [m]; of signal strength it is the configuration's"""
    area: float
    """side of the square [m]"""
    speed: float
    """mean [m/s]"""

    def log(self) -> Log:
        """What they measure, and the truth."""
        names = tuple(f"n{k + 1}" for k in range(self.robots))
        rng = np.random.default_rng([self.seed, 77])
        poses, twists = _driven(self, rng)
        dt = 1.0 / self.wheels
        stamps = np.arange(len(poses)) * dt
        measurements: list[Measurement] = []
        for k, twist in enumerate(twists):
            for name, (v, omega) in zip(names, twist.tolist(), strict=True):
                measurements.append(Odometry(name, float(stamps[k]), float(stamps[k + 1]), v, omega))
        every = max(round(self.wheels / self.hertz), 1)
        for k in range(every, len(poses), every):
            measurements += self._readings(names, poses[k], float(stamps[k]), rng)
        truth = {name: np.column_stack([stamps, poses[:, i]]) for i, name in enumerate(names)}
        return Log(Path(f"clean-{self.seed}"), names, in_order(measurements), truth)

    def _readings(
        self, names: Sequence[str], poses: Array, stamp: float, rng: np.random.Generator
    ) -> Iterator[Measurement]:
        """Every pair's range, or every link's signal strength in both directions."""
        radio = Configuration().radio
        pairs = combinations if self.sensor == "range" else permutations
        for i, j in pairs(range(len(names)), 2):
            distance, noise = float(np.hypot(*(poses[i] - poses[j])[:2])), float(rng.normal())
            if self.sensor == "range":
                yield Range(names[i], names[j], stamp, max(distance + self.sigma * noise, 0.0), self.sigma)
            else:
                yield Rssi(names[i], names[j], stamp, float(range_to_rssi(distance, radio)) + radio.sigma_db * noise)


def drawn(seed: int, seconds: float) -> CleanTeam:
    """A team drawn by chance: 2 to 6 robots, ranges of σ 0.03 to 0.3 m at 1 to 10 Hz, every third one's RSSI."""
    rng = np.random.default_rng([seed, 5])
    sensor = "rssi" if seed % 3 == 2 else "range"
    return CleanTeam(
        seed=seed,
        robots=int(rng.integers(2, 7)),
        seconds=seconds,
        sensor=sensor,
        wheels=float(rng.choice([2.0, 5.0, 10.0, 20.0, 50.0])),
        hertz=float(rng.choice([1.0, 2.0, 5.0, 10.0] if sensor == "range" else [1.0, 2.0])),
        sigma=float(np.exp(rng.uniform(np.log(0.03), np.log(0.3)))),
        area=float(np.exp(rng.uniform(np.log(8.0), np.log(40.0)))),
        speed=float(rng.uniform(0.2, 0.8)),
    )


def _driven(team: CleanTeam, rng: np.random.Generator) -> tuple[Array, Array]:
    """True poses (K + 1, n, 3) and the twists (K, n, 2) that odometry reports."""
    n, dt, centre = team.robots, 1.0 / team.wheels, team.area / 2
    motion = Configuration().motion
    poses = [np.column_stack([rng.uniform(0, team.area, (n, 2)), rng.uniform(-np.pi, np.pi, n)])]
    v, omega, twists = team.speed * rng.uniform(0.6, 1.2, n), np.zeros(n), []
    kept = np.exp(-dt / CORRELATION)
    for _ in range(round(team.seconds * team.wheels)):
        at = poses[-1]
        omega = kept * omega + TURNS * np.sqrt(1 - kept**2) * rng.normal(size=n)
        home = se2.wrap(np.arctan2(centre - at[:, 1], centre - at[:, 0]) - at[:, 2])
        outside = np.abs(at[:, :2] - centre).max(axis=1) > centre
        twist = np.column_stack([v, np.where(outside, np.clip(1.5 * home, -1, 1), omega)])
        way, turn = np.abs(twist * dt).T
        standing = motion.position_per_second**2 * dt
        variance = np.column_stack([
            standing + motion.forward_per_metre**2 * way,
            standing + motion.lateral_per_metre**2 * way,
            motion.heading_per_second**2 * dt + motion.heading_per_radian**2 * turn + motion.heading_per_metre**2 * way,
        ])  # fmt: skip
        told = se2.exp(np.column_stack([twist[:, 0], np.zeros(n), twist[:, 1]]) * dt)
        poses.append(se2.compose(se2.compose(at, told), np.sqrt(variance) * rng.normal(size=(n, 3))))
        twists.append(twist)
    return np.array(poses), np.array(twists)
