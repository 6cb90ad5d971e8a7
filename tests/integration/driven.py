"""Teams whose robots drive as they are told, with little noise, and ways to look at what is said of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from dgorl import Configuration, Displacement, Localizer, Range, Rssi, Status, Team, se2
from dgorl.configuration import merge
from dgorl.estimate import Estimate, PeerEstimate
from dgorl.logs.log import Log, in_order
from dgorl.measurements import Measurement, known_at
from dgorl.places import MISSED
from dgorl.radio import range_to_rssi

Array = np.ndarray
Heard = Callable[[str, str, float], bool]
PERIOD = 0.5
STEP_SIGMA = np.array([0.01, 0.01, 0.01])
"""Noise of a step's odometry [m, m, rad]."""
RANGE_SIGMA = 0.1
SHARE_95 = 5.991
"""95 % quantile of χ²(2)."""
KNOWN = (Status.POSITION, Status.TRACKED)


def always(a: str, b: str, stamp: float) -> bool:
    return True


def log_of(starts: Array, twists: Array, *, sensor: str = "range", heard: Heard = always, seed: int = 0) -> Log:
    """The log of robots r1… that follow twists (steps, n, 2) of v [m/s], ω [rad/s] from starts (n, 3)."""
    rng = np.random.default_rng([seed, 1])
    names = tuple(f"r{k + 1}" for k in range(len(starts)))
    xx, yy, tt = STEP_SIGMA**2
    poses, measurements = [np.asarray(starts, dtype=float)], []
    radio = Configuration().radio
    for k, twist in enumerate(twists):
        told = np.column_stack([twist[:, 0], np.zeros(len(names)), twist[:, 1]]) * PERIOD
        poses.append(se2.compose(poses[-1], se2.exp(told + STEP_SIGMA * rng.normal(size=told.shape))))
        start, end = k * PERIOD, (k + 1) * PERIOD
        for name, motion in zip(names, se2.exp(told).tolist(), strict=True):
            measurements.append(Displacement(name, start, end, *motion, (xx, 0.0, 0.0, yy, 0.0, tt)))
        for (i, a), (j, b) in combinations(enumerate(names), 2):
            noise, d = rng.normal(), float(np.hypot(*(poses[-1][i] - poses[-1][j])[:2]))
            if not heard(a, b, end):
                continue
            if sensor == "range":
                measurements.append(Range(a, b, end, max(d + RANGE_SIGMA * noise, 0.0), RANGE_SIGMA))
            else:
                measurements.append(Rssi(a, b, end, float(range_to_rssi(d, radio)) + 2.0 * noise))
    stamps = PERIOD * np.arange(len(poses))
    truth = {name: np.column_stack([stamps, np.array(poses)[:, i]]) for i, name in enumerate(names)}
    return Log(Path("driven"), names, in_order(measurements), truth)


def walks(homes: Array, steps: int, *, radius: float = 6.0, seed: int = 0) -> tuple[Array, Array]:
    """Starts (n, 3) and twists (steps, n, 2) of robots that wander about their homes (n, 2) [m]."""
    rng = np.random.default_rng([seed, 2])
    homes = np.asarray(homes, dtype=float)
    n = len(homes)
    starts = np.column_stack([homes + rng.uniform(-3, 3, (n, 2)), rng.uniform(-np.pi, np.pi, n)])
    at, omega, twists = starts, np.zeros(n), []
    for _ in range(steps):
        omega = np.clip(0.8 * omega + 0.3 * rng.normal(size=n), -0.8, 0.8)
        back = homes - at[:, :2]
        turn = np.clip(se2.wrap(np.arctan2(back[:, 1], back[:, 0]) - at[:, 2]), -0.8, 0.8)
        omega = np.where(np.hypot(*back.T) > radius, turn, omega)
        twists.append(np.column_stack([np.full(n, 0.5), omega]))
        at = se2.compose(at, se2.exp(np.column_stack([np.full(n, 0.5), np.zeros(n), omega]) * PERIOD))
    return starts, np.array(twists)


