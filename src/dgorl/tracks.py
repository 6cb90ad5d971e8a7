"""Tracks: each robot's trajectory in one epoch, as keyframes joined by preintegrated odometry. METHOD §1.

Whatever the order in which odometry arrives, the same set of it gives the same tracks, bit for bit: rows are kept in
canonical order and late ones rebuild the tracks. The core holds the steps; here are names and order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dgorl import _core
from dgorl.columns import Column
from dgorl.configuration import Motion
from dgorl.measurements import Displacement, Odometry
from dgorl.se2 import Array

KEYFRAMES_PER_SECOND = 2
"""Keyframes stand at multiples of 0.5 s of the robot's clock."""

HELD = 1.0
"""Odometry missing for longer [s] is a gap: it ends the track."""

Row = tuple[float, ...]
"""start, end, epoch, 1 for a twist, its three values, six covariances: sorts canonically."""

_UNSTATED = (float("nan"),) * 6
WIDE, NARROW = 13, 7
"""Numbers of a row, and of one that states no covariance."""


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

    def __init__(self, robot: str, motion: Motion) -> None:
        self.robot = robot
        self.tracks: list[Track] = []
        self._motion, self._lag, self._stated = motion_values(motion), motion.lag, motion.stated_covariance
        self.core = _core.Trail(self._motion)
        self.jumps = 0
        """rows taken that are no motion, faster than the limits allow by far"""
        self._rows = Column((NARROW,))

    def has(self, m: Odometry | Displacement) -> bool:
        """Whether the tracks are made of this row, too."""
        rows = self._rows.view
        if not len(rows) or m.start > rows[-1, 0]:
            return False
        first, last = (int(np.searchsorted(rows[:, 0], m.start, side)) for side in ("left", "right"))
        same = rows[first:last]
        return bool(len(same)) and bool(_equal(_wide(same), np.array(odometry_row(m, self._stated))).any())

    def add(self, odometry: Sequence[Odometry | Displacement]) -> float:
        """Take new odometry; from which stamp [s] on others belong to another track than before, infinity if none do.

        Odometry that comes in order may begin a track, and what is stamped as it begins is the new one's.
        """
        rows = _in_order(np.array([odometry_row(m, self._stated) for m in odometry]))
        self.jumps += _core.count_jumps(rows, self._motion)
        known = self._rows.view
        in_order = not len(known) or tuple(rows[0, :4]) > tuple(known[-1, :4])
        before = len(self.tracks)
        if in_order:
            self._keep(rows)
            self.core.extend(rows)
        else:
            self._replace(_in_order(np.concatenate([_wide(known), rows])))
        self._name()
        if not in_order:
            return -inf
        return min((track.key.begin for track in self.tracks[before:]), default=inf)

    def at(self, stamp: float) -> Track | None:
        """The track that had begun by ``stamp``, the newest if several."""
        for track in reversed(self.tracks):
            if track.key.begin <= stamp:
                return track
        return None

    def forget(self, before: int) -> None:
        """Drop what ended before keyframe ``before``."""
        if not self.tracks:
            return
        self.core.forget(before)
        stamp = self.core.tracks[0].first / KEYFRAMES_PER_SECOND - self._lag
        ends = np.maximum.accumulate(self._rows.view[:, 1])  # a long row may hold shorter ones
        self._rows.drop(min(int(np.searchsorted(ends, stamp, "right")), len(ends) - 1))
        self._name()

    def rewind(self, since: float) -> None:
        """Forget the odometry that ended after ``since`` [s]."""
        rows = self._rows.view
        self._replace(_wide(rows[rows[:, 1] <= since]))
        self._name()

    def _replace(self, rows: Array) -> None:
        self._rows = Column((NARROW,))
        self._keep(rows)
        self.core.restart()
        if len(rows):
            self.core.extend(rows)

    def _keep(self, rows: Array) -> None:
        """Add rows that follow on. Wheels report at up to 100 Hz: covariances take no room where none is stated."""
        known = self._rows.view
        if known.shape[1] == NARROW and not np.isnan(rows[:, NARROW:]).all():
            self._rows = Column((WIDE,))
            self._rows.extend(_wide(known))
        self._rows.extend(rows[:, : self._rows.view.shape[1]])

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


def _wide(rows: Array) -> Array:
    """Rows as the core takes them."""
    wide = np.full((len(rows), WIDE), np.nan)
    wide[:, : rows.shape[1]] = rows
    return wide


def _in_order(rows: Array) -> Array:
    """Rows in canonical order, each once."""
    rows = rows[np.lexsort(rows.T[::-1])]
    first: Array = rows[np.append(True, ~_equal(rows[1:], rows[:-1]))]
    return first


def _equal(a: Array, b: Array) -> NDArray[np.bool_]:
    """Which rows are the same; covariances not stated are."""
    same: NDArray[np.bool_] = ((a == b) | (np.isnan(a) & np.isnan(b))).all(axis=-1)
    return same
