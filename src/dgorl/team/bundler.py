"""Cuts a robot's own measurements into bundles, one a tick. `run` and the live team use the same cuts.

``substep``: odometry in shorter rows is composed, see :func:`merged`.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from dgorl import se2
from dgorl.crowds import Order, sampled
from dgorl.errors import MeasurementError
from dgorl.measurements import (
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
from dgorl.team.bundles import Bundle, track_epoch
from dgorl.team.intake import Moved
from dgorl.team.wire import LIMITS, NAMES, ROWS, Limits, size

CLOCKS_EVERY = 1.0
"""A peer's clock is told at most once in this time [s], by the reading that travelled shortest."""

FOLLOWS = 1e-6
"""Odometry nearer than this [s] follows on."""

WAITING = 100_000
"""So many rows wait for their cut at most; what comes beyond is dropped."""

Step = Odometry | Displacement


class Bundler:
    """Takes one robot's measurements, gives bundles. ``dropped`` counts by reason what is in none.

    sequence, track: where an earlier run of the same epoch left off.
    """

    def __init__(
        self,
        team: str,
        robot: str,
        epoch: int,
        *,
        sequence: int = 0,
        track: int = 0,
        substep: float = 0.0,
        limits: Limits = LIMITS,
    ) -> None:
        self.team, self.robot, self.epoch = team, robot, epoch
        self.sequence, self.track = sequence, track
        self.dropped: Counter[str] = Counter()
        self._substep, self._limits = substep, limits
        self._waiting: list[Measurement] = []
        self._moved: list[float] = []
        self._carried = -np.inf
        self._heard: dict[tuple[str, int], ClockReading] = {}
        self._told: dict[tuple[str, int], float] = {}

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of this robot's own; the epoch of odometry is set when it is cut.

        Raises MeasurementError for what another robot measured and for what a bundle cannot carry.
        """
        match measurement:
            case Odometry() | Displacement() | Range():
                author = measurement.robot
            case Rssi():
                author = measurement.receiver
            case Bearing():
                author = measurement.observer
            case _:
                raise MeasurementError("a bundle carries odometry, RSSI, ranges and bearings")
        if author != self.robot:
            raise MeasurementError(f"{author} measured this, not {self.robot}")
        if isinstance(measurement, Range) and not -(2**63) <= (measurement.exchange or 0) < 2**63:
            raise MeasurementError(f"exchange must be a number of 64 bit, got {measurement.exchange}")
        if len(self._waiting) >= WAITING:
            self.dropped["too many at once"] += 1
        else:
            self._waiting.append(measurement)

    @property
    def waiting(self) -> tuple[Measurement | Moved, ...]:
        """What is in no bundle yet."""
        return (*self._waiting, *map(Moved, self._moved))

    def moved(self, stamp: float) -> None:
        """The robot was carried at ``stamp`` [s]: a new track begins; odometry across it is dropped."""
        if len(self._moved) >= WAITING:
            self.dropped["too many at once"] += 1
        else:
            insort(self._moved, stamp)

    def heard(self, readings: Iterable[ClockReading]) -> None:
        """Take clock readings; of each peer's the one that travelled shortest is told."""
        for reading in readings:
            key = reading.peer, reading.peer_epoch
            best = self._heard.get(key)
            if best is None or reading.received - reading.sent < best.received - best.sent:
                self._heard[key] = reading

    def cut(self, now: float) -> tuple[Bundle, ...]:
        """What is known at ``now`` [s]; rows stamped later wait. One bundle, more where a track begins or one is full.

        Without rows or clock readings: none.
        """
        ready = self._thinned([m for m in self._waiting if known_at(m) <= now])
        self._waiting = [m for m in self._waiting if known_at(m) > now]
        bounds = self._moved[: bisect_right(self._moved, now)]
        del self._moved[: len(bounds)]
        parts = self._by_track(ready, bounds)
        clocks = self._clocks(now)
        bundles: list[Bundle] = []
        for index, part in enumerate(parts):
            track, told = self.track + index, clocks if index == len(parts) - 1 else ()
            bundles.extend(self._bundles(part, told, track, now))
        self.track += len(bounds)
        self.sequence += len(bundles)
        return tuple(replace(bundle, sequence=self.sequence - len(bundles) + k) for k, bundle in enumerate(bundles))

    def _thinned(self, rows: Sequence[Measurement]) -> list[Measurement]:
        """Rows without the readings that would count nowhere, as there are too many of them (see `crowds`)."""
        kept: list[Measurement] = []
        for kind in (Step, Rssi, Range, Bearing):
            of_kind = [row for row in rows if isinstance(row, kind)]
            kept += of_kind if kind is Step else sampled(of_kind, _order, 2 if kind is Rssi else 1)
        if len(kept) < len(rows):
            self.dropped["more readings than count"] += len(rows) - len(kept)
        return kept

    def _by_track(self, rows: Sequence[Measurement], bounds: Sequence[float]) -> list[list[Measurement]]:
        """Rows of the track until now and of those that began at ``bounds``; odometry of neither is dropped."""
        parts: list[list[Measurement]] = [[] for _ in range(len(bounds) + 1)]
        for row in rows:
            if not isinstance(row, Step):
                parts[bisect_right(bounds, row.stamp)].append(row)
            elif row.start < self._carried or any(row.start < bound < row.end for bound in bounds):
                self.dropped["odometry while the robot was carried"] += 1
            else:
                parts[bisect_right(bounds, row.start)].append(row)
        if bounds:
            self._carried = bounds[-1]
        return parts

    def _clocks(self, now: float) -> tuple[ClockReading, ...]:
        due = [key for key in sorted(self._heard) if now - self._told.get(key, -np.inf) >= CLOCKS_EVERY][:NAMES]
        self._told = {key: told for key, told in self._told.items() if now - told < CLOCKS_EVERY}
        self._told |= dict.fromkeys(due, now)
        readings = tuple(self._heard.pop(key) for key in due)
        if len(self._heard) > NAMES:
            self._heard.clear()
        return readings

    def _bundles(
        self, rows: Sequence[Measurement], clocks: Sequence[ClockReading], track: int, now: float
    ) -> list[Bundle]:
        """The bundles of one track, halved until each is small enough."""
        if not rows and not clocks:
            return []
        epoch = track_epoch(self.epoch, track)
        steps = [replace(m, epoch=epoch) for m in rows if isinstance(m, Step)]
        steps = merged(sorted(steps, key=lambda m: (m.start, m.end)), self._substep)
        steps.sort(key=lambda m: isinstance(m, Displacement))
        bundle = Bundle(
            self.team,
            self.robot,
            self.epoch,
            self.sequence,
            track,
            now,
            tuple(steps),
            tuple(m for m in rows if isinstance(m, Rssi)),
            tuple(m for m in rows if isinstance(m, Range)),
            tuple(m for m in rows if isinstance(m, Bearing)),
            tuple(clocks),
        )
        longest = max(map(len, (bundle.odometry, bundle.rssi, bundle.ranges, bundle.bearings)))
        if longest <= ROWS and len(_peers(bundle)) <= NAMES and size(bundle) <= self._limits.bundle:
            return [bundle]
        count = len(rows) + len(clocks)
        if count == 1:
            self.dropped["larger than a bundle"] += 1
            return []
        half = sorted(rows, key=known_at)[: len(rows) // 2], clocks[: len(clocks) // 2] if len(rows) < 2 else ()
        rest = sorted(rows, key=known_at)[len(rows) // 2 :], clocks[len(clocks) // 2 :] if len(rows) < 2 else clocks
        return self._bundles(*half, track, now) + self._bundles(*rest, track, now)


def merged(rows: Sequence[Step], substep: float) -> list[Step]:
    """Odometry with rows shorter than ``substep`` [s] composed into displacements; 0 leaves all as they are.

    rows: of one robot and track, by start. Rows that follow on and begin in the same multiple of ``substep`` make one
    displacement. Where they state a covariance it is carried along; where not, none is stated and the configuration's
    noise applies to the sum, which for a path that turns back is a little less than to its parts.
    """
    if substep <= 0:
        return list(rows)
    groups: list[list[Step]] = []
    for row in rows:
        if groups and _together(groups[-1][-1], row, substep):
            groups[-1].append(row)
        else:
            groups.append([row])
    return [_composed(group) if len(group) > 1 else group[0] for group in groups]


def _together(before: Step, row: Step, substep: float) -> bool:
    return (
        max(before.end - before.start, row.end - row.start) < substep
        and abs(row.start - before.end) <= FOLLOWS
        and np.floor(before.start / substep + FOLLOWS) == np.floor(row.start / substep + FOLLOWS)
        and (_stated(before) is None) == (_stated(row) is None)
        and before.epoch == row.epoch
    )


def _composed(rows: Sequence[Step]) -> Displacement:
    """One displacement over all rows. With d = d1·d2: Σ = J1 Σ1 J1ᵀ + J2 Σ2 J2ᵀ, J1 = ∂d/∂d1, J2 = ∂d/∂d2."""
    total, covariance = np.zeros(3), np.zeros((3, 3))
    stated = all(_stated(row) is not None for row in rows)
    for row in rows:
        step = _delta(row)
        after = se2.compose(total, step)
        after[2] = total[2] + step[2]
        J1, J2 = np.eye(3), np.eye(3)
        J2[:2, :2] = se2.rotation(total[2])
        J1[:2, 2] = -(after[1] - total[1]), after[0] - total[0]
        values = _stated(row)
        if values is not None:
            covariance = J1 @ covariance @ J1.T + J2 @ _matrix(values) @ J2.T
        total = after
    dx, dy, dtheta = map(float, total)
    upper = tuple(float(covariance[index]) for index in zip(*np.triu_indices(3), strict=True)) if stated else None
    first, last = rows[0], rows[-1]
    return Displacement(first.robot, first.start, last.end, dx, dy, dtheta, upper, first.epoch)  # type: ignore[arg-type]


def _order(row: Measurement) -> Order:
    """What a reading is sorted by; its value as measured."""
    match row:
        case Rssi():
            return row.stamp, row.transmitter, row.receiver, row.dbm, 0.0
        case Range():
            return row.stamp, row.robot, row.peer, row.range, row.sigma or 0.0
        case Bearing():
            return row.stamp, row.observer, row.target, row.bearing, row.sigma or 0.0
    raise AssertionError(row)


def _delta(row: Step) -> se2.Array:
    """Motion over a row (3,), its turn not wrapped."""
    if isinstance(row, Displacement):
        return np.array([row.dx, row.dy, row.dtheta])
    turn = row.omega * (row.end - row.start)
    delta = se2.exp([row.v * (row.end - row.start), 0.0, turn])
    delta[2] = turn
    return delta


def _stated(row: Step) -> Covariance | None:
    return row.covariance if isinstance(row, Displacement) else None


def _matrix(values: Covariance) -> se2.Array:
    xx, xy, xt, yy, yt, tt = values
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


def _peers(bundle: Bundle) -> set[str]:
    peers = {m.transmitter for m in bundle.rssi} | {m.peer for m in bundle.ranges} | {m.target for m in bundle.bearings}
    return peers | {reading.peer for reading in bundle.clocks}
