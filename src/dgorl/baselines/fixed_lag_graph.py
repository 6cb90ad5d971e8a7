"""What each update adds to GTSAM's smoother: poses of keyframes, odometry, starts and measured poses. METHOD §1, §7."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor
from typing import Any

import numpy as np

from dgorl import _core, se2
from dgorl.expansion.step import SPACING
from dgorl.history import WORLD_KEY, History
from dgorl.measurements import RelativePose
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey

RIGID = 1e-3
"""σ with which a pose between keyframes is tied to the one before [m, rad], small beside all odometry.

With 1e-4, GTSAM's marginalisation by Cholesky ends after half a minute in an indeterminate system.
"""


@dataclass
class Chain:
    """A track in the smoother: GTSAM's keys and guessed poses (3,) of its keyframes, up to the last one."""

    key: TrackKey
    core: _core.Track
    last: int
    keys: dict[int, int]
    poses: dict[int, Array]


Place = tuple[Chain, int]
"""A keyframe of a chain."""


class Additions:
    """Chains of the tracks that are placed, and what the next update adds to them.

    Poses are in the world's frame. lag: length of the window [s].
    """

    def __init__(self, gtsam: Any, history: History, lag: float) -> None:
        self.chains: dict[TrackKey, Chain] = {}
        self._gtsam, self._history, self._lag = gtsam, history, lag
        self._count = 0
        self._newest = -np.inf
        self._used: set[RelativePose] = set()
        self.clear()

    def clear(self) -> None:
        """Begin the next update."""
        self.factors, self.values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        self.stamps: dict[int, float] = {}
        self._between: dict[tuple[float, ...], int] = {}

    def expire(self) -> None:
        """Forget what the smoother has marginalised in its update, and chains silent for longer than the window."""
        for chain in list(self.chains.values()):
            for keyframe in [k for k in chain.keys if _block(k) < self._newest - self._lag]:
                del chain.keys[keyframe], chain.poses[keyframe]
            if not chain.keys:
                del self.chains[chain.key]

    def grow(self, now: float) -> None:
        """Chains of tracks that starts or measured poses place, all extended by odometry to ``now`` [s]."""
        cores = {track.key: track.core for track in self._history.tracks}
        self._used.intersection_update(self._history.poses)
        for chain in list(self.chains.values()):
            if chain.key in cores:
                chain.core = cores[chain.key]
                self._extend(chain, now)
            else:
                del self.chains[chain.key]
        for pose in self._history.poses:
            placed = self._history.placed(pose) if pose not in self._used else None
            if placed is not None and self._place(pose, *placed, cores, now):
                self._used.add(pose)

    def at(self, place: Place, offset: Array) -> int:
        """Key of the pose ``offset`` (3,) from a keyframe's: the keyframe's own, or one tied to it."""
        chain, keyframe = place
        key = chain.keys[keyframe]
        if not offset.any():
            return key
        name = (key, *offset.tolist())
        if name not in self._between:
            noise = self._gtsam.noiseModel.Isotropic.Sigma(3, RIGID)
            self._between[name] = tied = self._pose(se2.compose(chain.poses[keyframe], offset), keyframe)
            self.factors.add(self._gtsam.BetweenFactorPose2(key, tied, self._gtsam.Pose2(*offset), noise))
        return self._between[name]

    def _pose(self, pose: Array, keyframe: int) -> int:
        self._count += 1
        self.values.insert(self._count, self._gtsam.Pose2(*pose))
        self.stamps[self._count] = _block(keyframe)
        self._newest = max(self._newest, self.stamps[self._count])
        return self._count

    def _begin(self, key: TrackKey, core: _core.Track, keyframe: int, pose: Array, now: float) -> Chain:
        chain = Chain(key, core, keyframe, {keyframe: self._pose(pose, keyframe)}, {keyframe: pose})
        self.chains[key] = chain
        self._extend(chain, now)
        return chain

    def _extend(self, chain: Chain, now: float) -> None:
        gtsam, newest = self._gtsam, chain.core.newest(now)
        if newest <= chain.last:
            return
        delta, information = _core.odometry([chain.core], [chain.last], [newest])
        poses = _core.chain(chain.poses[chain.last], delta)
        for step, omega, pose in zip(delta, information, poses[1:], strict=True):
            before, chain.last = chain.keys[chain.last], chain.last + 1
            chain.keys[chain.last], chain.poses[chain.last] = self._pose(pose, chain.last), pose
            noise = gtsam.noiseModel.Gaussian.Information(omega)
            self.factors.add(gtsam.BetweenFactorPose2(before, chain.keys[chain.last], gtsam.Pose2(*step), noise))

    def _place(
        self,
        pose: RelativePose,
        reference: TrackKey,
        robot: TrackKey,
        stamp_reference: float,
        stamp_robot: float,
        cores: dict[TrackKey, _core.Track],
        now: float,
    ) -> bool:
        """Add a start or a measured pose; False while the odometry of an end does not reach it."""
        keyframe, offset = cores[robot].locate(stamp_robot)
        if keyframe > cores[robot].newest(now):
            return False
        measured, T_w_reference, base = np.array([pose.x, pose.y, pose.theta]), np.zeros(3), None
        if reference != WORLD_KEY:
            chain, (before, moved) = self.chains.get(reference), cores[reference].locate(stamp_reference)
            if chain is None or before > chain.last:
                return False
            if before not in chain.keys:
                return True  # it has left the window
            base = self.at((chain, before), moved)
            T_w_reference = se2.compose(chain.poses[before], moved)
        if robot not in self.chains:
            T_w_robot = se2.compose(T_w_reference, measured)
            self._begin(robot, cores[robot], keyframe, se2.compose(T_w_robot, se2.inverse(offset)), now)
        chain = self.chains[robot]
        if keyframe in chain.keys:
            gtsam, key, measurement = self._gtsam, self.at((chain, keyframe), offset), self._gtsam.Pose2(*measured)
            noise = gtsam.noiseModel.Gaussian.Covariance(_symmetric(pose.covariance))
            self.factors.add(
                gtsam.PriorFactorPose2(key, measurement, noise)
                if base is None
                else gtsam.BetweenFactorPose2(base, key, measurement, noise)
            )
        return True


def _block(keyframe: int) -> float:
    """Poses leave the window in blocks of 5 s [s].

    The past is marginalised where DGORL's nodes do it. In between the newest poses stay at the root of the Bayes tree,
    which makes updates and their covariance cheap.
    """
    return floor(keyframe / KEYFRAMES_PER_SECOND / SPACING) * SPACING


def _symmetric(upper: tuple[float, ...]) -> Array:
    matrix = np.zeros((3, 3))
    rows, columns = np.triu_indices(3)
    matrix[rows, columns] = matrix[columns, rows] = upper
    return matrix
