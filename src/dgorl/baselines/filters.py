"""Filters of a team, one Gaussian a robot, that exchange estimates without loss at every tick. METHOD §7."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from math import floor

import numpy as np

from dgorl.baselines.beliefs import Belief, advanced, at, begun
from dgorl.baselines.sightings import Sighting, Sightings
from dgorl.baselines.views import team_view
from dgorl.configuration import Configuration
from dgorl.estimate import Estimate
from dgorl.history import LATE, History
from dgorl.measurements import LARGEST, WORLD, Measurement, RelativePose
from dgorl.tracks import KEYFRAMES_PER_SECOND, Track, TrackKey

EARLIER = 1e-9
"""What is stamped less than this [s] before a keyframe counts as at it."""

SETTLED = 2.0
"""Beliefs of robots nobody measures follow this much later [s]: what is stamped before finds a newer keyframe."""

NO_START = "no start pose known since its odometry began"


@dataclass(frozen=True)
class Beliefs:
    """Every robot's belief carried on to one time, and why the others have none."""

    known: Mapping[str, Belief]
    missing: Mapping[str, str]


class FilterTeam:
    """Dead reckoning from known starts, and what filters with readings share.

    Known starts are priors on the world. Relative poses, measured or prior, are not used and counted as rejected.
    """

    bounded = False
    """whether relative covariances are bounds for correlations nobody knows; here errors are independent"""

    def __init__(self, configuration: Configuration | None = None) -> None:
        self.configuration = configuration or Configuration()
        self.history = History(self.configuration)
        self._sightings = Sightings(self.history)
        self._beliefs: dict[str, Belief] = {}
        self._placed: set[RelativePose] = set()

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of any robot."""
        if isinstance(measurement, RelativePose) and measurement.reference != WORLD:
            self.history.rejected["relative poses: this estimator has no use for them"] += 1
        else:
            self.history.add(measurement)

    def update(self, now: float) -> Beliefs:
        """Every robot's belief at ``now`` [s]. Raises ValueError when that is not a time."""
        if not abs(now) <= LARGEST:
            raise ValueError(f"now must be a time in seconds, got {now}")
        self.history.admit(now, node_due=True)
        tracks = {track.key: track for track in self.history.tracks}
        for robot, belief in self._beliefs.items():  # late odometry makes tracks anew
            self._beliefs[robot] = replace(belief, track=tracks.get(belief.track.key, belief.track))
        self._begin(tracks)
        for keyframe, sightings in self._groups(now):
            self._sense((keyframe + 1) / KEYFRAMES_PER_SECOND - EARLIER, now)
            self._exchange(keyframe, sightings)
        self._sense(now, now)
        settled = floor((now - SETTLED) * KEYFRAMES_PER_SECOND)
        for robot, belief in self._beliefs.items():
            self._beliefs[robot] = advanced(belief, min(settled, belief.track.core.newest(now)))
        beliefs = self._at(now)
        oldest = min((b.keyframe / KEYFRAMES_PER_SECOND for b in self._beliefs.values()), default=np.inf)
        self.history.forget(min(oldest, now - 3 * LATE))
        return beliefs

    def view(self, robot: str, state: Beliefs, now: float) -> Estimate:
        """The team as one robot sees it."""
        return team_view(
            robot, now, state.known, state.missing, self.configuration, self.history.rejected, bounded=self.bounded
        )

    def _begin(self, tracks: Mapping[TrackKey, Track]) -> None:
        """Place the robots whose start is known and whose odometry has begun."""
        for start in self.history.poses:
            placed = None if start in self._placed else self.history.placed(start)
            if placed is None:
                continue
            _, key, _, stamp = placed
            covariance = np.zeros((3, 3))
            rows, columns = np.triu_indices(3)
            covariance[rows, columns] = covariance[columns, rows] = start.covariance
            pose = np.array([start.x, start.y, start.theta])
            self._beliefs[start.robot] = begun(tracks[key], stamp, pose, covariance)
            self._placed.add(start)

    def _groups(self, now: float) -> Iterator[tuple[int, Sequence[Sighting]]]:
        """New readings between robots that have a belief, keyframe by keyframe."""

        def usable(sighting: Sighting) -> bool:
            ends = ((sighting.a, sighting.keyframe_a), (sighting.b, sighting.keyframe_b))
            beliefs = [self._beliefs.get(track.key.robot) for track, _ in ends]
            return all(b is not None and b.track.key == track.key for b, (track, _) in zip(beliefs, ends, strict=True))

        sightings = sorted(filter(usable, self._sightings.new(now)), key=lambda s: s.keyframe)
        for keyframe, group in groupby(sightings, key=lambda s: s.keyframe):
            yield keyframe, list(group)

    def _sense(self, until: float, now: float) -> None:
        """Use what robots sensed on their own and is stamped up to ``until`` [s]; dead reckoning has no such thing."""

    def _exchange(self, keyframe: int, sightings: Sequence[Sighting]) -> None:
        """Use readings of one keyframe; dead reckoning does not."""

    def _at(self, now: float) -> Beliefs:
        known: dict[str, Belief] = {}
        missing: dict[str, str] = {}
        for robot, trail in sorted(self.history.trails.items()):
            track, belief = trail.at(now), self._beliefs.get(robot)
            if track is None or track.core.known(now) == -np.inf:
                missing[robot] = f"no odometry from {robot} yet"
            elif belief is None or belief.track.key != track.key:
                missing[robot] = f"{robot}: {NO_START}"
            else:
                known[robot] = at(belief, now, self.history.motion)
        return Beliefs(known, missing)
