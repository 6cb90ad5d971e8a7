"""Readings between robots as factors of GTSAM. METHOD §2, §7.

GTSAM has ranges and bearings, of a kind in which only the first robot's sensor may stand off its pose, and no signal
strength. Two ways round that:

- native: a range factor that has the reading's residual and slope at the distance predicted when it is added. An RSSI
  is then whitened in dB, with σ growing with the distance, at the speed of C++; later relinearisation sees a straight
  line instead of the logarithm.
- callback: one factor in Python for all new readings of a kind, exact at every linearisation, with every kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dgorl import se2
from dgorl.baselines.fixed_lag_graph import Additions, Place
from dgorl.configuration import Bearings, Radio, Ranging
from dgorl.history import LATE, History
from dgorl.optimization.linearization import parts
from dgorl.optimization.problem import Loss, Problem, Scalars
from dgorl.radio import MINIMUM_DISTANCE
from dgorl.se2 import Array
from dgorl.sightings import Rows, Table


class Readings:
    """Adds each reading of a history once: the first of its thinning bin that is heard of.

    callbacks: kinds that become callbacks; one-sided kernels, which GTSAM has not, always do.
    """

    def __init__(self, gtsam: Any, history: History, callbacks: frozenset[str]) -> None:
        self._gtsam, self._history = gtsam, history
        sensors: dict[str, Radio | Ranging | Bearings] = {
            "rssi": history.configuration.radio,
            "range": history.configuration.ranging,
            "bearing": history.configuration.bearings,
        }
        self._sensors = sensors
        self._callbacks = callbacks | {kind for kind, s in sensors.items() if s.kernel.endswith("negative")}
        self._used: dict[str, dict[tuple[int, int], float]] = {kind: {} for kind in sensors}

    def add(self, additions: Additions, now: float) -> None:
        """The readings that became usable: stamped ≤ now [s] where the odometry of both ends is known."""
        for kind, table in self._history.tables.items():
            rows = self._fresh(kind, table, additions, now) if len(table) else None
            if rows is None or not len(rows.stamp):
                continue
            scalars, chains = self._scalars(kind, rows, additions)
            if kind in self._callbacks:
                self._callback(scalars, chains, additions)
            else:
                self._native(scalars, chains, additions)

    def _fresh(self, kind: str, table: Table, additions: Additions, now: float) -> Rows:
        """Rows on chains in the window whose bin is later than the last one used of that pair."""
        size = len(self._history.numbers) + 1  # the last entry answers for rows without a track
        first, last, until = np.zeros(size, np.int64), np.full(size, -1), np.full(size, -np.inf)
        for chain in additions.chains.values():
            number = chain.core.number
            first[number], last[number], until[number] = min(chain.keys), chain.last, chain.core.known(now)
        thinning = self._sensors[kind].thinning
        rows = table.between(now - LATE - thinning, now)
        a, b = rows.track_a, rows.track_b
        use = rows.stamp <= np.minimum(until[a], until[b])
        use &= (first[a] <= rows.keyframe_a) & (rows.keyframe_a <= last[a])
        use &= (first[b] <= rows.keyframe_b) & (rows.keyframe_b <= last[b])
        bins = np.ceil(rows.stamp / thinning) if thinning > 0 else rows.stamp
        used = np.full((size, size), -np.inf)
        for pair, until_bin in self._used[kind].items():
            used[pair] = until_bin
        low, high = (np.minimum(a, b), np.maximum(a, b)) if kind == "range" else (a, b)
        use &= bins > used[low, high]
        latest = self._used[kind]
        for i, j, found in zip(low[use].tolist(), high[use].tolist(), bins[use].tolist(), strict=True):
            latest[i, j] = max(latest.get((i, j), -np.inf), found)
        return Rows(*(column[use] for column in rows))

    def _scalars(self, kind: str, rows: Rows, additions: Additions) -> tuple[Scalars, list[Place]]:
        """Readings between poses by place in a list of (chain, keyframe), antennas in their offsets."""
        chains = {chain.core.number: chain for chain in additions.chains.values()}
        ends = np.concatenate([rows.track_a, rows.track_b]), np.concatenate([rows.keyframe_a, rows.keyframe_b])
        poses, place = np.unique(np.stack(ends, axis=1), axis=0, return_inverse=True)
        i, j = place.reshape(2, -1)
        at_a, at_b, height = rows.offset_a, rows.offset_b, np.zeros(len(i))
        if kind != "bearing" and self._history.configuration.antennas:
            tracks = zip(rows.track_a.tolist(), rows.track_b.tolist(), strict=True)
            antenna = np.array([[self._history.antenna(chains[k].key.robot) for k in pair] for pair in tracks])
            at_a = np.column_stack([se2.transform(at_a, antenna[:, 0, :2]), at_a[:, 2]])
            at_b = np.column_stack([se2.transform(at_b, antenna[:, 1, :2]), at_b[:, 2]])
            height = antenna[:, 0, 2] - antenna[:, 1, 2]
        sensor = self._sensors[kind]
        scalars = Scalars(kind, i, j, at_a, at_b, height, rows.value, rows.sigma, Loss(sensor.kernel, sensor.width))
        if kind == "rssi" and sensor.kernel == "none":
            scalars = _both_ways(scalars, rows.stamp)
        return scalars, [(chains[number], keyframe) for number, keyframe in poses.tolist()]

    def _native(self, s: Scalars, chains: Sequence[Place], additions: Additions) -> None:
        gtsam = self._gtsam
        value, sigma = s.value, s.sigma
        if s.kind != "bearing":
            guess = np.array([chain.poses[keyframe] for chain, keyframe in chains])
            radio = self._history.configuration.radio
            value, sigma = tangent(s, guess, (radio.rssi_at_1m_dbm, radio.path_loss_exponent))
        for i, j, at_i, at_j, reading, noise in zip(s.i, s.j, s.at_i, s.at_j, value, sigma, strict=True):
            model = self._robust(s.loss, gtsam.noiseModel.Isotropic.Sigma(1, noise))
            b = additions.at(chains[j], at_j)
            if s.kind == "bearing":
                a = additions.at(chains[i], at_i)
                additions.factors.add(gtsam.BearingFactorPose2(a, b, gtsam.Rot2(reading), model))
                continue
            chain, keyframe = chains[i]
            a = chain.keys[keyframe]
            if at_i.any():
                arm = gtsam.Pose2(*at_i)
                additions.factors.add(gtsam.RangeFactorWithTransformPose2(a, b, reading, model, arm))
            else:
                additions.factors.add(gtsam.RangeFactorPose2(a, b, reading, model))

    def _robust(self, loss: Loss, model: Any) -> Any:
        if loss.kernel == "none":
            return model
        noise = self._gtsam.noiseModel
        kernel = noise.mEstimator.Huber if loss.kernel == "huber" else noise.mEstimator.Cauchy
        return noise.Robust.Create(kernel.Create(loss.width), model)

    def _callback(self, s: Scalars, chains: Sequence[Place], additions: Additions) -> None:
        radio = self._history.configuration.radio
        keys = [chain.keys[keyframe] for chain, keyframe in chains]
        error = callback(s, keys, (radio.rssi_at_1m_dbm, radio.path_loss_exponent))
        unit = self._gtsam.noiseModel.Unit.Create(len(s.value))
        additions.factors.add(self._gtsam.CustomFactor(unit, keys, error))


def tangent(s: Scalars, poses: Array, radio: tuple[float, float]) -> tuple[Array, Array]:
    """Ranges and σ (M,) of plain range factors equal to the readings to first order at ``poses`` (N, 3).

    With e(d) the reading's error and e′ its slope at the predicted horizontal distance d: d − e/e′ and σ/e′. A range
    between antennas of one height is itself.
    """
    ab = se2.transform(poses[s.i], s.at_i[:, :2]) - se2.transform(poses[s.j], s.at_j[:, :2])
    d = np.maximum(np.hypot(ab[:, 0], ab[:, 1]), MINIMUM_DISTANCE)
    slant = np.hypot(d, s.height)
    if s.kind == "rssi":
        at_1m, exponent = radio
        decay = 10.0 * exponent / np.log(10.0)
        error, slope = s.value - at_1m + decay * np.log(slant), decay * d / slant**2
    else:
        error, slope = slant - s.value, d / slant
    return d - error / slope, s.sigma / slope


def callback(s: Scalars, keys: Sequence[int], radio: tuple[float, float]) -> Callable[[Any, Any, Any], Array]:
    """Whitened residuals (M,) and Jacobians of readings between the poses of ``keys``, as GTSAM calls for them."""
    none, count, rows = np.zeros(0, np.int64), len(keys), np.arange(len(s.value))
    empty = (none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    problem = Problem(np.zeros(count, np.int64), np.zeros(count, bool), np.zeros((count, 3)), empty, (s,), radio=radio)
    part = parts(problem)[-1]

    def error(_: Any, values: Any, jacobians: Any) -> Array:
        poses = [values.atPose2(key) for key in keys]
        family = part(np.array([(pose.x(), pose.y(), pose.theta()) for pose in poses]))
        if jacobians is not None:
            whole = np.zeros((count, len(rows), 3))
            whole[s.i, rows] = family.jacobian[:, 0, :3]
            whole[s.j, rows] = family.jacobian[:, 0, 3:]
            for k in range(count):
                jacobians[k] = np.asfortranarray(whole[k])
        return family.residual[:, 0]

    return error


def _both_ways(s: Scalars, stamps: Array) -> Scalars:
    """One reading for those of both directions at one time: their mean says the same with half the factors."""
    swap = s.i > s.j
    i, j = np.where(swap, s.j, s.i), np.where(swap, s.i, s.j)
    at_i, at_j = np.where(swap[:, None], s.at_j, s.at_i), np.where(swap[:, None], s.at_i, s.at_j)
    order = np.lexsort((j, i, stamps))
    i, j, stamps = i[order], j[order], stamps[order]
    new = np.ones(len(i), bool)
    new[1:] = (np.diff(stamps) != 0) | (np.diff(i) != 0) | (np.diff(j) != 0)
    starts: NDArray[np.intp] = np.flatnonzero(new)
    count = np.diff(np.append(starts, len(i)))
    chosen = order[starts]
    return replace(
        s, i=i[starts], j=j[starts], at_i=at_i[chosen], at_j=at_j[chosen], height=np.abs(s.height[chosen]),
        value=np.add.reduceat(s.value[order], starts) / count, sigma=s.sigma[chosen] / np.sqrt(count),
    )  # fmt: skip
