"""What is known: measurements admitted, the tracks they make, and what robots measured of one another. METHOD §1.

The history is a set: order of arrival and duplicates leave no trace in it.
"""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Iterable
from math import inf, sqrt

import numpy as np

from dgorl import _core, se2
from dgorl.configuration import Configuration
from dgorl.exchanges import Reading
from dgorl.measurements import (
    WORLD,
    Bearing,
    Displacement,
    Measurement,
    Odometry,
    Range,
    RelativePose,
    Rssi,
    known_at,
    robots_of,
)
from dgorl.sightings import Table
from dgorl.tracks import KEYFRAMES_PER_SECOND, Track, TrackKey, Trail, motion_values

WORLD_KEY = TrackKey(WORLD, 0, -inf)
"""Names the member that never moves, among the tracks."""

LATE = 10.0
"""Data later than this [s] waits for the next node time, so that a laggard costs one rewind per node ..."""

AT_ONCE = 6
"""... but for the first so many rewinds after a node that nothing late came for: a healed partition's."""

KINDS = {Rssi: "rssi", Range: "range", Bearing: "bearing"}
"""The table each reading is in."""


class History:
    """Admits measurements and keeps them as tracks and tables; ``rejected`` counts the others by reason.

    named: robots that readings and relative poses name, and from when to when readings did [s]; driven: robots with
    odometry, and from when to when. Both are kept for good.
    """

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        self.rejected: Counter[str] = Counter()
        self.trails: dict[str, Trail] = {}
        self.tables = {
            "rssi": Table("rssi", configuration.radio.thinning, directed=True),
            "range": Table("range", configuration.ranging.thinning, directed=False),
            "bearing": Table("bearing", configuration.bearings.thinning, directed=True),
        }
        self.poses: list[RelativePose] = []
        self.numbers: dict[TrackKey, int] = {}
        self.motion = motion_values(configuration.motion)
        self.named: dict[str, tuple[float, float]] = {}
        self.driven: dict[str, tuple[float, float]] = {}
        self._heard: dict[str, int] = {}
        self._inbox: list[tuple[float, int, Measurement]] = []
        self._count = 0
        self._at_once = AT_ONCE

    def add(self, measurement: Measurement) -> None:
        """Take a measurement, own or received, in any order, twice without harm."""
        self._count += 1
        item = (known_at(measurement), self._count, measurement)
        if not self._inbox or item > self._inbox[-1]:
            self._inbox.append(item)
        else:
            bisect.insort(self._inbox, item)

    def takes_late(self, node_due: bool) -> bool:
        """Whether ``admit`` would take what is later than 10 s."""
        return node_due or self._at_once > 0

    def admit(self, now: float, node_due: bool) -> float:
        """Admit what is known at ``now``; the earliest time [s] at which anything changed, infinity if nothing did.

        What is later than ``history`` is rejected; what is later than 10 s waits, mostly, until a node is due.
        """
        takes_late = self.takes_late(node_due)
        ready = bisect.bisect_right(self._inbox, now, key=lambda item: item[0])
        taken, waiting = self._inbox[:ready], self._inbox[ready:]
        early = []
        fresh: dict[Measurement, None] = {}
        late: dict[Measurement, None] = {}
        for item in taken:
            stamp, _, measurement = item
            if self._has(measurement):
                continue
            since = measurement.start if isinstance(measurement, Odometry | Displacement) else stamp
            if now - since > self.configuration.history:
                self.rejected["too late"] += 1
            elif now - stamp > LATE and not takes_late:
                early.append(item)
            else:
                (late if now - stamp > LATE else fresh)[measurement] = None
        self._inbox = early + waiting
        changed = self._take(list(late))
        if changed < inf:
            self._at_once -= not node_due
        elif node_due:
            self._at_once = AT_ONCE
        return min(changed, self._take(list(fresh)))

    def forget(self, before: float) -> None:
        """Drop what is older than ``before`` [s], a multiple of the keyframe time."""
        self.poses = [pose for pose in self.poses if pose.stamp >= before or self._waits(pose, before)]
        for trail in self.trails.values():
            trail.forget(int(np.floor(before * KEYFRAMES_PER_SECOND)))
        for table in self.tables.values():
            table.forget(before)

    def rewind(self, since: float) -> None:
        """Forget what is stamped after ``since`` [s], as if it had never come; it may come anew.

        Where readings are thinned, ``since`` is a border of their bins: what they replaced is not known any more.
        """
        self.poses = [pose for pose in self.poses if pose.stamp <= since]
        self._inbox = [item for item in self._inbox if item[0] <= since]
        for trail in self.trails.values():
            trail.rewind(since)
            self._number(trail)
        self.trails = {robot: trail for robot, trail in self.trails.items() if trail.tracks}
        for table in self.tables.values():
            table.rewind(since)
            for robot in self.trails:
                table.displace(robot)
            table.place(self._heard_trails)

    def _number(self, trail: Trail) -> None:
        for track in trail.tracks:
            track.core.number = self.numbers.setdefault(track.key, len(self.numbers))

    @property
    def _heard_trails(self) -> list[_core.Trail | None]:
        return [self.trails[name].core if name in self.trails else None for name in self._heard]

    def _waits(self, pose: RelativePose, before: float) -> bool:
        """Whether a known start holds for a track that has not begun, or begins after ``before`` [s]."""
        placed = self.placed(pose) if pose.prior else None
        return pose.prior and (placed is None or max(placed[2:]) >= before)

    @property
    def tracks(self) -> list[Track]:
        """All tracks in canonical order."""
        return sorted(track for trail in self.trails.values() for track in trail.tracks)

    def next_odometry(self, after: float) -> float:
        """The first time from ``after`` [s] on at which odometry tells more, infinity if it never does."""
        tracks = (track for trail in self.trails.values() for track in trail.tracks)
        return min((track.core.next(after) for track in tracks), default=inf)

    def horizon(self, now: float) -> float:
        """From when on readings link at ``now`` [s] what is not joined."""
        return -inf if self.configuration.window == "all" else now - self.configuration.history

    def antenna(self, robot: str) -> tuple[float, float, float]:
        """Where a robot's antenna stands in its body frame [m]."""
        antennas = self.configuration.antennas
        return antennas.get(robot, antennas.get("default", (0.0, 0.0, 0.0)))

    def placed(self, pose: RelativePose) -> tuple[TrackKey, TrackKey, float, float] | None:
        """Tracks of reference and robot and the stamp on each, if both have odometry there.

        A known start holds for the track that covers its stamp, or the first one to begin after it.
        """
        ends = []
        for name in (pose.reference, pose.robot):
            if name == WORLD:
                ends.append((WORLD_KEY, pose.stamp))
                continue
            trail = self.trails.get(name)
            track = trail.at(pose.stamp) if trail else None
            stamp = pose.stamp
            if (track is None or track.end < stamp) and trail and pose.prior:
                later = [t for t in trail.tracks if t.key.begin > stamp]
                track = later[0] if later else None
                stamp = track.key.begin if track else stamp
            if track is None or track.end < stamp:
                return None
            ends.append((track.key, stamp))
        (reference, stamp_a), (robot, stamp_b) = ends
        if reference != WORLD_KEY and abs(stamp_a - stamp_b) > 1 / KEYFRAMES_PER_SECOND:
            return None
        return reference, robot, stamp_a, stamp_b

    def _has(self, m: Measurement) -> bool:
        """Whether it was admitted before; not of readings that compete with others, which may come twice."""
        match m:
            case Odometry() | Displacement():
                return m.robot in self.trails and self.trails[m.robot].has(m)
            case RelativePose():
                index = bisect.bisect_left(self.poses, _pose_order(m), key=_pose_order)
                return self.poses[index : index + 1] == [m]
            case Rssi() | Range() | Bearing():
                table = self.tables[KINDS[type(m)]]
                return m.stamp <= table.newest and table.has(self._converted(m))

    def _take(self, fresh: list[Measurement]) -> float:
        if not fresh:
            return inf
        dirty = inf
        odometry: dict[str, list[Odometry | Displacement]] = {}
        readings: dict[str, list[Reading]] = {kind: [] for kind in self.tables}
        for m in fresh:
            match m:
                case Odometry() | Displacement():
                    odometry.setdefault(m.robot, []).append(m)
                    _widen(self.driven, m.robot, m.start, m.end)
                case RelativePose():
                    bisect.insort(self.poses, m, key=_pose_order)
                    dirty = min(dirty, m.stamp)
                    for robot in {m.reference, m.robot} - {WORLD}:
                        self.named.setdefault(robot, (inf, -inf))
                case Rssi() | Range() | Bearing():
                    readings[KINDS[type(m)]].append(self._converted(m))
                    for robot in robots_of(m):
                        _widen(self.named, robot, m.stamp, m.stamp)
        for robot in sorted(odometry):
            if robot not in self.trails:
                self.trails[robot] = Trail(robot, self.configuration.motion)
            since = self.trails[robot].add(odometry[robot])
            if self.trails[robot].jumps:
                self.rejected[f"odometry of {robot} faster than the limits"] = self.trails[robot].jumps
            self._number(self.trails[robot])
            dirty = min(dirty, self._changed(self.trails[robot], odometry[robot]))
            if since < inf:
                for table in self.tables.values():
                    table.displace(robot, since)
        trails = self._heard_trails
        for kind, table in self.tables.items():
            dirty = min(dirty, table.add(readings[kind]))
            table.place(trails)
        return dirty

    def _changed(self, trail: Trail, odometry: Iterable[Odometry | Displacement]) -> float:
        """The earliest time [s] at which new rows of a trail tell anything: after they began, or with their track."""
        begins = {track.key.begin for track in trail.tracks}
        starts = [m.start + self.configuration.motion.lag for m in odometry]
        return min(start if start in begins else float(np.nextafter(start, np.inf)) for start in starts)

    def _converted(self, m: Rssi | Range | Bearing) -> Reading:
        match m:
            case Rssi():
                return self._rssi(m)
            case Range():
                return self._range(m)
            case Bearing():
                return self._bearing(m)

    def _rssi(self, m: Rssi) -> Reading:
        """METHOD §2: both directions share their shadowing, so each counts for less (correlation ρ)."""
        radio = self.configuration.radio
        sigma = radio.sigma_db * sqrt(1.0 + radio.reciprocity)
        return self._reading(m.stamp, m.transmitter, m.receiver, m.dbm, sigma)

    def _range(self, m: Range) -> Reading:
        ranging = self.configuration.ranging
        value = max(ranging.scale * m.range + ranging.offset, 0.0)
        sigma = m.sigma if ranging.sigma is None else ranging.sigma + ranging.sigma_per_metre * value
        return self._reading(m.stamp, m.robot, m.peer, value, sigma or DEFAULT_RANGE_SIGMA, m.exchange)

    def _bearing(self, m: Bearing) -> Reading:
        bearings = self.configuration.bearings
        value = float(se2.wrap(m.bearing + bearings.offset))
        sigma = m.sigma if bearings.sigma is None else bearings.sigma
        return self._reading(m.stamp, m.observer, m.target, value, sigma or DEFAULT_BEARING_SIGMA)

    def _reading(
        self, stamp: float, a: str, b: str, value: float, sigma: float, exchange: int | None = None
    ) -> Reading:
        heard = self._heard
        robots = heard.setdefault(a, len(heard)), heard.setdefault(b, len(heard))
        return Reading(stamp, a, b, value, sigma, *robots, exchange)


def _widen(spans: dict[str, tuple[float, float]], robot: str, start: float, end: float) -> None:
    first, last = spans.get(robot, (start, end))
    spans[robot] = min(first, start), max(last, end)


DEFAULT_RANGE_SIGMA = 0.15
"""σ of a range [m] when neither the measurement nor the configuration states one: UWB."""

DEFAULT_BEARING_SIGMA = 0.05
"""σ of a bearing [rad] when neither the measurement nor the configuration states one."""


def _pose_order(pose: RelativePose) -> tuple[object, ...]:
    return (pose.stamp, pose.reference, pose.robot, pose.x, pose.y, pose.theta, *pose.covariance, pose.prior)
