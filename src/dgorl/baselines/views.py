"""The team as one robot of a baseline sees it: relative poses from everybody's own belief. METHOD §7, §3."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dgorl import _core
from dgorl.baselines.beliefs import Belief
from dgorl.configuration import Configuration
from dgorl.estimate import Estimate, OptimizedGraph, PeerEstimate, Status
from dgorl.measurements import WORLD
from dgorl.relative import Relative, bent, relative_to, turned
from dgorl.se2 import Array
from dgorl.status import joined_status

SHARES = np.linspace(0.02, 0.98, 49)
"""ω among which the tightest bound is looked for."""


def team_view(
    robot: str,
    now: float,
    beliefs: Mapping[str, Belief],
    missing: Mapping[str, str],
    configuration: Configuration,
    rejected: Mapping[str, int],
    *,
    bounded: bool,
) -> Estimate:
    """Every peer in ``robot``'s frame at ``now`` [s].

    missing: robots without a belief → why. bounded: the covariance is a bound for whatever the beliefs' dependent
    parts have in common; otherwise they count as independent.
    """
    own = beliefs.get(robot)
    peers: dict[str, PeerEstimate] = {}
    for peer in sorted({*beliefs, *missing} - {robot}):
        other = beliefs.get(peer)
        if own is None or other is None:
            reason = missing.get(robot if own is None else peer, f"nothing heard from {robot}")
            peers[peer] = PeerEstimate(None, None, Status.ISOLATED, 0.0, np.inf, reason)
            continue
        age = max(now - (other.track.end - configuration.motion.lag), 0.0)
        if age > configuration.status.age:
            reason = f"no odometry from {peer} for {age:.0f} s"
            peers[peer] = PeerEstimate(None, None, Status.ISOLATED, 0.0, age, reason, "restore the link")
            continue
        peers[peer] = _known(robot, relative(own, other, bounded=bounded), age, configuration)
    if own is not None:
        peers[WORLD] = _known(robot, _of_world(own), 0.0, configuration)
    return Estimate(robot, now, peers, dict(rejected), lambda: _graph(robot, peers))


def _known(robot: str, seen: Relative, age: float, configuration: Configuration) -> PeerEstimate:
    status, reason = joined_status(robot, seen.pose, seen.covariance, configuration)
    return PeerEstimate(seen.pose, seen.covariance, status, 1.0, age, reason, tangent_covariance=seen.tangent)


def relative(own: Belief, other: Belief, *, bounded: bool) -> Relative:
    """T_own_other with its covariances.

    bounded: D_i/ω + D_j/(1 − ω) + independent parts, at the ω of the smallest determinant: no correlation of the
    dependent parts makes the error larger. Otherwise the plain sum, as if nothing were shared.
    """
    poses = np.stack([own.pose, other.pose])

    def moved(own_part: Array, other_part: Array) -> Array:
        joint = np.zeros((6, 6))
        joint[:3, :3], joint[3:, 3:] = own_part, other_part
        return np.asarray(_core.relative(poses, joint, 0)[1][1])

    none = np.zeros((3, 3))
    pose = _core.relative(poses, np.zeros((6, 6)), 0)[0][1]
    if not bounded:
        return _bent(pose, moved(own.covariance, other.covariance))
    mine, theirs = moved(own.dependent, none), moved(none, other.dependent)
    return _bent(pose, tightest(mine, theirs) + moved(own.independent, other.independent))


def _bent(pose: Array, covariance: Array) -> Relative:
    """covariance: (3, 3) of (x, y, theta), to first order."""
    return Relative(pose, bent(pose, covariance), turned(-pose[2], covariance))


def tightest(a: Array, b: Array) -> Array:
    """a/ω + b/(1 − ω) of the smallest determinant: a bound (3, 3) for sums of errors however correlated."""
    sums = a / SHARES[:, None, None] + b / (1.0 - SHARES)[:, None, None]
    return np.asarray(sums[int(np.argmin(np.linalg.det(sums)))])


def _of_world(own: Belief) -> Relative:
    joint = np.zeros((6, 6))
    joint[:3, :3] = own.covariance
    return relative_to(np.stack([own.pose, np.zeros(3)]), joint, 0)[1]


def _graph(robot: str, peers: Mapping[str, PeerEstimate]) -> OptimizedGraph:
    """Filters keep no edges: poses alone."""
    poses = {robot: np.zeros(3)} | {name: seen.pose for name, seen in peers.items() if seen.pose is not None}
    poses.pop(WORLD, None)
    return OptimizedGraph(poses, (), np.zeros((len(poses), len(poses))))
