"""A robot is carried away and its odometry does not notice: how soon its team does, and how soon it is back.

    python benchmarks/kidnapped.py --trials 20

Every trial replays one simulated log of 300 steps in which r2 is carried 10 m at step 100, unknown starts. Of every
pair that r2 is in: the time until its status is neither `tracked` nor `position`, and whether it is one of them at the
end, within max(2 m, 5σ) of the truth. Pairs that were not located before count as gone at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import repeat

import numpy as np

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.evaluation.metrics import position_error
from dgorl.evaluation.records import collect
from dgorl.replay import replay
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate

ROBOT = "r2"


def trial(seed: int, scenario: Scenario, at: float) -> Mapping[str, Array]:
    """Per pair with the robot: delay until gone, until back for good [s], wrong ticks; others called inconsistent."""
    log = simulate(replace(scenario, seed=seed))
    base = merge(Configuration(), log.configuration, "the simulated log")
    records = collect(replay(log, base, initial="unknown"), log.truth)
    gone, back, wrong, others = [], [], [], 0
    for record in records.between_robots():
        after = record.t > at
        inconsistent = np.array(["inconsistent" in reason for reason in record.reason])
        if ROBOT not in (record.ego, record.peer):
            others += int((inconsistent & after).any())
            continue
        located, t = record.located[after], record.t[after] - at
        gone.append(t[np.argmin(located)] if not located.all() else np.inf)
        sigma = np.sqrt(np.linalg.eigvalsh(record.covariance[:, :2, :2])[:, -1])
        error = np.hypot(*position_error(record).T)
        off = (error > np.maximum(2.0, 5 * sigma))[after] & located
        wrong.append(int(off.sum()))
        missing = np.flatnonzero(~located | off)
        last = missing[-1] + 1 if len(missing) else 0
        back.append(t[last] if last < len(t) else np.inf)
    return {"gone": np.array(gone), "back": np.array(back), "wrong": np.array(wrong), "others": np.array([others])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--metres", type=float, default=10.0)
    parser.add_argument("--sensor", default="rssi", choices=("rssi", "range"))
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    at = 50.0
    scenario = Scenario(steps=given.steps, sensors=(given.sensor,), teleport=f"{ROBOT}@{at:g}:{given.metres:g}")
    seeds = range(given.seed, given.seed + given.trials)
    with ProcessPoolExecutor(given.workers) as pool:
        trials = list(pool.map(trial, seeds, repeat(scenario), repeat(at)))
    gone, back = (np.concatenate([t[name] for t in trials]) for name in ("gone", "back"))
    print(f"{given.trials} trials, {ROBOT} carried {given.metres:g} m at {at:g} s, {given.sensor}, {len(gone)} pairs")
    print(f"gone within 15 s: {100 * np.mean(gone <= 15):.1f} % (required: all); median {np.median(gone):.1f} s,"
          f" slowest {gone.max():.1f} s")  # fmt: skip
    print(f"back before the end: {100 * np.mean(np.isfinite(back)):.1f} % (required: all);"
          f" for good after {np.median(back):.1f} s (median),"
          f" {np.quantile(back, 0.9, method='lower'):.1f} s (90 %)")  # fmt: skip
    print(f"ticks called located while wrong, a pair: {np.mean(np.concatenate([t['wrong'] for t in trials])):.2f}")
    print(f"pairs without {ROBOT} that were called inconsistent: {np.mean([t['others'][0] / 12 for t in trials]):.3f}")
    slow = [seed for seed, t in zip(seeds, trials, strict=True) if (t["gone"] > 15).any() or np.isinf(t["back"]).any()]
    print(f"trials with a pair that was slower, or not back: {slow}")


if __name__ == "__main__":
    main()
