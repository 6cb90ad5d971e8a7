"""Bundles as bytes, lossless: every number that went in comes out bit for bit. The format stands in docs/live-team.md.

Stamps and peers' names are written once, in tables, and referred to by index: rows of odometry that follow on and
readings of one moment share them. Whole numbers are written as such, all others as float64.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from math import copysign
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from dgorl.errors import MeasurementError
from dgorl.measurements import (
    LARGEST,
    Bearing,
    ClockReading,
    Covariance,
    Displacement,
    Measurement,
    Odometry,
    Range,
    Rssi,
    known_at,
)
from dgorl.team.bundles import Bundle, Sealed, track_epoch
from dgorl.team.envelope import OVERHEAD, Reason, Rejected, decoded, unwrap, verify, wrap
from dgorl.team.keys import Roster, Signer

PURPOSE = "bundle"

ROWS = 1024
"""A bundle has at most so many rows of a kind."""

NAMES = 256
"""... and speaks of at most so many peers."""

BITS_64 = 2**64
NUMBERS = 2**53
"""Sequence numbers are below this."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a robot takes from the network [bytes]."""

    bundle: int = 8192
    """of a sealed bundle"""
    message: int = 32768
    """of a message"""


LIMITS = Limits()

Index = Annotated[int, Meta(ge=0, le=4 * ROWS)]
Whole = Annotated[int, Meta(ge=0)]
Text = Annotated[str, Meta(max_length=64)]
Many = Meta(max_length=ROWS)


class _Displacement(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, gc=False):
    start: Index
    end: Index
    dx: float
    dy: float
    dtheta: float
    covariance: Covariance | None = None


class _Range(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, gc=False):
    peer: Index
    stamp: Index
    range: float
    sigma: float | None = None
    exchange: int | None = None


class _Bearing(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, gc=False):
    target: Index
    stamp: Index
    bearing: float
    sigma: float | None = None


