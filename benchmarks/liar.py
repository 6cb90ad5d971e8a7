"""A robot lies: its signature is valid, its ranges are too long. Is it named, and are the others none the worse?

    python benchmarks/liar.py --trials 6

Every trial replays a simulated team of 5 with UWB-like ranges of 0.1 m in which r3's ranges are 5 m too long: from the
start or from 60 s on, starts known or not, every range of r3's pairs measured by itself or by both ends in turn. Asked:
r3 is called inconsistent by name, nobody else is, and the others' relative positions are at most 1.5 times as far
off as on the same log without r3, from 30 s after the lie begins.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Literal

import numpy as np

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.evaluation.metrics import position_error
from dgorl.evaluation.records import PairRecord, Records, collect
from dgorl.logs.log import Log
from dgorl.measurements import Displacement, Measurement, Odometry, Range
from dgorl.replay import replay
from dgorl.simulation import Scenario, simulate

LIAR, METRES = "r3", 5.0
SETTLED = 30.0
"""Errors count from this long [s] after the lie began."""

Ends = Literal["liar", "both"]


@dataclass(frozen=True)
class Result:
    """named: from the lie to the liar's name [s], inf if never; blamed: robots that were called inconsistent wrongly.

    rmse, alone: of pairs among the others with the liar and on the same log without it [m]; located, located_alone:
    share of those pairs' ticks that are located.
    """

    named: float
    blamed: tuple[str, ...]
    rmse: float
    alone: float
    located: float
    located_alone: float

    @property
    def ratio(self) -> float:
        return self.rmse / self.alone


def lying(log: Log, since: float, ends: Ends, liar: str = LIAR, metres: float = METRES) -> Log:
    """The log in which a robot's ranges are off after ``since`` [s]; ends: who measures its pairs."""

    def told(m: Measurement) -> Measurement:
        if not isinstance(m, Range) or liar not in (m.robot, m.peer):
            return m
        if ends == "liar" and m.peer == liar:
            m = replace(m, robot=liar, peer=m.robot)
        return replace(m, range=max(m.range + metres, 0.0)) if m.robot == liar and m.stamp > since else m

    return replace(log, measurements=tuple(told(m) for m in log.measurements))


def without(log: Log, gone: str = LIAR) -> Log:
    """The log of the others, as if there had never been that robot."""
    kept = [m for m in log.measurements if gone not in _robots(m)]
    names = tuple(name for name in log.robots if name != gone)
    return replace(log, robots=names, measurements=tuple(kept), starts={n: log.starts[n] for n in names})


def _robots(m: Measurement) -> tuple[str, ...]:
    if isinstance(m, Odometry | Displacement):
        return (m.robot,)
    assert isinstance(m, Range)
    return m.robot, m.peer


def trial(seed: int, scenario: Scenario, since: float, ends: Ends, initial: str) -> Result:
    """One team with a liar, and without: a pure function of its arguments."""
    log = simulate(replace(scenario, seed=seed))
    records, alone = _records(lying(log, since, ends), initial), _records(without(log), initial)
    named, blamed = np.inf, set()
    for record in records.between_robots():
        for t, reason in zip(record.t, record.reason, strict=True):
            if reason.startswith("inconsistent: "):
                robot = reason.split()[1]
                blamed.add(robot)
                named = min(named, t - since) if robot == LIAR and t > since else named
    begin = since + SETTLED
    located = _located(records, begin), _located(alone, begin)
    return Result(named, tuple(sorted(blamed - {LIAR})), *_rmse(records, alone, begin), *located)


def _records(log: Log, initial: str) -> Records:
    return collect(replay(log, merge(Configuration(), log.configuration, "log"), initial=initial), log.truth)


def _others(records: Records) -> Sequence[PairRecord]:
    return [r for r in records.between_robots() if LIAR not in (r.ego, r.peer)]


def _rmse(records: Records, alone: Records, begin: float) -> tuple[float, float]:
    """RMSE [m] with and without the liar, over the pairs' ticks that are located in both."""
    squares: tuple[list[float], list[float]] = [], []
    for record in _others(records):
        other = alone.pairs[record.ego, record.peer]
        rows = np.isin(record.t, other.t) & (record.t > begin) & record.located
        at = np.searchsorted(other.t, record.t[rows])
        use = other.located[at]
        squares[0].extend(np.sum(position_error(record)[rows][use] ** 2, axis=1))
        squares[1].extend(np.sum(position_error(other)[at][use] ** 2, axis=1))
    a, b = (float(np.sqrt(np.mean(s))) if s else np.nan for s in squares)
    return a, b


def _located(records: Records, begin: float) -> float:
    return float(np.mean([r.located[r.t > begin].mean() for r in _others(records)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--area", type=float, default=25.0)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    scenario = Scenario(robots=given.robots, area=given.area, steps=given.steps, sensors=("range",))
    seeds = range(given.seed, given.seed + given.trials)
    print(
        "starts   since  measured by  named (median, slowest)  others blamed  RMSE ÷ without (median, worst)  located"
    )
    with ProcessPoolExecutor(given.workers) as pool:
        for initial, since, ends in product(("known", "unknown"), (0.0, 60.0), ("liar", "both")):
            one = partial(trial, scenario=scenario, since=since, ends=ends, initial=initial)
            found = list(pool.map(one, seeds))
            named, ratio = np.array([r.named for r in found]), np.array([r.ratio for r in found])
            blamed = sum(bool(r.blamed) for r in found)
            print(
                f"{initial:8} {since:3.0f} s  {ends:11}  {np.isfinite(named).sum()} of {len(found)}:"
                f" {np.median(named):5.1f} s {named.max():5.1f} s  {blamed} trials       "
                f" {np.median([r.rmse for r in found]):.3f} m, {np.median(ratio):.2f} {np.max(ratio):.2f}"
                f"    {np.median([r.located for r in found]):.3f}"
                f" (without {np.median([r.located_alone for r in found]):.3f})", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()
