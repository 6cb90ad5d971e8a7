"""What a robot tells those who watch: a short, signed bulletin a second. Monitors read it, robots do not.

On the wire places are whole mm, mrad and thousandths; the estimate itself leaves exactly, on the robot's own side
(:mod:`dgorl.team.report`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from math import isfinite, sqrt
from typing import Annotated

import msgspec
from msgspec import Meta

import dgorl
from dgorl.estimate import Status
from dgorl.logs.team import valid_name
from dgorl.measurements import LARGEST, WORLD
from dgorl.team.envelope import Reason, Rejected, decoded, unwrap, verify, wrap
from dgorl.team.keys import Roster, Signer
from dgorl.team.messages import Head
from dgorl.team.rates import Losses
from dgorl.team.report import Carried, Clock, Peer, Place, Pose, Report, Upper
from dgorl.team.transport import BULLETINS
from dgorl.team.wire import BITS_64, Text, short

EVERY = 1.0
"""Time between two bulletins [s]."""
LONGEST = 64
"""Letters of a name at most."""
PLACES = 4
"""So many places of an ambiguous peer are told, the most probable."""
WORDS = 200
"""Letters of a reason at most."""
NAMES = 512
"""Of anything at most so many are named."""
LARGEST_BULLETIN = 2**17
"""Bytes; 64 robots, all ambiguous, need less."""
FARTHEST = 10**9
"""Lengths [mm] and angles [mrad] beyond this are told as this."""

Small = Annotated[int, Meta(ge=-FARTHEST, le=FARTHEST)]
Words = Annotated[str, Meta(max_length=WORDS)]
Names = Annotated[list[Text], Meta(max_length=NAMES)]
_Spread = tuple[Small, Small, Small, Small, Small, Small]
"""σ of x, y [mm], theta [mrad], correlations xy, xt, yt [thousandths]"""


_Rates = tuple[Small | None, Small | None, Small | None]
"""bytes a second: sent, received, on the wire"""


class _Place(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    probability: Small
    pose: tuple[Small, Small, Small]
    spread: _Spread


class _Peer(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    robot: Text
    status: Status
    probability: Small
    age: float | None
    place: _Place | None
    reason: Words = ""
    resolve_by: Words = ""
    places: Annotated[list[_Place], Meta(max_length=PLACES)] = []


class _Bulletin(Head, frozen=True):
    version: Text
    peers: Annotated[list[_Peer], Meta(max_length=NAMES)]
    clocks: Annotated[list[tuple[Text, float, float, float]], Meta(max_length=NAMES)]
    losses: Annotated[list[tuple[Text, Small]], Meta(max_length=NAMES)]
    rates: _Rates
    rejected: Annotated[list[tuple[Text, int]], Meta(max_length=NAMES)]
    present: Names
    tick: Small


_bulletins = msgspec.msgpack.Decoder(_Bulletin)


@dataclass(frozen=True)
class Bulletin:
    """How ``robot`` fares at ``stamp`` [s], its own clock.

    version: of its dgorl. peers, clocks, rejected, present: as in its Report. losses: share of each robot's messages
    that it did not get, of those it hears itself. sent, received: payload bytes a second; wire: both, headers
    included; None in its first bulletin.
    tick: CPU time of an estimate [s].
    """

    robot: str
    epoch: int
    stamp: float
    number: int
    configuration: bytes
    version: str
    peers: Mapping[str, Peer]
    clocks: Mapping[str, Clock]
    losses: Mapping[str, float]
    sent: int | None
    received: int | None
    wire: int | None
    rejected: Mapping[str, int]
    present: frozenset[str]
    tick: float


class Bulletins:
    """Writes a robot's bulletins."""

    def __init__(self, team: str, robot: str, epoch: int, configuration: bytes, signer: Signer) -> None:
        self._head = team, robot, epoch
        self._configuration, self._signer = configuration, signer
        self._number = 0
        self._before: tuple[float, Carried] | None = None

    def due(self, report: Report, losses: Mapping[str, float], now: float) -> bytes | None:
        """The bulletin of a report, unless there was one within the last second. ``now``: the robot's clock [s]."""
        if self._before is not None and now - self._before[0] < EVERY:
            return None
        self._number = (self._number + 1) % Losses.MODULUS
        rates = _rates(self._before, now, report.traffic)
        self._before = now, report.traffic
        body = _Bulletin(
            *self._head,
            short(now),
            self._number,
            self._configuration,
            dgorl.__version__,
            [_peer(name, peer) for name, peer in report.peers.items()],
            [(name, clock.offset, clock.drift, clock.sigma) for name, clock in report.clocks.items()],
            [(name, _whole(1e3 * share)) for name, share in losses.items()],
            rates,
            [(reason[:LONGEST], count) for reason, count in report.rejected.items()][:NAMES],
            [name for name in report.present if len(name) <= LONGEST][:NAMES],
            _whole(1e6 * report.tick_s),
        )
        return wrap(BULLETINS, msgspec.msgpack.encode(body), self._signer)


