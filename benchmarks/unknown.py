"""How unknown starts are resolved in simulated teams: who is found when, how well, and how honestly.

    python benchmarks/unknown.py --trials 100 --steps 300 --workers 2

Every trial replays one simulated log causally with ``initial="unknown"`` and takes the unknown-start bound of the same
log (METHOD §8). Intervals are 95 % bootstraps over trials. σ is the root of the position covariance's largest
eigenvalue.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any, get_args

import numpy as np

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.estimate import PeerHypothesis, Status
from dgorl.evaluation.bounds import bound
from dgorl.evaluation.metrics import CHI2_95_2DOF, position_error, position_nees, position_sigma, time_to_track
from dgorl.evaluation.records import PairRecord, collect
from dgorl.replay import replay
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate
from dgorl.simulation.scenario import Motion

BOUND_SPACING = 2.5
"""Seconds between the stamps the bound is computed at; between them its logarithm is interpolated."""
NEAR, SIGMAS = 2.0, 5.0
"""A hypothesis is right, an estimate not wrong, within this many metres or σ of the truth, whichever is more."""
UNJOINED = (Status.ISOLATED, Status.AMBIGUOUS)

Trial = dict[str, Any]


def trial(seed: int, scenario: Scenario, window: str) -> Trial:
    """The numbers of one trial: a pure function of its arguments."""
    log = simulate(replace(scenario, seed=seed))
    base = merge(Configuration(), log.configuration, "the simulated log")
    base = replace(base, window="all" if window == "all" else float(window))
    records = collect(replay(log, base, initial="unknown"), log.truth)
    pairs, t = records.between_robots(), records.stamps
    grid = np.unique(np.append(np.arange(BOUND_SPACING, t[-1], BOUND_SPACING), t[-1]))
    least = bound(log, base, [], grid)
    none = np.full((len(grid), 3, 3), np.nan)
    checks = {step: int(np.searchsorted(t, step * scenario.period - 1e-9)) for step in checkpoints(scenario)}
    unjoined = np.array([record.having(*UNJOINED) for record in pairs])
    together = np.asarray(~unjoined.any(axis=0))
    cpu_ms = 1e3 * np.mean(list(records.tick_s.values()), axis=0)
    return {
        "seed": seed,
        "pairs": [pair(r, base.status, least.get((r.ego, r.peer), none), grid, checks) for r in pairs],
        "together": {step: bool(together[k]) for step, k in checks.items()},
        "joined_s": float(t[np.argmax(together)]) if together.any() else None,
        "ticks": len(t) * len(pairs),
        "cpu_ms_unjoined": cpu_ms[~together].tolist(),
        "cpu_ms_joined": cpu_ms[together].tolist(),
    }


def checkpoints(scenario: Scenario) -> list[int]:
    """Steps at which hypotheses and membership are looked at."""
    return sorted({min(step, scenario.steps) for step in (100, 300)})


def pair(record: PairRecord, limits: Any, least: Array, grid: Array, checks: Mapping[int, int]) -> Trial:
    """The numbers of one ego and peer; sums go over its located ticks."""
    error, sigma = np.hypot(*position_error(record).T), position_sigma(record.covariance)
    located = record.located & np.isfinite(error)
    bound_sigma = between_stamps(grid, position_sigma(least), record.t)
    bound_square = between_stamps(grid, least[:, 0, 0] + least[:, 1, 1], record.t)
    compared = located & np.isfinite(bound_square)
    accuracy = np.maximum(limits.accuracy, limits.accuracy_per_metre * np.hypot(*record.truth[:, :2].T))
    possible = np.flatnonzero(bound_sigma < accuracy)
    found = time_to_track(record)
    wrong = located & (error > SIGMAS * sigma) & (error > NEAR)
    return {
        "ego": record.ego,
        "peer": record.peer,
        "alive": {step: alive(record, k) for step, k in checks.items()},
        "status": {step: str(record.status[k]) for step, k in checks.items()},
        "possible_s": float(record.t[possible[0]]) if len(possible) else None,
        "found_s": None if found is None else float(record.t[0]) + found,
        "located": int(located.sum()),
        "wrong": int(wrong.sum()),
        "first_wrong_s": float(record.t[np.argmax(wrong)]) if wrong.any() else None,
        "worst_m": float(error[located].max()) if located.any() else None,
        "inside": int((position_nees(record)[located] <= CHI2_95_2DOF).sum()),
        "compared": int(compared.sum()),
        "square": float((error[compared] ** 2).sum()),
        "bound_square": float(bound_square[compared].sum()),
    }


def alive(record: PairRecord, k: int) -> bool:
    """Whether a hypothesis near the truth is kept at row ``k``; a joined peer has one, its pose."""
    guesses = list(record.hypotheses.get(k, ()))
    if not guesses and np.isfinite(record.pose[k]).all():
        guesses = [PeerHypothesis(1.0, record.pose[k], record.covariance[k])]
    off = [np.hypot(*(guess.pose - record.truth[k])[:2]) for guess in guesses]
    sigmas = [float(position_sigma(guess.covariance[None])[0]) for guess in guesses]
    return any(error < max(NEAR, SIGMAS * sigma) for error, sigma in zip(off, sigmas, strict=True))


def between_stamps(grid: Array, values: Array, t: Array) -> Array:
    """Positive values on a grid at stamps t; infinite where a neighbour on the grid is not finite, and before it."""
    k = np.clip(np.searchsorted(grid, t), 1, len(grid) - 1)
    share = np.clip((t - grid[k - 1]) / (grid[k] - grid[k - 1]), 0.0, 1.0)
    low, high = np.where(share == 1.0, values[k], values[k - 1]), values[k]
    found = np.full(len(t), np.inf)
    known = np.isfinite(low) & np.isfinite(high) & (t >= grid[0])
    found[known] = np.exp((1 - share[known]) * np.log(low[known]) + share[known] * np.log(high[known]))
    return found


Statistic = Callable[[Sequence[Trial]], float]


def report(trials: Sequence[Trial], steps: Sequence[int]) -> None:
    """Print every figure with its interval and what is required of it."""
    for step, alive_required, joined_required in zip(steps, (95, 98), (70, 95), strict=False):
        show(f"a. right hypothesis alive at step {step}, pairs [%]", trials, alive_pairs(step), f"≥ {alive_required}")
        show("   the same, for every pair of a trial [%]", trials, alive_trials(step), "")
        show(f"b. all joined at step {step}, trials [%]", trials, joined(step), f"≥ {joined_required}")
    show("c. located ticks off by > 5σ and > 2 m [%]", trials, ratio("wrong", "located", 100), "≤ 1")
    show("   trials with any of them [%]", trials, lambda ts: 100 * share(ts, lambda t: total([t], "wrong") > 0), "")
    show("   located ticks of all [%]", trials, lambda ts: 100 * total(ts, "located") / sum(t["ticks"] for t in ts), "")
    show("d. RMSE of located ticks ÷ bound", trials, lambda ts: np.sqrt(ratio("square", "bound_square")(ts)), "≤ 1.15")
    show("   RMSE [m]", trials, lambda ts: np.sqrt(ratio("square", "compared")(ts)), "")
    show("   bound [m]", trials, lambda ts: np.sqrt(ratio("bound_square", "compared")(ts)), "")
    show("   inside the 95 % ellipse [%]", trials, ratio("inside", "located", 100), "90 to 98")
    show("e. located after the bound would, median [s]", trials, lambda ts: quantile(delays(ts), 0.5), "≤ 10")
    show("   the same, 90 % of the pairs [s]", trials, lambda ts: quantile(delays(ts), 0.9), "")
    for name, label in (("unjoined", "f. CPU of a tick, somebody not joined"), ("joined", "   the same, all joined")):
        times = np.array([ms for t in trials for ms in t[f"cpu_ms_{name}"]])
        if len(times):
            low, high = np.median(times), np.quantile(times, 0.99)
            print(f"{label:<52} median {low:.2f} ms, p99 {high:.2f} ms, {len(times)} ticks")
    skipped = total(trials, "located") - total(trials, "compared")
    if skipped:
        print(f"not compared with the bound, which is infinite there: {skipped} located ticks")


def show(label: str, trials: Sequence[Trial], statistic: Statistic, required: str) -> None:
    """One line: value, bootstrap interval over trials, what is required."""
    rng = np.random.default_rng(0)
    drawn = [statistic([trials[k] for k in rng.integers(0, len(trials), len(trials))]) for _ in range(200)]
    low, high = quantile(drawn, 0.025), quantile(drawn, 0.975)
    wanted = f"  required {required}" if required else ""
    print(f"{label:<52} {statistic(trials):8.2f}  [{low:.2f}, {high:.2f}]{wanted}")


def pairs_of(trials: Sequence[Trial]) -> list[Trial]:
    return [p for t in trials for p in t["pairs"]]


def total(trials: Sequence[Trial], name: str) -> float:
    return float(sum(p[name] for p in pairs_of(trials)))


def share(items: Sequence[Trial], holds: Callable[[Trial], bool]) -> float:
    return float(np.mean([holds(item) for item in items]))


def ratio(over: str, under: str, scale: float = 1.0) -> Statistic:
    def value(trials: Sequence[Trial]) -> float:
        below = total(trials, under)
        return scale * total(trials, over) / below if below else float("nan")

    return value


def alive_pairs(step: int) -> Statistic:
    return lambda trials: 100 * share(pairs_of(trials), lambda p: p["alive"][step])


def alive_trials(step: int) -> Statistic:
    return lambda trials: 100 * share(trials, lambda t: all(p["alive"][step] for p in t["pairs"]))


def joined(step: int) -> Statistic:
    return lambda trials: 100 * share(trials, lambda t: t["together"][step])


def delays(trials: Sequence[Trial]) -> list[float]:
    """From the tick at which the bound allows it to the first located one, by pair; infinite for never [s]."""
    pairs = [p for p in pairs_of(trials) if p["possible_s"] is not None]
    return [np.inf if p["found_s"] is None else p["found_s"] - p["possible_s"] for p in pairs]


def quantile(values: Sequence[float], q: float) -> float:
    return float(np.quantile(values, q, method="higher")) if len(values) else float("nan")


def line(t: Trial) -> str:
    """One trial in a line: when all were joined, wrong ticks, the pair furthest off while located."""
    worst = max(t["pairs"], key=lambda p: p["worst_m"] or 0.0)
    when = "never" if t["joined_s"] is None else f"{t['joined_s']:5.1f} s"
    dead = ", ".join(f"{step}: {sum(not p['alive'][step] for p in t['pairs'])}" for step in t["together"])
    first = min((p["first_wrong_s"] for p in t["pairs"] if p["wrong"]), default=None)
    since = "" if first is None else f" from {first:.1f} s on"
    return (
        f"seed {t['seed']}: joined {when}, {int(total([t], 'wrong'))} wrong ticks{since},"
        f" RMSE ÷ bound {np.sqrt(ratio('square', 'bound_square')([t])):.2f},"
        f" worst {worst['ego']}→{worst['peer']} {worst['worst_m'] or 0.0:.2f} m,"
        f" pairs without a right hypothesis at step {dead}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--trials", type=int, default=100)
    add("--seed", type=int, default=0, help="of the first trial")
    add("--window", default="30", help="seconds or all")
    add("--workers", type=int, default=2)
    add("--verbose", action="store_true", help="a line for each trial")
    add("--dump", type=Path, help="JSON file of every trial's numbers")
    add("--steps", type=int, default=300)
    add("--robots", type=int, default=5)
    add("--sensors", default="rssi", help="comma-separated: rssi, range, bearing")
    add("--shadowing-db", type=float, default=2.0)
    add("--shadowing-correlation", type=float, default=0.0, help="[m]")
    add("--reciprocity", type=float, default=0.0)
    add("--motion", choices=get_args(Motion), default="random-walk")
    add("--teleport", help="NAME@T:METRES")
    given = parser.parse_args()
    names = ("steps", "robots", "shadowing_db", "shadowing_correlation", "reciprocity", "motion", "teleport")
    scenario = Scenario(sensors=tuple(given.sensors.split(",")), **{name: getattr(given, name) for name in names})
    seeds = range(given.seed, given.seed + given.trials)
    trials = []
    with ProcessPoolExecutor(given.workers) as pool:
        for found in pool.map(trial, seeds, repeat(scenario), repeat(given.window)):
            trials.append(found)
            if given.verbose:
                print(line(found), flush=True)
    if given.dump:
        given.dump.write_text(json.dumps(trials), encoding="utf-8")
    print(f"{given.trials} trials from seed {given.seed}, window {given.window}: {scenario}")
    report(trials, checkpoints(scenario))


if __name__ == "__main__":
    main()
