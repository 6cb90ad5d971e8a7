"""GTSAM's fixed-lag smoother on a team with known starts: what an engineer would build instead of DGORL. METHOD §7.

The same data in the same window: admission, thinning and preintegrated odometry are DGORL's, the graph, its optimum and
its marginals are GTSAM's, with its own factors (fixed_lag_graph, fixed_lag_readings).

The incremental smoother of GTSAM 4.3 ran through everything it was tried on: simulations of 200 s, MRCLAM and TIERS
recordings. It gave way, and the batch smoother with it, only where poses were tied to one another by 0.1 mm
(fixed_lag_graph.RIGID). The batch smoother has the same accuracy at 4 to 10 times the time.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dgorl import _core
from dgorl.baselines.fixed_lag_graph import Additions, Chain
from dgorl.baselines.fixed_lag_readings import Readings
from dgorl.configuration import Configuration
from dgorl.errors import DgorlError, MissingExtraError, pip_install
from dgorl.estimate import Estimate, OptimizedGraph, PeerEstimate, Status
from dgorl.expansion.step import SPACING
from dgorl.history import LATE, History
from dgorl.measurements import LARGEST, WORLD, Measurement
from dgorl.relative import Relative, relative_to
from dgorl.se2 import Array
from dgorl.status import joined_status
from dgorl.tracks import KEYFRAMES_PER_SECOND

COARSE, FINE = 1.0, 0.01
"""Thresholds of relinearisation [m, rad]: the most accurate of 0.01, 0.1, 0.3, 1 on simulated RSSI and on ranges.

Ranges of 0.1 m need the fine one; with RSSI, whose errors are metres, to linearise nearly never is as good and cheaper.
"""

FOREVER = 1e12
"""Lag of a window that keeps everything [s]."""

ITERATIONS = 20
"""At most this many of the batch smoother's Levenberg–Marquardt in an update."""


@dataclass(frozen=True, eq=False)
class SmootherState:
    """Robots that stand in the smoother, carried on to ``stamp`` [s]; the world, without uncertainty, comes last.

    poses (n, 3), joint covariance (3n, 3n) of right perturbations. missing: why the others do not.
    ages: since each robot's last odometry [s].
    """

    stamp: float
    members: tuple[str, ...]
    poses: Array
    covariance: Array
    missing: Mapping[str, str]
    ages: Mapping[str, float]