def read_bulletin(payload: bytes, sender: str, roster: Roster) -> Bulletin:
    """``sender``'s bulletin, its signature checked, whatever its configuration. Raises Rejected."""
    signature, data = unwrap(payload, LARGEST_BULLETIN)
    body = decoded(_bulletins, data)
    check_head(body, sender, roster)
    verify(BULLETINS, sender, signature, data, roster)
    named = chain((peer.robot for peer in body.peers), body.present, (n for n, *_ in chain(body.clocks, body.losses)))
    if not all(name == WORLD or valid_name(name) for name in named):
        raise Rejected(Reason.MALFORMED, "a name that no robot can have")
    ages = (peer.age for peer in body.peers if peer.age is not None)
    if not all(map(isfinite, chain(ages, *(values for _, *values in body.clocks)))):
        raise Rejected(Reason.MALFORMED, "numbers that cannot be")
    return Bulletin(
        body.robot,
        body.epoch,
        float(body.stamp),
        body.number,
        body.configuration,
        body.version,
        {peer.robot: _told(peer) for peer in body.peers},
        {name: Clock(*values) for name, *values in body.clocks},
        {name: 1e-3 * share for name, share in body.losses},
        *body.rates,
        dict(body.rejected),
        frozenset(body.present),
        1e-6 * body.tick,
    )


def check_head(head: Head, sender: str, roster: Roster) -> None:
    """Raises Rejected unless it is of this team and by ``sender``, in a message that may be."""
    if head.team != roster.team:
        raise Rejected(Reason.TEAM, f"`{head.team}`, here `{roster.team}`")
    if head.robot != sender:
        raise Rejected(Reason.SENDER, f"{sender} sends as {head.robot}")
    if not -LARGEST <= head.stamp <= LARGEST or head.epoch >= BITS_64:
        raise Rejected(Reason.MALFORMED, "stamp or epoch that cannot be")


def _rates(before: tuple[float, Carried] | None, now: float, carried: Carried) -> _Rates:
    """Since ``before``, the time [s] of an earlier bulletin and what was carried until then."""
    if before is None:
        return None, None, None
    seconds, then = now - before[0], before[1]

    def rate(until: int | None, since: int | None) -> int | None:
        return None if until is None or since is None else _whole((until - since) / seconds)

    return (
        rate(carried.sent_bytes, then.sent_bytes),
        rate(carried.received_bytes, then.received_bytes),
        rate(carried.wire_bytes, then.wire_bytes),
    )


def _peer(name: str, peer: Peer) -> _Peer:
    place = None
    if peer.pose is not None and peer.covariance is not None:
        place = _place(peer.probability, peer.pose, peer.covariance)
    return _Peer(
        name,
        peer.status,
        _whole(1e3 * peer.probability),
        None if peer.age is None else round(peer.age, 2),
        place,
        peer.reason[:WORDS],
        peer.resolve_by[:WORDS],
        [_place(p.probability, p.pose, p.covariance) for p in peer.hypotheses[:PLACES]],
    )


def _place(probability: float, pose: Pose, covariance: Upper) -> _Place:
    xx, xy, xt, yy, yt, tt = covariance
    x, y, t = (sqrt(max(variance, 0.0)) for variance in (xx, yy, tt))

    def correlation(value: float, scale: float) -> int:
        return _whole(1e3 * value / scale) if scale > 0.0 else 0

    return _Place(
        _whole(1e3 * probability),
        (_whole(1e3 * pose[0]), _whole(1e3 * pose[1]), _whole(1e3 * pose[2])),
        (
            _whole(1e3 * x),
            _whole(1e3 * y),
            _whole(1e3 * t),
            correlation(xy, x * y),
            correlation(xt, x * t),
            correlation(yt, y * t),
        ),
    )


def _told(peer: _Peer) -> Peer:
    place = peer.place and _placed(peer.place)
    return Peer(
        place.pose if place else None,
        place.covariance if place else None,
        peer.status,
        1e-3 * peer.probability,
        peer.age,
        peer.reason,
        peer.resolve_by,
        tuple(map(_placed, peer.places)),
    )


def _placed(place: _Place) -> Place:
    x, y, theta = (1e-3 * value for value in place.pose)
    sx, sy, st, xy, xt, yt = (1e-3 * value for value in place.spread)
    upper = sx * sx, xy * sx * sy, xt * sx * st, sy * sy, yt * sy * st, st * st
    return Place(1e-3 * place.probability, (x, y, theta), upper)


def _whole(value: float) -> int:
    """The nearest whole number that may be told."""
    if not isfinite(value):
        return FARTHEST
    return round(min(max(value, -FARTHEST), FARTHEST))
