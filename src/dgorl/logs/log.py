"""What every reader returns and every writer takes: one team's log, whatever its format."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dgorl.configuration import nearest
from dgorl.errors import LogError
from dgorl.measurements import (
    Bearing,
    ClockKey,
    ClockReading,
    Displacement,
    Measurement,
    Odometry,
    Range,
    RelativePose,
    Rssi,
)
from dgorl.se2 import Array
from dgorl.terrain import Altitude, Terrain


@dataclass(frozen=True)
class Start:
    """Where a robot stood at ``stamp`` [s] in the log's frame: pose (3,) [m, m, rad]."""

    stamp: float
    pose: tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """Measurements that became known together. clock: whose clock they are stamped on, None where all share one;
    readings of that clock against others came with them."""

    measurements: tuple[Measurement, ...]
    clock: ClockKey | None = None
    readings: tuple[ClockReading, ...] = ()


@dataclass(frozen=True)
class Step:
    """One tick of a live robot: what it admitted since the tick before, and when it looked, ``now`` [s] on its clock.

    started: the clock of its program if that began here, knowing nothing but what it admits now.
    """

    now: float
    admitted: tuple[Part, ...]
    started: ClockKey | None = None


@dataclass(frozen=True)
class Live:
    """What ``robot`` knew, and when: a replay follows these steps, not the stamps of the measurements."""

    robot: str
    steps: tuple[Step, ...]


@dataclass(frozen=True)
class Log:
    """A team's recording: measurements in the order they became known, and truth kept apart from them.

    truth: robot → (T, 4) of t, x, y, theta, rising t; empty where the log has none. Only
    :mod:`dgorl.evaluation` reads it. starts: the log's start poses, used by ``--initial known`` alone.
    configuration: nested settings the log itself states (radio, antennas, ...), over the defaults and under
    the user's. skipped: rows left out, by reason. rows: robot → rows of odometry in its file, where a reader counts
    them: a held twist makes several measurements. live: of a robot's journal, the order in which it learnt them.
    altitudes, terrain: for terrain relative navigation alone.
    """

    path: Path
    robots: tuple[str, ...]
    measurements: tuple[Measurement, ...]
    truth: Mapping[str, Array] = field(default_factory=lambda: MappingProxyType({}))
    starts: Mapping[str, Start] = field(default_factory=lambda: MappingProxyType({}))
    configuration: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    skipped: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    rows: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}), compare=False)
    live: Live | None = None
    altitudes: tuple[Altitude, ...] = ()
    terrain: Terrain | None = None


KINDS: Mapping[str, type[Range] | type[Bearing] | type[Rssi]] = MappingProxyType(
    {"range": Range, "bearing": Bearing, "rssi": Rssi}
)
"""The kinds of measurements between robots, by the names ``--measurements`` knows."""


def select(log: Log, kinds: Collection[str]) -> Log:
    """The log with odometry, relative poses and, of the other measurements, the named kinds alone.

    Raises LogError for a kind that does not exist or that the log has none of.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise LogError(log.path, None, f"no measurements are called `{kind}`{nearest(kind, KINDS)}")
    present = {name for name, kind in KINDS.items() if any(type(m) is kind for m in log.measurements)}
    for kind in kinds:
        if kind not in present:
            has = ", ".join(sorted(present)) or "none between robots"
            raise LogError(log.path, None, f"has no {kind} measurements; it has {has}")
    unwanted = tuple(kind for name, kind in KINDS.items() if name not in kinds)
    kept = _without(log.measurements, unwanted)
    return dataclasses.replace(log, measurements=kept, live=log.live and _live_without(log.live, unwanted))


def _live_without(live: Live, unwanted: tuple[type, ...]) -> Live:
    def kept(step: Step) -> Step:
        parts = (dataclasses.replace(p, measurements=_without(p.measurements, unwanted)) for p in step.admitted)
        return dataclasses.replace(step, admitted=tuple(parts))

    return dataclasses.replace(live, steps=tuple(kept(step) for step in live.steps))


def _without(measurements: Iterable[Measurement], unwanted: tuple[type, ...]) -> tuple[Measurement, ...]:
    return tuple(m for m in measurements if not isinstance(m, unwanted))


def in_order(measurements: Iterable[Measurement]) -> tuple[Measurement, ...]:
    """Sorted by the stamp at which they are known; ties by kind, names and values: there is one order."""
    return tuple(sorted(measurements, key=_order))


def _order(measurement: Measurement) -> tuple[Any, ...]:
    m = measurement
    match m:
        case Odometry():
            return (m.end, 0, m.robot, m.start, m.v, m.omega, m.epoch)
        case Displacement():
            return (m.end, 1, m.robot, m.start, m.dx, m.dy, m.dtheta, m.epoch, m.covariance or ())
        case Rssi():
            return (m.stamp, 2, m.transmitter, m.receiver, m.dbm)
        case Range():
            exchange = -1 if m.exchange is None else m.exchange
            return (m.stamp, 3, m.robot, m.peer, m.range, m.sigma or 0.0, m.exchange is not None, exchange)
        case Bearing():
            return (m.stamp, 4, m.observer, m.target, m.bearing, m.sigma or 0.0)
        case RelativePose():
            return (m.stamp, 5, m.reference, m.robot, m.x, m.y, m.theta, m.covariance, m.prior)
