"""Is a place that is said to have probability p right in a share p of the ticks, or more?

    python benchmarks/calibration.py --logs 12

Half of the logs are simulated by ``dgorl.simulation`` (RSSI of five robots, ranges of two and three), half drawn by
``clean_teams.py``; unknown starts. Of every tick at which a peer is ambiguous all its places count. Right is within 5σ
of the truth, or 2 m. Ticks of one log go together, so the number of logs is what tells how firm a row is.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise

import numpy as np
from clean_teams import drawn

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.evaluation.metrics import position_sigma
from dgorl.evaluation.records import collect
from dgorl.logs.log import Log
from dgorl.replay import replay
from dgorl.simulation import Scenario, simulate

EDGES = (0.0, 0.05, 0.1, 0.3, 0.6, 0.8, 0.9, 0.95, 0.97, 0.985, 1.0)
NEAR, SIGMAS = 2.0, 5.0

Place = tuple[float, bool]


def log_of(seed: int) -> Log:
    """Kinds in turn."""
    scenarios = (
        Scenario(seed=seed, steps=120),
        Scenario(seed=seed, robots=3, area=20.0, sensors=("range",), steps=100),
        Scenario(seed=seed, robots=2, area=25.0, sensors=("range",), steps=120),
    )
    return drawn(seed, 50.0).log() if seed % 2 else simulate(scenarios[seed // 2 % 3])


def trial(seed: int) -> list[list[Place]]:
    """Of every ambiguous tick and pair the probability of each place, and whether it is right."""
    log = log_of(seed)
    records = collect(replay(log, merge(Configuration(), log.configuration, "log"), initial="unknown"), log.truth)
    return [
        list(_judged(record.truth[k], places))
        for record in records.between_robots()
        for k, places in record.hypotheses.items()
    ]


def _judged(truth: np.ndarray, places: tuple) -> Iterator[Place]:
    for place in places:
        error = float(np.hypot(*(place.pose - truth)[:2]))
        yield place.probability, error < max(NEAR, SIGMAS * float(position_sigma(place.covariance[None])[0]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0, help="of the first log")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + given.logs)
    with ProcessPoolExecutor(given.workers) as pool:
        found = list(zip(seeds, pool.map(trial, seeds), strict=True))
    ticks = [places for _, rows in found for places in rows]
    none = 100 * np.mean([not any(right for _, right in places) for places in ticks])
    print(f"{given.logs} logs, {len(ticks)} ambiguous ticks of pairs; no place right in {none:.2f} %")
    rows = np.array([(p, right, seed) for seed, rows in found for places in rows for p, right in places])
    for low, high in pairwise(EDGES):
        inside = rows[(rows[:, 0] >= low) & (rows[:, 0] < high)]
        if len(inside):
            p, right, _ = inside.mean(axis=0)
            logs = len(np.unique(inside[:, 2]))
            print(f"{low:5.3f} to {high:5.3f}: said {p:.3f}, right {right:.3f}, {len(inside)} places of {logs} logs")


if __name__ == "__main__":
    main()