def wandering(homes: Sequence[Sequence[float]], seconds: float, *, seed: int = 0, **options: object) -> Log:
    return log_of(*walks(np.array(homes), int(seconds / PERIOD), seed=seed), seed=seed, **options)


def localizers(log: Log, **changes: object) -> tuple[Team, list[Localizer]]:
    team = Team(merge(merge(Configuration(), log.configuration, "log"), changes, "test"))
    return team, [Localizer(robot, team=team) for robot in log.robots]


def watched(log: Log, stamps: Iterable[float], ego: str = "r1", **changes: object) -> list[Estimate]:
    """What ``ego`` says at the stamps, measurements arriving as they become known; starts are not."""
    team, _ = localizers(log, **changes)
    localizer = Localizer(ego, team=team)
    waiting = iter(sorted(log.measurements, key=known_at))
    following = next(waiting, None)
    found = []
    for now in stamps:
        while following is not None and known_at(following) <= now:
            team.add(following)
            following = next(waiting, None)
        found.append(localizer.update(float(now)))
    return found


def every(period: float, until: float, since: float = 0.0) -> Array:
    return np.arange(since + period, until + 1e-9, period)


def true_relative(log: Log, ego: str, peer: str, stamp: float) -> Array:
    row = round(stamp / PERIOD)
    return se2.between(log.truth[ego][row, 1:], log.truth[peer][row, 1:])


def position_error(log: Log, estimate: Estimate, peer: str) -> tuple[float, float, float]:
    """Error [m], its Mahalanobis distance, and the largest σ [m] of a peer's position."""
    found = estimate[peer]
    e = found.pose[:2] - true_relative(log, estimate.robot, peer, estimate.stamp)[:2]
    covariance = found.covariance[:2, :2]
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return float(np.hypot(*e)), float(np.sqrt(e @ np.linalg.solve(covariance, e))), sigma


def is_right(log: Log, estimate: Estimate, peer: str, metres: float = 1.0) -> bool:
    error, normalised, _ = position_error(log, estimate, peer)
    return error < metres and normalised < 5.0


def explains_itself(peer: PeerEstimate) -> bool:
    """A located peer has a pose; every other says why not; an ambiguous one's places sum up to certainty."""
    if peer.status in KNOWN:
        return peer.pose is not None and bool(np.isfinite(peer.pose).all() and np.isfinite(peer.covariance).all())
    total = sum(place.probability for place in peer.hypotheses)
    return bool(peer.reason) and (not peer.hypotheses or abs(total - (1.0 - MISSED)) < 1e-9)


def bits(estimate: Estimate) -> dict[str, object]:
    """All an estimate says, comparable bit for bit."""

    def raw(array: Array | None) -> bytes:
        return b"" if array is None else array.tobytes()

    return {
        peer: (
            found.status, raw(found.pose), raw(found.covariance), found.probability, found.age, found.reason,
            found.resolve_by, tuple((h.probability, raw(h.pose), raw(h.covariance)) for h in found.hypotheses),
        )
        for peer, found in estimate.items()
    }  # fmt: skip


def arriving(
    measurements: Sequence[Measurement], arrive: Sequence[float], log: Log, stamps: Iterable[float], **changes: object
) -> list[dict[str, object]]:
    """Every robot's estimates at the stamps when measurement k arrives at ``arrive[k]`` [s]."""
    team, egos = localizers(log, **changes)
    order = sorted(range(len(measurements)), key=lambda k: (arrive[k], k))
    found, taken = [], 0
    for now in stamps:
        while taken < len(order) and arrive[order[taken]] <= now:
            team.add(measurements[order[taken]])
            taken += 1
        found.append({ego.robot: bits(ego.update(float(now))) for ego in egos})
    return found
