"""Tracks: each robot's trajectory in one epoch, as keyframes joined by preintegrated odometry. METHOD §1.

Whatever the order in which odometry arrives, the same set of it gives the same tracks, bit for bit: rows are kept in
canonical order and late ones rebuild the tracks. The core holds the steps; here are names and order.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import astuple
from typing import NamedTuple

import numpy as np

from dgorl import _core
from dgorl.configuration import Motion
from dgorl.measurements import Displacement, Odometry
from dgorl.se2 import Array

KEYFRAMES_PER_SECOND = 2
"""Keyframes stand at multiples of 0.5 s of the robot's clock."""

Row = tuple[float, ...]
"""start, end, epoch, 1 for a twist, its three values, six covariances: sorts canonically."""

_UNSTATED = (float("nan"),) * 6


class TrackKey(NamedTuple):
    """What names a track; sorting by it is the canonical order of members."""

    robot: str
    epoch: int
    begin: float


class Track(NamedTuple):
    """A track of the core under its name."""

    key: TrackKey
    core: _core.Track

    @property
    def end(self) -> float:
        """Until when odometry is known [s]."""
        return self.core.end


class Trail:
    """All tracks of one robot, from its odometry."""

    def __init__(self, robot: str, motion: Motion, silence: float) -> None:
        self.robot = robot
        self.tracks: list[Track] = []
        self.core = _core.Trail(motion_values(motion), silence)
        self._lag, self._stated = motion.lag, motion.stated_covariance
        self._rows: list[Row] = []

    def add(self, odometry: Sequence[Odometry | Displacement]) -> bool:
        """Take new odometry; True when it came in order, False when the tracks were rebuilt."""
        rows = sorted(odometry_row(m, self._stated) for m in odometry)
        in_order = not self._rows or rows[0][:4] > self._rows[-1][:4]
        if in_order:
            self._rows.extend(rows)
            self.core.extend(np.array(rows))
        else:
            for row in rows:
                bisect.insort(self._rows, row)
            self.core.restart()
            self.core.extend(np.array(self._rows))
        self._name()
        return in_order

    def at(self, stamp: float) -> Track | None:
        """The track that had begun by ``stamp``, the newest if several."""
        for track in reversed(self.tracks):
            if track.key.begin <= stamp:
                return track
        return None

    def forget(self, before: int) -> None:
        """Drop what ended before keyframe ``before``."""
        self.core.forget(before)
        stamp = self.core.tracks[0].first / KEYFRAMES_PER_SECOND - self._lag
        keep = bisect.bisect_right(self._rows, stamp, key=lambda row: row[1])
        del self._rows[: min(keep, len(self._rows) - 1)]
        self._name()

    def rewind(self, since: float) -> None:
        """Forget the odometry that ended after ``since`` [s]."""
        self._rows = [row for row in self._rows if row[1] <= since]
        self.core.restart()
        if self._rows:
            self.core.extend(np.array(self._rows))
        self._name()

    def _name(self) -> None:
        tracks = self.core.tracks
        if len(tracks) != len(self.tracks) or any(a is not b.core for a, b in zip(tracks, self.tracks, strict=True)):
            self.tracks = [Track(TrackKey(self.robot, track.epoch, track.begin), track) for track in tracks]


def motion_values(motion: Motion) -> Array:
    """The settings of a motion model (13,), as the core takes them."""
    return np.array(astuple(motion)[:13])


def odometry_row(m: Odometry | Displacement, stated: bool = True) -> Row:
    """A measurement as the core takes it; ``stated``: with the covariance it states of itself."""
    if isinstance(m, Odometry):
        return (m.start, m.end, m.epoch, 1.0, m.v, 0.0, m.omega, *_UNSTATED)
    return (m.start, m.end, m.epoch, 0.0, m.dx, m.dy, m.dtheta, *((stated and m.covariance) or _UNSTATED))
