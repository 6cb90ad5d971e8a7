"""An agent's estimates as JSON lines: what leaves on stdout, on the loopback session and for monitors, and back."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite

import msgspec
import numpy as np

from dgorl.estimate import Estimate, PeerEstimate, PeerHypothesis, Status
from dgorl.se2 import Array

Pose = tuple[float, float, float]
"""x, y, theta [m, m, rad]"""
Upper = tuple[float, float, float, float, float, float]
"""xx, xy, xt, yy, yt, tt of a covariance"""
_UPPER = np.triu_indices(3)


class Place(msgspec.Struct, frozen=True):
    """Where an ambiguous peer may be."""

    probability: float
    pose: Pose
    covariance: Upper
    tangent_covariance: Upper | None = None


class Peer(msgspec.Struct, frozen=True):
    """A peer as :class:`dgorl.PeerEstimate` has it; ``age`` is null when nothing was heard."""

    pose: Pose | None
    covariance: Upper | None
    status: Status
    probability: float
    age: float | None
    reason: str
    resolve_by: str
    hypotheses: tuple[Place, ...] = ()
    tangent_covariance: Upper | None = None


class Clock(msgspec.Struct, frozen=True):
    """Team time = a robot's own time + offset [s], changing by drift [s/s]; sigma of the offset [s]."""

    offset: float
    drift: float
    sigma: float


class Carried(msgspec.Struct, frozen=True):
    """Payload the robot sent and received since it began. ``wire_bytes``: all it sent, to each peer anew and with all
    headers; null where nobody counts."""

    sent_messages: int
    sent_bytes: int
    received_messages: int
    received_bytes: int
    dropped: int
    wire_bytes: int | None
    bundles: int


class Report(msgspec.Struct, frozen=True, tag_field="type", tag="estimate"):
    """One line: ``robot``'s estimate at ``stamp`` [s], its own clock.

    data: bundles it was made of, as the ``data`` column says it. present: who is on the network. clocks: of all robots
    placed, where clocks are estimated. rejected: by reason, since it began. tick_s: CPU time the estimate took [s].
    final: the last one, made as the agent left.
    """

    robot: str
    stamp: float
    peers: dict[str, Peer]
    data: str
    present: tuple[str, ...]
    clocks: dict[str, Clock]
    traffic: Carried
    rejected: dict[str, int]
    tick_s: float
    final: bool = False

    def line(self) -> bytes:
        """JSON, without a line break."""
        return _encoder.encode(self)


class Complaint(msgspec.Struct, frozen=True, tag_field="type", tag="error"):
    """The answer to a line that says no measurement; the line's beginning is repeated."""

    what: str
    line: str

    def text(self) -> bytes:
        """JSON, without a line break."""
        return _encoder.encode(self)


_encoder = msgspec.json.Encoder()
_reports = msgspec.json.Decoder(Report)


def read_report(line: bytes) -> Report:
    """Raises msgspec.MsgspecError for anything else."""
    return _reports.decode(line)


def peers_of(estimate: Estimate) -> dict[str, Peer]:
    """The peers of an estimate, for a report."""
    return {name: _peer(peer) for name, peer in estimate.items()}


def clocks_of(estimate: Estimate) -> dict[str, Clock]:
    """Its clocks, for a report."""
    return {name: Clock(clock.offset, clock.drift, clock.sigma) for name, clock in estimate.clocks.items()}


def estimates_of(peers: Mapping[str, Peer]) -> dict[str, PeerEstimate]:
    """What :func:`peers_of` wrote, bit for bit."""
    return {
        name: PeerEstimate(
            None if p.pose is None else np.array(p.pose),
            None if p.covariance is None else _matrix(p.covariance),
            p.status,
            p.probability,
            inf if p.age is None else p.age,
            p.reason,
            p.resolve_by,
            tuple(map(_hypothesis, p.hypotheses)),
            None if p.tangent_covariance is None else _matrix(p.tangent_covariance),
        )
        for name, p in peers.items()
    }


def _peer(peer: PeerEstimate) -> Peer:
    return Peer(
        None if peer.pose is None else _pose(peer.pose),
        None if peer.covariance is None else _upper(peer.covariance),
        peer.status,
        float(peer.probability),
        float(peer.age) if isfinite(peer.age) else None,
        peer.reason,
        peer.resolve_by,
        tuple(map(_place, peer.hypotheses)),
        None if peer.tangent_covariance is None else _upper(peer.tangent_covariance),
    )


def _hypothesis(place: Place) -> PeerHypothesis:
    tangent = None if place.tangent_covariance is None else _matrix(place.tangent_covariance)
    return PeerHypothesis(place.probability, np.array(place.pose), _matrix(place.covariance), tangent)


def _place(h: PeerHypothesis) -> Place:
    tangent = None if h.tangent_covariance is None else _upper(h.tangent_covariance)
    return Place(float(h.probability), _pose(h.pose), _upper(h.covariance), tangent)


def _pose(pose: Array) -> Pose:
    x, y, theta = (float(value) for value in pose)
    return x, y, theta


def _upper(covariance: Array) -> Upper:
    xx, xy, xt, yy, yt, tt = (float(value) for value in covariance[_UPPER])
    return xx, xy, xt, yy, yt, tt


def _matrix(upper: Upper) -> Array:
    xx, xy, xt, yy, yt, tt = upper
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
