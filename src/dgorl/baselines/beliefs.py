"""What each robot believes of its own pose: a Gaussian in the start frame, split by what others may share. METHOD §7.

T_w_r · Exp(ξ), ξ ~ N(0, dependent + independent): the world is the frame of the starts. ``dependent`` is the part whose
correlation with other robots' errors is not known, ``independent`` the part that no other robot has had a share in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dgorl import _core, se2
from dgorl.se2 import Array
from dgorl.tracks import Track


@dataclass(frozen=True, eq=False)
class Belief:
    """Pose (3,) of a robot at a keyframe of its track, covariances (3, 3) of its right perturbation."""

    track: Track
    keyframe: int
    pose: Array
    dependent: Array
    independent: Array

    @property
    def covariance(self) -> Array:
        """(3, 3) of all the error."""
        return self.dependent + self.independent


def begun(track: Track, stamp: float, T_w_r: Array, covariance: Array) -> Belief:
    """The belief of a robot that starts at ``stamp`` [s]; of a start nobody says what it depends on."""
    keyframe, T_k_r = track.core.locate(stamp)
    ad = se2.adjoint(T_k_r)
    pose = se2.compose(T_w_r, se2.inverse(T_k_r))
    return Belief(track, keyframe, pose, ad @ covariance @ ad.T, np.zeros((3, 3)))


def advanced(belief: Belief, keyframe: int) -> Belief:
    """Carried on to a later keyframe by the robot's odometry, whose noise is its own."""
    if keyframe <= belief.keyframe:
        return belief
    deltas, information = _core.odometry([belief.track.core], [belief.keyframe], [keyframe])
    pose, dependent, independent = belief.pose, belief.dependent, belief.independent
    for delta, noise in zip(deltas, np.linalg.inv(information), strict=True):
        back = se2.adjoint(se2.inverse(delta))
        pose = se2.compose(pose, delta)
        dependent = back @ dependent @ back.T
        independent = back @ independent @ back.T + (noise + noise.T) / 2
    return replace(belief, keyframe=keyframe, pose=pose, dependent=dependent, independent=independent)


def told(belief: Belief) -> Belief:
    """After a broadcast others may have a share in all of it."""
    return replace(belief, dependent=belief.covariance, independent=np.zeros((3, 3)))


def at(belief: Belief, now: float, motion: Array) -> Belief:
    """Carried on to ``now`` [s], beyond the last odometry by its last twist; the keyframe is the one before."""
    belief = advanced(belief, belief.track.core.newest(now))
    poses, joint = _core.carry([belief.track.core], now, motion, belief.pose[None], belief.dependent)
    _, noise = _core.carry([belief.track.core], now, motion, belief.pose[None], np.zeros((3, 3)))
    _, own = _core.carry([belief.track.core], now, motion, belief.pose[None], belief.independent)
    return replace(belief, pose=poses[0], dependent=joint - noise, independent=own)
