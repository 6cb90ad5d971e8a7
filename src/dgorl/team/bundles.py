"""Bundles: what one robot measured and heard in one tick, immutable, signed by it. METHOD §6, wire format in `wire`."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import blake2b
from typing import NamedTuple

from dgorl.measurements import Bearing, ClockReading, Displacement, Measurement, Odometry, Range, Rssi


class Name(NamedTuple):
    """Names a bundle: its origin, the origin's epoch (64 bit), its number in that epoch."""

    robot: str
    epoch: int
    sequence: int


@dataclass(frozen=True)
class Bundle:
    """All that ``robot`` learnt between two cuts. Stamps are on its own clock [s].

    epoch: 64 random bits, made when its journal was new. sequence: 0, 1, 2... in the epoch. track: how often it was
    carried in this epoch. cut: when the bundle was made; no row is stamped later.
    Odometry holds twists before displacements, its ``epoch`` being :func:`track_epoch` of this bundle. clocks: messages
    of peers this robot heard.
    """

    team: str
    robot: str
    epoch: int
    sequence: int
    track: int
    cut: float
    odometry: tuple[Odometry | Displacement, ...] = ()
    rssi: tuple[Rssi, ...] = ()
    ranges: tuple[Range, ...] = ()
    bearings: tuple[Bearing, ...] = ()
    clocks: tuple[ClockReading, ...] = ()

    @property
    def name(self) -> Name:
        """What no other bundle of the team is called."""
        return Name(self.robot, self.epoch, self.sequence)

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """All measurements in it, for a Localizer."""
        return (*self.odometry, *self.rssi, *self.ranges, *self.bearings)


@dataclass(frozen=True, slots=True)
class Sealed:
    """A bundle with the signed bytes that travel; ``data`` decodes to ``bundle`` exactly."""

    data: bytes
    bundle: Bundle

    @property
    def name(self) -> Name:
        """The bundle's."""
        return self.bundle.name


def track_epoch(epoch: int, track: int) -> int:
    """The ``Odometry.epoch`` of a track: 53 bits of a hash of epoch and track."""
    digest = blake2b(epoch.to_bytes(8, "big") + track.to_bytes(8, "big"), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 11
