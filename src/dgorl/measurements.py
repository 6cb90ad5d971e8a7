"""What robots sense: one frozen dataclass per kind of measurement, checked when it is made.

Stamps are seconds on the log's (or team's) clock. Frames follow REP-103: x forward, y left, yaw counter-clockwise.
Robots are named by strings; ``WORLD`` is the member of every team that never moves (METHOD §1). Every constructor
raises ``MeasurementError`` for values that cannot be true.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from dgorl.errors import MeasurementError

WORLD = "world"

LARGEST = 1e10
"""No stamp [s], distance [m] or rate is larger: what is was meant in other units."""

LONGEST = 60.0
"""Odometry tells of at most this long a time [s] in one row."""

SMALLEST_SIGMA = 1e-6
"""No sensor is better [m, rad]."""

Covariance = tuple[float, float, float, float, float, float]
"""Upper triangle xx, xy, xθ, yy, yθ, θθ of a 3×3 covariance [m, rad]."""


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise MeasurementError(what)


def _finite(**values: float) -> None:
    for name, value in values.items():
        if not -LARGEST <= value <= LARGEST:
            if isfinite(value):
                raise MeasurementError(f"{name} must be within ±{LARGEST:.0e}, got {value}; units are s, m, rad, dBm")
            raise MeasurementError(f"{name} must be finite, got {value}")


def _pair(a: str, b: str) -> None:
    _require(bool(a) and bool(b), "robot names must not be empty")
    _require(a != b, f"a robot cannot measure itself: {a}")


def _interval(robot: str, start: float, end: float, epoch: int) -> None:
    if not 0 <= epoch < 2**53:
        raise MeasurementError(f"epoch must be a whole number from 0 to 2^53, got {epoch}")
    if not end > start:
        raise MeasurementError(f"odometry must end after it starts, got {start} to {end}")
    if end - start > LONGEST:
        raise MeasurementError(
            f"odometry over {end - start:.0f} s at once; give it in steps of at most {LONGEST:.0f} s"
        )
    if not robot or robot == WORLD:
        raise MeasurementError(f"not a robot's name: {robot!r}")


def check_covariance(values: Covariance) -> None:
    """Raises MeasurementError unless a matrix can be a covariance."""
    _require(len(values) == 6, f"covariance needs 6 values (xx, xy, xt, yy, yt, tt), got {len(values)}")
    xx, xy, xt, yy, yt, tt = values
    _finite(**dict(zip(("xx", "xy", "xt", "yy", "yt", "tt"), values, strict=True)))
    determinant = xx * (yy * tt - yt * yt) - xy * (xy * tt - yt * xt) + xt * (xy * yt - yy * xt)
    positive = xx > 0 and xx * yy - xy * xy > 0 and determinant > 0
    _require(positive, "covariance must be positive definite")
    least = SMALLEST_SIGMA**2
    _require(min(xx, yy, tt) >= least, f"variances must be at least {least}, got {min(xx, yy, tt)}")


@dataclass(frozen=True, slots=True)
class Odometry:
    """Twist of ``robot``'s body over [start, end]: v [m/s] forward, omega [rad/s].

    Raw as the wheels report it; scale and lag are the configuration's. ``epoch`` counts the times the robot lost its
    memory or was carried: poses before and after have nothing to do with one another.
    """

    robot: str
    start: float
    end: float
    v: float
    omega: float
    epoch: int = 0

    def __post_init__(self) -> None:
        _finite(start=self.start, end=self.end, v=self.v, omega=self.omega)
        _interval(self.robot, self.start, self.end, self.epoch)


@dataclass(frozen=True, slots=True)
class Displacement:
    """Motion of ``robot`` over [start, end] in its body frame at ``start``: (dx, dy) [m], dtheta [rad].

    ``covariance`` is that of (dx, dy, dtheta), in the frame at ``start``; without it the configuration's noise.
    """

    robot: str
    start: float
    end: float
    dx: float
    dy: float
    dtheta: float
    covariance: Covariance | None = None
    epoch: int = 0

    def __post_init__(self) -> None:
        _finite(start=self.start, end=self.end, dx=self.dx, dy=self.dy, dtheta=self.dtheta)
        _interval(self.robot, self.start, self.end, self.epoch)
        if self.covariance is not None:
            check_covariance(self.covariance)


@dataclass(frozen=True, slots=True)
class Rssi:
    """Signal strength of ``transmitter`` heard by ``receiver`` [dBm]."""

    transmitter: str
    receiver: str
    stamp: float
    dbm: float

    def __post_init__(self) -> None:
        _pair(self.transmitter, self.receiver)
        _finite(stamp=self.stamp, dbm=self.dbm)


@dataclass(frozen=True, slots=True)
class Range:
    """Distance between the antennas of ``robot`` (who measured) and ``peer`` [m].

    ``sigma`` [m] may be left to the configuration. ``exchange`` names a two-way exchange: when both ends report it,
    it counts once. The pair may use the number again after more than 5 s.
    """

    robot: str
    peer: str
    stamp: float
    range: float
    sigma: float | None = None
    exchange: int | None = None

    def __post_init__(self) -> None:
        _pair(self.robot, self.peer)
        _finite(stamp=self.stamp, range=self.range)
        _require(self.range >= 0, f"range must not be negative, got {self.range}")
        if self.sigma is not None:
            _finite(sigma=self.sigma)
            _require(self.sigma >= SMALLEST_SIGMA, f"sigma must be at least {SMALLEST_SIGMA}, got {self.sigma}")


@dataclass(frozen=True, slots=True)
class Bearing:
    """Direction from ``observer`` to ``target`` in the observer's body frame [rad], counter-clockwise from x."""

    observer: str
    target: str
    stamp: float
    bearing: float
    sigma: float | None = None

    def __post_init__(self) -> None:
        _pair(self.observer, self.target)
        _finite(stamp=self.stamp, bearing=self.bearing)
        if self.sigma is not None:
            _finite(sigma=self.sigma)
            _require(self.sigma >= SMALLEST_SIGMA, f"sigma must be at least {SMALLEST_SIGMA}, got {self.sigma}")


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Pose (x, y, theta) of ``robot`` in the frame of ``reference``: a measurement, or a known start (``prior``).

    ``covariance`` is in the tangent at the measured pose (right perturbation). A prior on ``WORLD`` places a robot in
    the log's start frame; it holds for the track that covers ``stamp``, or the first one to begin after it.
    """

    reference: str
    robot: str
    stamp: float
    x: float
    y: float
    theta: float
    covariance: Covariance
    prior: bool = False

    def __post_init__(self) -> None:
        _pair(self.reference, self.robot)
        _require(self.robot != WORLD, "the world has no pose of its own; name it as the reference")
        _require(self.prior or self.reference != WORLD, "only a prior may refer to the world")
        _finite(stamp=self.stamp, x=self.x, y=self.y, theta=self.theta)
        check_covariance(self.covariance)


ClockKey = tuple[str, int]
"""Whose clock a stamp is on: a robot and its epoch. A robot that lost its memory begins a new epoch, and clock."""


@dataclass(frozen=True, slots=True)
class ClockReading:
    """A message of ``peer`` that ``robot`` heard: ``sent`` on the peer's clock, ``received`` on the robot's own [s].

    Epochs are those of the clocks, 64 bits. A reading places clocks (METHOD §1), nothing else: no robot is measured.
    """

    robot: str
    epoch: int
    peer: str
    peer_epoch: int
    sent: float
    received: float

    def __post_init__(self) -> None:
        _pair(self.robot, self.peer)
        _finite(sent=self.sent, received=self.received)
        for epoch in (self.epoch, self.peer_epoch):
            _require(0 <= epoch < 2**64, f"a clock's epoch must be a whole number from 0 to 2^64, got {epoch}")


Measurement = Odometry | Displacement | Rssi | Range | Bearing | RelativePose


def known_at(measurement: Measurement) -> float:
    """The stamp at which a measurement is complete [s]: the end of its interval, or its stamp."""
    return measurement.end if isinstance(measurement, Odometry | Displacement) else measurement.stamp


def robots_of(measurement: Measurement) -> tuple[str, ...]:
    """The members a measurement speaks of, its author first."""
    match measurement:
        case Odometry() | Displacement():
            return (measurement.robot,)
        case Rssi():
            return (measurement.receiver, measurement.transmitter)
        case Range():
            return (measurement.robot, measurement.peer)
        case Bearing():
            return (measurement.observer, measurement.target)
        case RelativePose():
            return (measurement.reference, measurement.robot)