class FixedLagTeam:
    """Every robot's trajectory of the window, smoothed by GTSAM, as seen by each of them.

    rssi: ``native`` or ``callback`` factors for signal strengths, see fixed_lag_readings. incremental: iSAM2, one
    Gauss–Newton step an update and ``steps`` more; otherwise Levenberg–Marquardt on the whole window to convergence.
    relinearize: how far a pose moves before iSAM2 linearises there anew [m, rad]; by default COARSE where signal
    strengths alone are heard at the start, else FINE.

    Measurements have to come in order: what is marginalised or linked by odometry is not taken back, a reading older
    than one of its pair is not used. Raises MissingExtraError without gtsam.
    """

    def __init__(
        self,
        configuration: Configuration | None = None,
        *,
        rssi: Literal["native", "callback"] = "native",
        incremental: bool = True,
        relinearize: float | None = None,
        steps: int = 0,
    ) -> None:
        try:
            import gtsam
        except ImportError as error:
            what = f"the estimator gtsam-fixed-lag needs gtsam: {pip_install('gtsam')}"
            raise MissingExtraError(what) from error
        self.configuration = configuration or Configuration()
        self.history = History(self.configuration)
        self.smoother_s = 0.0
        """CPU seconds spent in the smoother's updates"""
        self.covariance_s = 0.0
        """CPU seconds spent on joint covariances"""
        window = self.configuration.window
        lag = FOREVER if window == "all" else float(window)
        self._gtsam, self._incremental, self._steps = gtsam, incremental, steps
        self._lag, self._relinearize = lag, relinearize
        self._smoother: Any = None
        self._kept = -np.inf
        self._additions = Additions(gtsam, self.history, lag)
        self._readings = Readings(gtsam, self.history, frozenset({"rssi"} if rssi == "callback" else ()))

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of any robot."""
        self.history.add(measurement)

    def update(self, now: float) -> SmootherState:
        """The team at ``now`` [s]: the smoother's update, newest poses and their joint covariance.

        Raises ValueError when ``now`` is not a time, DgorlError when GTSAM gives up.
        """
        if not abs(now) <= LARGEST:
            raise ValueError(f"now must be a time in seconds, got {now}")
        self.history.admit(now, node_due=True)
        additions = self._additions
        additions.clear()
        additions.grow(now)
        self._readings.add(additions, now)
        began = time.process_time()
        try:
            self._smooth(additions)
        except RuntimeError as error:
            why = str(error).strip().partition("\n")[0]
            raise DgorlError(f"gtsam-fixed-lag: the smoother failed at {now:g} s: {why}") from error
        self.smoother_s += time.process_time() - began
        self._forget(now)
        return self._state(now)

    def view(self, robot: str, state: SmootherState, now: float) -> Estimate:
        """The team as one robot sees it."""
        peers: dict[str, PeerEstimate] = {}
        seen: dict[str, Relative] = {}
        if robot in state.members:
            placed = relative_to(state.poses, state.covariance, state.members.index(robot))
            seen = dict(zip(state.members, placed, strict=True))
        names = sorted({*state.missing, *state.members[:-1]} - {robot})
        for peer in [*names, WORLD] if robot in seen else names:
            age = state.ages.get(peer, 0.0)
            reason = state.missing.get(robot) or state.missing.get(peer)
            if reason is None and age > self.configuration.status.age:
                reason = f"no odometry from {peer} for {age:.0f} s"
            if reason is not None or peer not in seen:
                reason = reason or f"nothing heard from {robot}"
                peers[peer] = PeerEstimate(None, None, Status.ISOLATED, 0.0, age, reason)
                continue
            pose, covariance, tangent = seen[peer]
            status, reason = joined_status(robot, pose, covariance, self.configuration)
            peers[peer] = PeerEstimate(pose, covariance, status, 1.0, age, reason, tangent_covariance=tangent)
        return Estimate(robot, now, peers, dict(self.history.rejected), lambda: _graph(robot, peers))

    def _forget(self, now: float) -> None:
        """Drop raw data that no reading to come and no chain needs, now and then."""
        if now < self._kept + SPACING:
            return
        self._kept = now
        oldest = min((c.last / KEYFRAMES_PER_SECOND for c in self._additions.chains.values()), default=np.inf)
        self.history.forget(np.floor(min(oldest, now - 3 * LATE) * KEYFRAMES_PER_SECOND) / KEYFRAMES_PER_SECOND)

    def _smooth(self, additions: Additions) -> None:
        if not additions.chains:
            return
        if self._smoother is None:
            self._smoother = self._begun()
        self._smoother.update(additions.factors, additions.values, additions.stamps)
        for _ in range(self._steps if self._incremental else 0):
            self._smoother.update()
        additions.expire()
        for chain in additions.chains.values():
            pose = self._smoother.calculateEstimatePose2(chain.keys[chain.last])
            chain.poses[chain.last] = np.array([pose.x(), pose.y(), pose.theta()])

    def _begun(self) -> Any:
        if not self._incremental:
            return _batch(self._gtsam, self._lag)
        tables = self.history.tables
        coarse = len(tables["rssi"]) > 0 and not len(tables["range"]) and not len(tables["bearing"])
        return _incremental(self._gtsam, self._lag, self._relinearize or (COARSE if coarse else FINE))

    def _state(self, now: float) -> SmootherState:
        missing, ages, chains = {}, {}, list[Chain]()
        for robot, trail in sorted(self.history.trails.items()):
            track = trail.at(now)
            chain = self._additions.chains.get(track.key) if track is not None else None
            if track is None or track.core.known(now) == -np.inf:
                missing[robot] = f"no odometry from {robot} yet"
            elif chain is None:
                missing[robot] = f"{robot}: no start pose known, or silent for longer than the window"
            else:
                chains.append(chain)
            if track is not None:
                ages[robot] = max(now - (track.end - self.configuration.motion.lag), 0.0)
        members = (*(chain.key.robot for chain in chains), WORLD)
        poses, covariance = np.zeros((len(members), 3)), np.zeros((3 * len(members), 3 * len(members)))
        if chains:
            cores, newest = [chain.core for chain in chains], np.array([chain.poses[chain.last] for chain in chains])
            joint = self._covariance([chain.keys[chain.last] for chain in chains])
            poses[:-1], covariance[:-3, :-3] = _core.carry(cores, now, self.history.motion, newest, joint)
        return SmootherState(now, members, poses, covariance, missing, ages)

    def _covariance(self, keys: list[int]) -> Array:
        """Joint covariance (3n, 3n) of poses in their own tangents, which is GTSAM's convention too."""
        began = time.process_time()
        smoother = self._smoother
        if self._incremental:
            marginals = smoother.getISAM2()
        else:
            marginals = self._gtsam.Marginals(smoother.getFactors(), smoother.calculateEstimate())
        joint: Array = np.array(marginals.jointMarginalCovariance(keys).fullMatrix())
        self.covariance_s += time.process_time() - began
        return np.asarray((joint + joint.T) / 2)


def _incremental(gtsam: Any, lag: float, relinearize: float) -> Any:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(relinearize)
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True  # else the list of factors grows for ever
    return gtsam.IncrementalFixedLagSmoother(lag, parameters)


def _batch(gtsam: Any, lag: float) -> Any:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    parameters.setRelativeErrorTol(1e-9)
    return gtsam.BatchFixedLagSmoother(lag, parameters)


def _graph(robot: str, peers: Mapping[str, PeerEstimate]) -> OptimizedGraph:
    """The smoother's edges are its own: poses alone."""
    poses = {robot: np.zeros(3)} | {name: peer.pose for name, peer in peers.items() if peer.pose is not None}
    poses.pop(WORLD, None)
    return OptimizedGraph(dict(sorted(poses.items())), (), np.zeros((len(poses), len(poses))))
