"""Everything a simulated recording depends on. Fields carry the names of ``dgorl simulate``'s options."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from math import radians
from typing import Literal, get_args

import numpy as np

from dgorl.configuration import nearest
from dgorl.errors import ConfigurationError

Motion = Literal["random-walk", "formation", "straight", "static"]
Sensor = Literal["rssi", "range", "bearing"]

RSSI_AT_1M_DBM = -40.0
"""A of the path-loss model [dBm]."""
RANGE_EXCESS = 1.5
"""Mean excess of a range without line of sight [m]."""
RSSI_LOSS_DB = 6.0
"""Mean loss of a signal without line of sight [dB]."""
START_SIGMA = (0.05, 0.05, radians(1.0))
"""A known start is off by this much [m, m, rad]: the prior it is used with."""
MOVING_SIGMA = (0.1, 0.1, radians(0.5))
"""Noise of a step [m, m, rad]: the paper's."""
STANDING_SIGMA = (1e-3, 1e-3, 1e-3)
"""What the odometry of a standing team claims; it does not move at all [m, m, rad]."""


@dataclass(frozen=True)
class Teleport:
    """At ``stamp`` [s] the robot is carried ``metres`` away, and its odometry does not notice."""

    robot: str
    stamp: float
    metres: float


@dataclass(frozen=True)
class Scenario:
    """A team and its world; the defaults are the paper's."""

    # The first docstring and those of the fields are help texts of the command line. METHOD §9 has the defaults; a
    # value that cannot be raises ConfigurationError.

    robots: int = 5
    """number of robots, r1..rN"""
    area: float = 60.0
    """side of the square [0, area]² where robots start; walks and formations stay in it [m]"""
    steps: int = 100
    """number of time steps"""
    period: float = 0.5
    """length of a step [s]"""
    speed: float = 0.5
    """commanded speed [m/s]"""
    sensors: tuple[Sensor, ...] = ("rssi",)
    """what is measured between robots, each step from the first on"""
    range_sigma: float = 0.1
    """noise of ranges [m]"""
    bearing_sigma: float = 0.05
    """noise of bearings [rad]"""
    path_loss_exponent: float = 3.0
    """η"""
    shadowing_db: float = 2.0
    """σ_dB [dB]"""
    shadowing_correlation: float = 0.0
    """way after which shadowing is forgotten [m]; 0: every reading is independent"""
    reciprocity: float = 0.0
    """correlation ρ of the shadowing of a link's two directions"""
    comm_range: float = 40.0
    """robots farther apart than this neither hear nor see one another [m]"""
    motion: Motion = "random-walk"
    """random-walk: each its own; formation: one walk for all; straight: no turns; static: nobody moves"""
    nlos: float = 0.0
    """share of the readings without line of sight: ranges too long, signals too weak"""
    wheel_scale: float = 1.0
    """true motion = wheel_scale × reported"""
    wheel_lag: float = 0.0
    """true motion follows the reported one this much later [s]"""
    odometry_noise: float = 1.0
    """noise of a step, reported as such, in multiples of the paper's 0.1 m, 0.1 m, 0.5°"""
    teleport: str | None = None
    """NAME@T:METRES: at T [s] that robot is carried that far"""
    terrain: bool = False
    """also an elevation map and what an altimeter on each robot reads, for terrain relative navigation"""
    relief: float = 2.0
    """spread of the terrain's heights, 1σ [m]"""
    terrain_length: float = 10.0
    """way over which heights change: correlation length ℓ of exp(−d²/2ℓ²) [m]"""
    altimeter_sigma: float = 0.1
    """noise of altimeters [m]"""
    seed: int = 0
    """of everything drawn by chance"""

    def __post_init__(self) -> None:
        numbers: dict[str, float] = {f.name: getattr(self, f.name) for f in fields(self) if f.type == "float"}
        for name, value in numbers.items():
            _require(abs(value) < float("inf"), name, "a finite number", value)
        _require(self.robots >= 2, "robots", "at least 2", self.robots)
        _require(self.steps >= 1, "steps", "at least 1", self.steps)
        _require(self.seed >= 0, "seed", "0 or more", self.seed)
        shares, or_zero = ("reciprocity", "nlos"), ("speed", "shadowing_correlation", "wheel_lag")
        for name, value in numbers.items():
            if name in shares:
                _require(0 <= value <= 1, name, "from 0 to 1", value)
            elif name in or_zero:
                _require(value >= 0, name, "0 or more", value)
            else:
                _require(value > 0, name, "positive", value)
        _one_of("motion", self.motion, get_args(Motion))
        _require(len(self.sensors) > 0, "sensors", "at least one of rssi, range, bearing", "none")
        for sensor in self.sensors:
            _one_of("sensors", sensor, get_args(Sensor))
        if self.motion in ("random-walk", "formation"):
            needed = 4 * self.margin
            what = f"at least {needed:g} m, for robots of this speed and lag to turn at its border"
            _require(self.area >= needed, "area", what, self.area)
        self.carried()

    @property
    def names(self) -> tuple[str, ...]:
        """r1..rN."""
        return tuple(f"r{k}" for k in range(1, self.robots + 1))

    @property
    def odometry_sigma(self) -> tuple[float, float, float]:
        """Noise of a step that its odometry claims [m, m, rad]."""
        if self.motion == "static":
            return STANDING_SIGMA
        x, y, heading = (self.odometry_noise * sigma for sigma in MOVING_SIGMA)
        return x, y, heading

    @property
    def margin(self) -> float:
        """Robots turn this far from the border [m]: two steps, and room for noise."""
        return self.speed * (2 * self.period + self.wheel_lag) + 5 * self.odometry_noise * MOVING_SIGMA[0]

    def carried(self) -> Teleport | None:
        """``teleport``, parsed. Raises ConfigurationError."""
        if self.teleport is None:
            return None
        match = re.fullmatch(r"([^@]+)@([^:]+):(.+)", self.teleport)
        try:
            robot, stamp, metres = match.groups() if match else ("", "", "")
            teleport = Teleport(robot, float(stamp), float(metres))
        except ValueError:
            raise ConfigurationError(f"teleport must be NAME@T:METRES, like r2@20:5, got {self.teleport!r}") from None
        if robot not in self.names:
            raise ConfigurationError(f"teleport: no robot is called `{robot}`{nearest(robot, self.names)}")
        last = self.steps * self.period
        _require(0 < teleport.stamp <= last, "teleport", f"at a time from 0 to {last:g} s", self.teleport)
        _require(0 < teleport.metres < self.area, "teleport", f"less than {self.area:g} m far", self.teleport)
        return teleport

    def generator(self, stream: str) -> np.random.Generator:
        """The random numbers of one stream, named so that no sensor disturbs another's."""
        return np.random.default_rng([self.seed, *stream.encode()])


def _require(holds: bool, option: str, wanted: str, got: object) -> None:
    if not holds:
        raise ConfigurationError(f"{option} must be {wanted}, got {got}")


def _one_of(option: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConfigurationError(f"{option}: unknown `{value}`{nearest(value, known)}; known are {', '.join(known)}")