class Body(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """A bundle as it is written, its content not checked yet. What is left out at the end has its default."""

    team: Text
    robot: Text
    epoch: Whole
    sequence: Whole
    track: Whole
    cut: float
    stamps: Annotated[list[float], Meta(max_length=4 * ROWS)] = []
    names: Annotated[list[Text], Meta(max_length=NAMES)] = []
    twists: Annotated[list[tuple[Index, Index, float, float]], Many] = []
    displacements: Annotated[list[_Displacement], Many] = []
    rssi: Annotated[list[tuple[Index, Index, float]], Many] = []
    ranges: Annotated[list[_Range], Many] = []
    bearings: Annotated[list[_Bearing], Many] = []
    clocks: Annotated[list[tuple[Index, Whole, float, float]], Many] = []


_bodies = msgspec.msgpack.Decoder(Body)


def seal(bundle: Bundle, signer: Signer) -> Sealed:
    """The bundle with its signed bytes."""
    return Sealed(wrap(PURPOSE, encode(bundle), signer), bundle)


def open_sealed(data: bytes, roster: Roster, limits: Limits = LIMITS) -> Sealed:
    """The bundle in signed bytes. Raises Rejected: nothing of it may be used then."""
    signature, text = unwrap(data, limits.bundle)
    body = peek(text, roster)
    verify(PURPOSE, body.robot, signature, text, roster)
    return Sealed(data, content(body, roster))


def reopened(data: bytes) -> Sealed:
    """The bundle in signed bytes that were opened and checked before."""
    return Sealed(data, _bundle(decoded(_bodies, unwrap(data, len(data))[1])))


def peek(text: bytes, roster: Roster) -> Body:
    """The body before its signature is checked, of this team at least. Raises Rejected."""
    body = decoded(_bodies, text)
    if body.team != roster.team:
        raise Rejected(Reason.TEAM, f"`{body.team}`, here `{roster.team}`")
    if body.robot not in roster:
        raise Rejected(Reason.UNKNOWN, f"`{body.robot}` is not in the team file")
    if not (max(body.epoch, body.track) < BITS_64 and body.sequence < NUMBERS):
        raise Rejected(Reason.MALFORMED, "a number too large")
    return body


def content(body: Body, roster: Roster) -> Bundle:
    """What a body says. Raises Rejected (malformed), whole, if anything in it cannot be true."""
    try:
        bundle = _bundle(body)
    except (MeasurementError, IndexError) as error:
        raise Rejected(Reason.MALFORMED, str(error)) from error
    for name in body.names:
        if name not in roster:
            raise Rejected(Reason.UNKNOWN, f"{body.robot} measured `{name}`, which is not in the team file")
    if not -LARGEST <= bundle.cut <= LARGEST:
        raise Rejected(Reason.MALFORMED, "cut is no time")
    if any(known_at(m) > bundle.cut for m in bundle.measurements):
        raise Rejected(Reason.MALFORMED, "a row is stamped after the cut")
    return bundle


def size(bundle: Bundle) -> int:
    """Of the sealed bundle, at most [bytes]."""
    return len(encode(bundle)) + OVERHEAD


def encode(bundle: Bundle) -> bytes:
    """The body of a bundle."""
    stamps = _Table(chain.from_iterable(_stamps(m) for m in bundle.measurements))
    names = _Names(bundle)
    twists = [
        [stamps[m.start], stamps[m.end], short(m.v), short(m.omega)] for m in bundle.odometry if isinstance(m, Odometry)
    ]
    displacements = [
        _trimmed(
            [stamps[m.start], stamps[m.end], *map(short, (m.dx, m.dy, m.dtheta))],
            [m.covariance and [short(value) for value in m.covariance]],
        )
        for m in bundle.odometry
        if isinstance(m, Displacement)
    ]
    ranges = [
        _trimmed([names[m.peer], stamps[m.stamp], short(m.range)], [_maybe(m.sigma), m.exchange]) for m in bundle.ranges
    ]
    bearings = [
        _trimmed([names[m.target], stamps[m.stamp], short(m.bearing)], [_maybe(m.sigma)]) for m in bundle.bearings
    ]
    rssi = [[names[m.transmitter], stamps[m.stamp], short(m.dbm)] for m in bundle.rssi]
    clocks = [[names[c.peer], c.peer_epoch, short(c.sent), short(c.received)] for c in bundle.clocks]
    head = [bundle.team, bundle.robot, bundle.epoch, bundle.sequence, bundle.track, short(bundle.cut)]
    tables = [stamps.values, names.values, twists, displacements, rssi, ranges, bearings, clocks]
    return msgspec.msgpack.encode(_trimmed(head, tables))


def short(value: float) -> float | int:
    """The shortest of equal numbers: a whole one is written as such, except −0.0."""
    value = float(value)
    whole = value.is_integer() and abs(value) < 2**53 and (value != 0 or copysign(1.0, value) > 0)
    return int(value) if whole else value


def _bundle(body: Body) -> Bundle:
    me, epoch = body.robot, track_epoch(body.epoch, body.track)
    t, names = body.stamps, body.names
    twists = (Odometry(me, t[s], t[e], v, omega, epoch) for s, e, v, omega in body.twists)
    displacements = (
        Displacement(me, t[d.start], t[d.end], d.dx, d.dy, d.dtheta, d.covariance, epoch) for d in body.displacements
    )
    return Bundle(
        body.team,
        me,
        body.epoch,
        body.sequence,
        body.track,
        body.cut,
        (*twists, *displacements),
        tuple(Rssi(names[peer], me, t[at], dbm) for peer, at, dbm in body.rssi),
        tuple(Range(me, names[r.peer], t[r.stamp], r.range, r.sigma, r.exchange) for r in body.ranges),
        tuple(Bearing(me, names[b.target], t[b.stamp], b.bearing, b.sigma) for b in body.bearings),
        tuple(ClockReading(me, body.epoch, names[c[0]], *c[1:]) for c in body.clocks),
    )


class _Table:
    """Distinct stamps in order; −0.0 is not 0.0."""

    def __init__(self, stamps: Iterable[float]) -> None:
        distinct = sorted({(float(stamp), copysign(1.0, stamp)) for stamp in stamps})
        self.values = [short(stamp) for stamp, _ in distinct]
        self._index = {key: index for index, key in enumerate(distinct)}

    def __getitem__(self, stamp: float) -> int:
        return self._index[float(stamp), copysign(1.0, stamp)]


class _Names:
    """Peers a bundle speaks of."""

    def __init__(self, bundle: Bundle) -> None:
        peers = {m.transmitter for m in bundle.rssi} | {m.peer for m in bundle.ranges}
        peers |= {m.target for m in bundle.bearings} | {c.peer for c in bundle.clocks}
        self.values = sorted(peers)
        self._index = {name: index for index, name in enumerate(self.values)}

    def __getitem__(self, name: str) -> int:
        return self._index[name]


def _stamps(m: Measurement) -> tuple[float, ...]:
    return (m.start, m.end) if isinstance(m, Odometry | Displacement) else (m.stamp,)


def _maybe(value: float | None) -> float | None:
    return None if value is None else short(value)


def _trimmed(head: list[Any], rest: list[Any]) -> list[Any]:
    """What stands at the end and says nothing is left out."""
    while rest and (rest[-1] is None or rest[-1] == []):
        rest = rest[:-1]
    return head + rest
