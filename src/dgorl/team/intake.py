"""A robot's own measurements as JSON lines, one object a line.

`{"type":"odometry","start","end","v","omega"}` ·
`{"type":"displacement","start","end","dx","dy","dtheta"[,"covariance"]}` ·
`{"type":"rssi","stamp","transmitter","dbm"}` · `{"type":"range","stamp","peer","range"[,"sigma"][,"exchange"]}` ·
`{"type":"bearing","stamp","peer","bearing"[,"sigma"]}` · `{"type":"moved","stamp"}`.
Stamps are seconds on the robot's own clock; the units are those of :mod:`dgorl.measurements`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import msgspec

from dgorl.configuration import nearest
from dgorl.errors import MeasurementError
from dgorl.measurements import (
    LARGEST,
    Bearing,
    Covariance,
    Displacement,
    Measurement,
    Odometry,
    Range,
    Rssi,
    known_at,
)

LONGEST_LINE = 4096
"""No measurement needs more bytes."""

AHEAD = 10.0
"""A stamp farther ahead of the robot's clock than this [s] is on another clock."""


@dataclass(frozen=True, slots=True)
class Moved:
    """The robot was carried at ``stamp`` [s]: what it knew of its own pose holds no longer."""

    stamp: float


class _Line(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type"):
    """One line; the tag is its type."""


class _Odometry(_Line, frozen=True, tag="odometry"):
    start: float
    end: float
    v: float
    omega: float


class _Displacement(_Line, frozen=True, tag="displacement"):
    start: float
    end: float
    dx: float
    dy: float
    dtheta: float
    covariance: Covariance | None = None


class _Rssi(_Line, frozen=True, tag="rssi"):
    stamp: float
    transmitter: str
    dbm: float


class _Range(_Line, frozen=True, tag="range"):
    stamp: float
    peer: str
    range: float
    sigma: float | None = None
    exchange: int | None = None


class _Bearing(_Line, frozen=True, tag="bearing"):
    stamp: float
    peer: str
    bearing: float
    sigma: float | None = None


class _Moved(_Line, frozen=True, tag="moved"):
    stamp: float


_lines = msgspec.json.Decoder(_Odometry | _Displacement | _Rssi | _Range | _Bearing | _Moved)


def read_line(
    line: bytes, robot: str, team: Collection[str], now: float, history: float, ahead: float = 0.0
) -> Measurement | Moved:
    """What a line says that ``robot`` measured.

    team: all robots' names. now: the robot's clock [s]. history: what is older than this [s] is of no use any more.
    ahead: how far the clock that made the stamps is ahead of the robot's [s].
    Raises MeasurementError saying what is wrong with it.
    """
    if len(line) > LONGEST_LINE:
        raise MeasurementError(f"a line of {len(line)} bytes; measurements take at most {LONGEST_LINE}")
    try:
        said = _lines.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise MeasurementError(str(error)) from error
    measured = _measured(_steady(said, ahead) if ahead else said, robot)
    peer = getattr(said, "peer", getattr(said, "transmitter", None))
    if peer is not None and peer not in team:
        raise MeasurementError(f"`{peer}` is not in the team file{nearest(peer, team)}")
    stamp = measured.stamp if isinstance(measured, Moved) else known_at(measured)
    if not now - history <= stamp <= now + AHEAD:
        where = "ahead of" if stamp > now else "behind"
        raise MeasurementError(f"stamp {stamp} is {abs(stamp - now):.1f} s {where} this robot's clock, {now:.3f} s")
    return measured


def line_of(measurement: Measurement | Moved) -> bytes:
    """The line that says it, without a line break; :func:`read_line` gives the same back.

    The epoch of odometry is not said: an agent knows it. Raises MeasurementError for relative poses, which no line can
    say.
    """
    match measurement:
        case Odometry(_, start, end, v, omega):
            said: _Line = _Odometry(start, end, v, omega)
        case Displacement(_, start, end, dx, dy, dtheta, covariance):
            said = _Displacement(start, end, dx, dy, dtheta, covariance)
        case Rssi(transmitter, _, stamp, dbm):
            said = _Rssi(stamp, transmitter, dbm)
        case Range(_, peer, stamp, distance, sigma, exchange):
            said = _Range(stamp, peer, distance, sigma, exchange)
        case Bearing(_, target, stamp, bearing, sigma):
            said = _Bearing(stamp, target, bearing, sigma)
        case Moved(stamp):
            said = _Moved(stamp)
        case _:
            raise MeasurementError("a robot's own measurements are odometry, RSSI, ranges and bearings")
    return msgspec.json.encode(said)


def _steady(said: _Line, ahead: float) -> _Line:
    """The line with its stamps on the robot's clock."""
    stamps = {name: getattr(said, name) - ahead for name in ("start", "end", "stamp") if hasattr(said, name)}
    return msgspec.structs.replace(said, **stamps)


def _measured(said: object, robot: str) -> Measurement | Moved:
    match said:
        case _Odometry():
            return Odometry(robot, said.start, said.end, said.v, said.omega)
        case _Displacement():
            return Displacement(robot, said.start, said.end, said.dx, said.dy, said.dtheta, said.covariance)
        case _Rssi():
            return Rssi(said.transmitter, robot, said.stamp, said.dbm)
        case _Range():
            return Range(robot, said.peer, said.stamp, said.range, said.sigma, said.exchange)
        case _Bearing():
            return Bearing(robot, said.peer, said.stamp, said.bearing, said.sigma)
        case _Moved():
            if not abs(said.stamp) <= LARGEST:
                raise MeasurementError(f"stamp must be a time in seconds, got {said.stamp}")
            return Moved(said.stamp)
    raise AssertionError(said)
