"""How close the estimate is to the expected Cramér–Rao bound on the simulator's default team, known starts.

    python benchmarks/bound.py --trials 100 --workers 2

Every trial replays one simulated log causally, once per window, and takes the bound of the same log at the same ticks
and pairs (METHOD §8): pooled RMSE over steps 10…100 ÷ pooled bound, with a bootstrap interval over trials. Every tick
counts, whatever its status.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.evaluation.bounds import bound
from dgorl.evaluation.metrics import CHI2_95_2DOF, heading_error, nees, position_error, position_nees
from dgorl.evaluation.records import collect
from dgorl.evaluation.statistics import bootstrap, root_ratio
from dgorl.replay import known_starts, replay
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate

FIRST = 10
"""Steps before this one do not count."""

WINDOWS: tuple[Any, ...] = ("all", 20.0)


def trial(seed: int, scenario: Scenario) -> Mapping[str, Mapping[str, float]]:
    """Mean squares of one trial per window, and of the bound: a pure function of (seed, scenario)."""
    log = simulate(replace(scenario, seed=seed))
    base = merge(Configuration(), log.configuration, "the simulated log")
    found: dict[str, Mapping[str, float]] = {}
    for window in WINDOWS:
        pairs = collect(replay(log, replace(base, window=window)), log.truth).between_robots()
        counted = [record.t >= FIRST * scenario.period for record in pairs]
        squares = [(position_error(r)[k] ** 2).sum(axis=1) for r, k in zip(pairs, counted, strict=True)]
        turns = [heading_error(r)[k] ** 2 for r, k in zip(pairs, counted, strict=True)]
        inside = [position_nees(r)[k] < CHI2_95_2DOF for r, k in zip(pairs, counted, strict=True)]
        whole = [nees(r)[k] for r, k in zip(pairs, counted, strict=True)]
        found[str(window)] = {
            "square": float(np.mean(squares)),
            "heading": float(np.mean(turns)),
            "inside": float(np.mean(inside)),
            "nees": float(np.mean(whole)),
        }
    stamps = np.arange(FIRST, scenario.steps + 1) * scenario.period
    least = np.array(list(bound(log, base, list(known_starts(log)), stamps).values()))
    found["bound"] = {
        "square": float(np.mean(least[..., 0, 0] + least[..., 1, 1])),
        "heading": float(np.mean(least[..., 2, 2])),
    }
    return found


def interval(a: Array, b: Array) -> tuple[float, float]:
    """95 % bootstrap interval over trials of √(mean a ÷ mean b)."""
    return bootstrap(np.column_stack([a, b]), root_ratio)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    scenario = Scenario(robots=arguments.robots, steps=arguments.steps)
    seeds = range(arguments.seed, arguments.seed + arguments.trials)
    with ProcessPoolExecutor(arguments.workers) as pool:
        trials = list(pool.map(trial, seeds, [scenario] * len(seeds)))

    def column(what: str, key: str) -> Array:
        return np.array([t[what][key] for t in trials])

    print(f"{arguments.trials} trials, {arguments.robots} robots, steps {FIRST}…{arguments.steps}, known starts")
    least = column("bound", "square")
    turn = np.degrees(np.sqrt(column("bound", "heading").mean()))
    print(f"bound: position {np.sqrt(least.mean()):.3f} m, heading {turn:.2f}°")
    for window in map(str, WINDOWS):
        square = column(window, "square")
        low, high = interval(square, least)
        inside, whole = 100 * column(window, "inside").mean(), column(window, "nees").mean()
        rmse, turn = np.sqrt(square.mean()), np.degrees(np.sqrt(column(window, "heading").mean()))
        print(
            f"window {window}: position RMSE {rmse:.3f} m, ÷ bound {rmse / np.sqrt(least.mean()):.3f}"
            f" [{low:.3f}, {high:.3f}]; heading {turn:.2f}°;"
            f" in 95 % ellipse {inside:.1f} %; NEES {whole:.2f} of 3"
        )
    short, whole = column(str(WINDOWS[1]), "square"), column(str(WINDOWS[0]), "square")
    low, high = interval(short, whole)
    ratio = np.sqrt(short.mean() / whole.mean())
    print(f"window {WINDOWS[1]} ÷ window all, same logs: {ratio:.4f} [{low:.4f}, {high:.4f}]")


if __name__ == "__main__":
    main()
