"""Fits a platform's sensor model on a recording with ground truth: what stands in ``configs/``.

    python benchmarks/fit_sensors.py LOG [--truth FILE]

Wheel scales and lag minimise the robust error of the motion over 2 s; noise rates are non-negative least squares of
the squared errors over 5 s on time, turning and distance; range and bearing calibrations are robust regressions on the
true geometry. Prints YAML. Needs scipy.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import least_squares, minimize, nnls

from dgorl import Bearing, Displacement, Odometry, Range, _core, logs, se2
from dgorl.configuration import Motion
from dgorl.evaluation.records import truth_at
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, motion_values, odometry_row


def increments(rows: Array, motion: Motion, truth: Array, seconds: float) -> tuple[Array, Array, Array]:
    """Odometry's and the true motion over spans of ``seconds``, and |turn| and distance within them (S, 2)."""
    trail = _core.Trail(motion_values(motion))
    trail.extend(rows)
    span = int(seconds * KEYFRAMES_PER_SECOND)
    measured, true, effort = [], [], []
    for track in trail.tracks:
        delta, _ = _core.odometry([track], [track.first], [track.last])
        stamps = np.arange(track.first, track.last + 1) / KEYFRAMES_PER_SECOND
        poses = truth_at({"": truth}, "", stamps)
        for k in range(0, len(delta) - span, span):
            if np.isfinite(poses[[k, k + span]]).all():
                part = delta[k : k + span]
                measured.append(_core.chain(np.zeros(3), part)[-1])
                true.append(se2.between(poses[k], poses[k + span]))
                effort.append((np.abs(part[:, 2]).sum(), np.hypot(part[:, 0], part[:, 1]).sum()))
    return np.array(measured), np.array(true), np.array(effort)


def fit_motion(log: logs.Log, truth: dict[str, Array]) -> Motion:
    """Scales and lag common to all robots, then noise rates."""
    rows = {
        robot: np.array(sorted(odometry_row(m) for m in log.measurements if _odometry_of(m, robot)))
        for robot in log.robots
    }
    moving = [robot for robot in log.robots if robot in truth and np.ptp(truth[robot][:, 1:3]) > 0.5]

    def errors(motion: Motion, seconds: float) -> tuple[Array, Array]:
        parts = [increments(rows[robot], motion, truth[robot], seconds) for robot in moving]
        error = np.concatenate([se2.between(measured, true) for measured, true, _ in parts])
        return error, np.concatenate([effort for _, _, effort in parts])

    def cost(p: Sequence[float]) -> float:
        error, _ = errors(replace(Motion(), linear_scale=p[0], angular_scale=p[1], lag=p[2]), 2.0)
        scaled = error / (0.05, 0.05, 0.05)
        return float(np.log1p((scaled**2).sum(axis=1) / 4).sum())

    start = [[1.0, 1.0, 0.1], [0.93, 1.0, 0.1], [1.0, 0.93, 0.1], [1.0, 1.0, 0.25]]
    best = minimize(
        cost, start[0], method="Nelder-Mead", options={"initial_simplex": start, "xatol": 2e-3, "fatol": 0.5}
    )
    linear, angular, lag = (round(float(v), 3) for v in best.x)
    motion = replace(Motion(), linear_scale=linear, angular_scale=angular, lag=max(lag, 0.0))
    error, effort = errors(motion, 5.0)
    keep = (np.abs(error) < 6 * 1.4826 * np.median(np.abs(error), axis=0)).all(axis=1)
    error, (turned, distance) = error[keep], effort[keep].T
    ones = np.full(len(error), 5.0)
    heading, _ = nnls(np.column_stack([ones, turned, distance]), error[:, 2] ** 2)
    position, _ = nnls(np.column_stack([ones, distance]), error[:, 0] ** 2)
    rate = [round(float(np.sqrt(v)), 4) for v in (*heading, *position)]
    return replace(
        motion,
        heading_per_second=max(rate[0], 0.003), heading_per_radian=rate[1], heading_per_metre=rate[2],
        position_per_second=max(rate[3], 0.002), forward_per_metre=rate[4], lateral_per_metre=round(rate[4] / 3, 4),
    )  # fmt: skip


def fit_pairs(log: logs.Log, truth: dict[str, Array], kind: type[Range] | type[Bearing]) -> dict[str, float]:
    """Calibration and σ of ranges or bearings against the true geometry."""
    found = []
    for m in log.measurements:
        if isinstance(m, kind):
            a, b = (m.robot, m.peer) if isinstance(m, Range) else (m.observer, m.target)  # type: ignore[union-attr]
            if a in truth and b in truth:
                stamp = np.array([m.stamp])
                T = se2.between(truth_at(truth, a, stamp), truth_at(truth, b, stamp))[0]
                if not np.isfinite(T).all():
                    continue
                if isinstance(m, Range):
                    found.append((m.range, np.hypot(T[0], T[1])))
                else:
                    found.append((m.bearing, np.arctan2(T[1], T[0])))  # type: ignore[union-attr]
    if not found:
        return {}
    raw, true = np.array(found).T
    if kind is Bearing:
        fit = least_squares(lambda p: se2.wrap(raw + p[0] - true), [0.0], loss="cauchy", f_scale=0.01)
        error = se2.wrap(raw + fit.x[0] - true)
        return {
            "offset": round(float(fit.x[0]), 4),
            "sigma": round(float(1.4826 * np.median(np.abs(error))), 4),
        }
    fit = least_squares(lambda p: p[0] * raw + p[1] - true, [1.0, 0.0], loss="cauchy", f_scale=0.05)
    error = fit.x[0] * raw + fit.x[1] - true
    scale, offset = (round(float(v), 3) for v in fit.x)
    return {"scale": scale, "offset": offset, "sigma": round(float(1.4826 * np.median(np.abs(error))), 3)}


def _odometry_of(m: object, robot: str) -> bool:
    return isinstance(m, Odometry | Displacement) and m.robot == robot


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--truth", type=Path)
    arguments = parser.parse_args()
    log = logs.read(arguments.log)
    truth = dict(logs.read_truth(arguments.truth, log.robots) if arguments.truth else log.truth)
    motion = fit_motion(log, truth)
    found = {"motion": {k: v for k, v in vars(motion).items() if v != getattr(Motion(), k)}}
    for name, kind in (("ranging", Range), ("bearings", Bearing)):
        fit = fit_pairs(log, truth, kind)
        if fit:
            found[name] = fit
    print(yaml.safe_dump(found, sort_keys=False))


if __name__ == "__main__":
    main()
