"""Whom does nobody's fault accuse? Honest teams of many kinds, and how often a node calls somebody inconsistent.

    python benchmarks/false_alarms.py --logs 200 --seconds 180

Every log is drawn by chance (``clean_teams.py``), unknown starts. The two tests of a node together promise one in 10⁴.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path

import numpy as np
from clean_teams import drawn

from dgorl import Configuration, Team
from dgorl.configuration import merge
from dgorl.logs import read
from dgorl.logs.log import Log
from dgorl.measurements import known_at
from dgorl.nodes import DELAY


def accused(log: Log) -> Iterator[tuple[float, list[str]]]:
    """Of every node of a log its time [s] and whom it calls inconsistent."""
    team = Team(merge(Configuration(), log.configuration, "the log"))
    waiting = sorted(log.measurements, key=known_at)
    first, last = known_at(waiting[0]), known_at(waiting[-1])
    taken = 0
    for g in np.arange(np.ceil(first / 5.0) * 5.0, last, 5.0):
        while taken < len(waiting) and known_at(waiting[taken]) <= g + DELAY:
            team.add(waiting[taken])
            taken += 1
        state = team.update(float(g + DELAY))
        unfit = frozenset[object]().union(*(cluster.unfit for cluster in state.clusters))
        yield float(g), sorted({key.robot for key in state.suspects | unfit})


def trial(seed: int, seconds: float) -> list[tuple[float, list[str]]]:
    """The nodes of one log: a pure function of its arguments."""
    return list(accused(drawn(seed, seconds).log()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first log")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--log", type=Path, help="this log instead of drawn ones")
    given = parser.parse_args()
    if given.log:
        found = {given.log: list(accused(read(given.log)))}
    else:
        seeds = range(given.seed, given.seed + given.logs)
        with ProcessPoolExecutor(given.workers) as pool:
            found = dict(zip(seeds, pool.map(trial, seeds, repeat(given.seconds)), strict=True))
    for name, nodes in found.items():
        for g, robots in nodes:
            if robots:
                print(f"{name if given.log else drawn(name, given.seconds)}: {', '.join(robots)} at {g:g} s")
    nodes = [bool(robots) for rows in found.values() for _, robots in rows]
    print(f"{len(found)} logs, {len(nodes)} nodes: {sum(nodes)} call somebody inconsistent, {np.mean(nodes):.1e}")


if __name__ == "__main__":
    main()
