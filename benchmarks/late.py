"""What others measured comes late, by the same time for all: how well is a peer foreseen, and how honestly?

    python benchmarks/late.py [DATA] --delays 0,0.5,1,2,4

Every ego hears what peers measured so many seconds late, its own measurements ``--own`` seconds. Known starts, with
what travels late of them, too. Of every delay: located ticks, RMSE [m] of all ticks and of the located, those of the
located inside their 95 % ellipse, all ticks inside it. DATA holds ``mrclam6``; without it the simulator alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, floor
from pathlib import Path

import numpy as np

from dgorl import Configuration, Localizer, logs, se2
from dgorl.configuration import load, merge
from dgorl.evaluation.metrics import CHI2_95_2DOF
from dgorl.evaluation.records import LOCATED, truth_at
from dgorl.logs.log import Log
from dgorl.measurements import Bearing, Displacement, Measurement, Odometry, Range, RelativePose, Rssi, known_at
from dgorl.replay import known_starts
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate

CONFIGS = Path(__file__).parents[1] / "configs"
SKIPPED = 15.0
"""The first seconds do not count."""


@dataclass(frozen=True)
class Foreseen:
    """By tick and peer: error [m], squared by its covariance, whether it was located; NaN without a pose."""

    error: Array
    squared: Array
    located: Array


def observer(m: Measurement) -> str:
    """Whose news a measurement is."""
    match m:
        case Odometry() | Displacement() | Range():
            return m.robot
        case Rssi():
            return m.receiver
        case Bearing():
            return m.observer
        case RelativePose():
            return m.reference
    raise TypeError(m)


def foreseen(log: Log, configuration: Configuration, ego: str, delay: float, own: float) -> Foreseen:
    """One ego's estimates of its peers, at every period."""
    begin = min(known_at(m) for m in log.measurements)
    late = [(known_at(m) + (own if observer(m) == ego else delay), m) for m in log.measurements]
    late = [(begin, m) for m in known_starts(log)] + sorted(late, key=lambda item: item[0])
    period, found, taken = configuration.period, [], 0
    localizer = Localizer(ego, configuration)
    for k in range(ceil(begin / period), floor(max(known_at(m) for m in log.measurements) / period) + 1):
        now = k * period
        while taken < len(late) and late[taken][0] <= now:
            localizer.add(late[taken][1])
            taken += 1
        estimate = localizer.update(now)
        if now < begin + SKIPPED:
            continue
        mine = truth_at(log.truth, ego, np.array([now]))[0]
        for name in log.robots:
            other = truth_at(log.truth, name, np.array([now]))[0]
            if name == ego or not np.isfinite([mine, other]).all():
                continue
            peer = estimate.get(name)
            if peer is None or peer.pose is None or peer.covariance is None:
                found.append((np.nan, np.nan, False))
                continue
            error = peer.pose[:2] - se2.between(mine, other)[:2]
            squared = error @ np.linalg.solve(peer.covariance[:2, :2], error)
            found.append((np.hypot(*error), squared, peer.status in LOCATED))
    return Foreseen(*np.array(found).T)


def report(title: str, parts: Sequence[Foreseen]) -> None:
    """One line: ``parts`` pooled."""
    error, squared, located = (np.concatenate([getattr(p, k) for p in parts]) for k in ("error", "squared", "located"))
    known, located = np.isfinite(error), located.astype(bool)
    inside = squared <= CHI2_95_2DOF
    print(
        f"{title:24} located {located.mean():.3f}  RMSE {np.sqrt(np.mean(error[known] ** 2)):.2f} m,"
        f" located {np.sqrt(np.mean(error[located] ** 2)) if located.any() else np.nan:.2f} m"
        f"  inside the 95 % ellipse {100 * inside[known].mean():.1f} %,"
        f" located {100 * inside[located].mean() if located.any() else np.nan:.1f} %",
        flush=True,
    )


def case(name: str, data: Path | None, seconds: float, sensor: str) -> tuple[Log, Configuration]:
    """A log, ``seconds`` long, and its configuration."""
    if name == "mrclam":
        assert data is not None
        log = logs.select(logs.read(data / "mrclam6"), ("range", "bearing"))
        configuration = merge(Configuration(), load(CONFIGS / "mrclam.yaml"), "mrclam.yaml")
    else:
        log = simulate(Scenario(robots=5, area=30.0, steps=int(seconds * 2), seed=0, sensors=(sensor,)))
        configuration = merge(Configuration(), log.configuration, "the simulated log")
    end = min(known_at(m) for m in log.measurements) + seconds
    return replace(log, measurements=tuple(m for m in log.measurements if known_at(m) <= end)), configuration


def one(name: str, data: Path | None, seconds: float, sensor: str, own: float, job: tuple[str, float]) -> Foreseen:
    log, configuration = case(name, data, seconds, sensor)
    return foreseen(log, configuration, job[0], job[1], own)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--delays", default="0,0.5,1,2,4")
    parser.add_argument("--own", type=float, default=0.0, help="the ego's own delay [s]")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--sensor", default="rssi", choices=("rssi", "range"))
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    delays = [float(text) for text in given.delays.split(",")]
    for name in ("simulator", "mrclam") if given.data else ("simulator",):
        log, _ = case(name, given.data, given.seconds, given.sensor)
        jobs = [(ego, delay) for delay in delays for ego in log.robots]
        run = partial(one, name, given.data, given.seconds, given.sensor, given.own)
        with ProcessPoolExecutor(given.workers) as pool:
            found = list(pool.map(run, jobs))
        for delay in delays:
            report(f"{name}, {delay:g} s late", [f for f, job in zip(found, jobs, strict=True) if job[1] == delay])


if __name__ == "__main__":
    main()
