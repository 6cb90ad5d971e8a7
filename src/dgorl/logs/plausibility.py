"""Whether a log's numbers can be what their units say: speeds, turn rates, ranges, σ, covariances."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from math import pi

import numpy as np

from dgorl.configuration import Configuration
from dgorl.findings import Finding, note
from dgorl.logs.log import Log
from dgorl.measurements import Displacement, Odometry, Range
from dgorl.se2 import Array, wrap

AREA = "log"
USUAL = 90.0
"""The percentile of speeds and turn rates that tells their unit."""
FAST = 2.0
"""A robot whose usual speed or turn rate is that many times the configured limit has another unit, or another limit."""
STEP, BUNCHED = 5.0, 0.1
"""A row so many times faster than a limit, over so long [s] at least, is no motion: the estimate leaves it out."""
CLOSING = 6.0
"""Two robots whose distance usually changes that many times as fast as one may drive have another unit of range."""
LISTED = 3
"""Impossible rows that are named for each robot."""
FAR = 1000.0
"""Radios that measure ranges do not reach so far [m]."""
LEAST_SIGMA = 1e-3
"""No radio is better [m]."""
APART, TOGETHER = 2.0, 10.0
"""Readings of a pair from so far to so far apart [s] tell how fast its distance changes."""


def plausibility(log: Log, configuration: Configuration) -> Iterator[Finding]:
    """Notes on what is implausible under a configuration: the defaults and what the log says of itself."""
    rows: dict[str, list[Odometry | Displacement]] = defaultdict(list)
    for m in log.measurements:
        if isinstance(m, Odometry | Displacement):
            rows[m.robot].append(m)
    for robot in log.robots:
        if rows[robot]:
            yield from _motion(robot, rows[robot], configuration)
            yield from _covariances(robot, rows[robot], configuration)
    yield from _ranges([m for m in log.measurements if isinstance(m, Range)], configuration)


def _motion(robot: str, rows: Sequence[Odometry | Displacement], configuration: Configuration) -> Iterator[Finding]:
    motion = configuration.motion
    moved = np.array([_moved(m) for m in rows]) * [motion.linear_scale, motion.angular_scale]
    duration = np.array([m.end - m.start for m in rows])
    limits = motion.maximum_speed, motion.maximum_turn_rate
    names = "maximum_speed", "maximum_turn_rate"
    impossible = np.zeros(len(rows), dtype=bool)
    for k, (what, unit) in enumerate((("drives", "m/s"), ("turns", "rad/s"))):
        rate = moved[:, k] / duration
        usual = float(np.percentile(rate, USUAL))
        if usual > FAST * limits[k]:
            advice = f"is that so? Then set `motion: {{{names[k]}: {usual:.2g}}}`"
            if k == 0 and usual > 20 * limits[k]:
                scale, size = (0.001, "mm") if usual > 200 * limits[k] else (0.01, "cm")
                advice = f"did you mean `motion: {{linear_scale: {scale:g}}}`, for {size}?"
            elif k == 1 and usual * pi / 180 < limits[k]:
                advice = "degrees? Then record radians, or set `motion: {angular_scale: 0.0174533}`"
            yield note(
                AREA, f"{robot}: {what} at {usual:.3g} {unit}, more than the {limits[k]:g} of `{names[k]}`", advice
            )
        else:
            impossible |= moved[:, k] > STEP * limits[k] * np.maximum(duration, BUNCHED)
    where = np.flatnonzero(impossible)
    for j in where[:LISTED]:
        what = f"{moved[j, 0]:.3g} m and {moved[j, 1]:.2g} rad in {duration[j]:.3g} s at {rows[j].start:.12g} s"
        more = f", and {len(where) - 1} more such rows" if len(where) > LISTED and j == where[0] else ""
        yield note(
            AREA,
            f"{robot}: an impossible step: {what}{more}",
            "left out: no motion is so much faster than `motion.maximum_speed`",
        )


def _moved(m: Odometry | Displacement) -> tuple[float, float]:
    """How far a row says that the robot drove and turned [m, rad]."""
    if isinstance(m, Odometry):
        return abs(m.v) * (m.end - m.start), abs(m.omega) * (m.end - m.start)
    return float(np.hypot(m.dx, m.dy)), abs(float(wrap(m.dtheta)))


def _covariances(
    robot: str, rows: Sequence[Odometry | Displacement], configuration: Configuration
) -> Iterator[Finding]:
    stated = [m for m in rows if isinstance(m, Displacement) and m.covariance is not None]
    motion = configuration.motion
    if not stated or not motion.stated_covariance:
        return
    sigma = np.sqrt([max(m.covariance[0], m.covariance[3]) for m in stated if m.covariance is not None])
    reach = np.array([motion.maximum_speed * (m.end - m.start) for m in stated])
    ratio = float(np.median(sigma / reach))
    if ratio > FAST:
        what = (
            f"{robot}: its odometry states a σ of {np.median(sigma):.3g} m a row, {ratio:.0f} times what it can drive"
        )
        advice = "an information matrix? Covariances are wanted; `motion: {stated_covariance: false}` leaves them out"
        yield note(AREA, what, advice)


def _ranges(ranges: Sequence[Range], configuration: Configuration) -> Iterator[Finding]:
    if not ranges:
        return
    ranging, motion = configuration.ranging, configuration.motion
    metres = ranging.scale * np.array([m.range for m in ranges]) + ranging.offset
    middle = float(np.median(metres))
    change = _changes(ranges, metres)
    doubtful = change > CLOSING * motion.maximum_speed
    if middle > FAR or doubtful:
        fits = [s for s in (0.3048, 0.01, 0.001) if change * s <= FAST * motion.maximum_speed and middle * s <= FAR]
        scale = ranging.scale * (fits[0] if fits else 0.001)
        size = f"{middle / 1000:.2g} km" if middle >= 1000 else f"{middle:.3g} m"
        fast = f", changing by {change:.3g} m/s" if doubtful else ""
        yield note(AREA, f"range: median {size}{fast}", f"did you mean `ranging: {{scale: {scale:.4g}}}`?")
    sigma = np.array([m.sigma for m in ranges if m.sigma is not None])
    if ranging.sigma is not None or not len(sigma):
        return
    usual = float(np.median(sigma))
    if usual > max(0.5 * middle, 1.0) or usual < LEAST_SIGMA:
        what = f"range: median σ {usual:.3g} m, of a median range of {middle:.3g} m"
        yield note(AREA, what, "a variance, or its inverse? σ is wanted [m]; `ranging: {sigma: …}` replaces it")


def _changes(ranges: Sequence[Range], metres: Array) -> float:
    """How fast distances change [m/s], in three quarters of all cases less; 0 if nothing tells."""
    pairs: dict[frozenset[str], list[int]] = defaultdict(list)
    for k, m in enumerate(ranges):
        pairs[frozenset((m.robot, m.peer))].append(k)
    found = []
    for members in pairs.values():
        stamps, values = np.array([ranges[k].stamp for k in members]), metres[members]
        order = np.argsort(stamps, kind="stable")
        stamps, values = stamps[order], values[order]
        later = np.searchsorted(stamps, stamps + APART)
        at = np.flatnonzero(later < len(stamps))
        apart = stamps[later[at]] - stamps[at]
        near = apart <= TOGETHER
        found.append(np.abs(values[later[at]] - values[at])[near] / apart[near])
    rates = np.concatenate(found)
    return float(np.percentile(rates, 75.0)) if len(rates) else 0.0
