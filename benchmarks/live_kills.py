"""The row of ``live.py`` that kills agents."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

import numpy as np
from live_fleet import Place, Row, ran, simulated

KILLS = 100
SLOT = 6.0
"""A kill every so many seconds; who is killed is back before the next one."""


def kill(place: Place) -> Iterator[Row]:
    """Every agent in turn, at random moments, and again. Who is back needs CPU: at the robots' own rate."""
    folder = place.folder("kill")
    rounds, runs = (1, 1) if place.short else (4, KILLS // 20)
    log = simulated(folder / "log", 15.0 + SLOT * 5 * rounds + 20.0)
    fleets, backs = [], []
    for seed in range(runs):
        rng, events, times = Random(seed), [], []
        for number in range(5 * rounds):
            robot, at = f"r{number % 5 + 1}", 15.0 + SLOT * number + rng.uniform(0.0, 2.0)
            times.append((robot, at + rng.uniform(0.5, 2.0)))
            events += ["--kill", f"{robot}@{at:.3f}", "--join", f"{robot}@{times[-1][1]:.3f}"]
        fleets.append(ran(folder / f"{seed}", log, "--rate", 1, *events))
        backs.append(times)
    names, lost, reused = (sum(numbers) for numbers in zip(*(left.numbering() for left in fleets), strict=True))
    epochs = sum(len({(n.robot, n.epoch) for j in left.journals.values() for n in j}) - 5 for left in fleets)
    gaps, equal = sum(left.gaps() for left in fleets), sum(left.equal() for left in fleets)
    every = [(left, robot, back) for left, times in zip(fleets, backs, strict=True) for robot, back in times]
    held = [left.held_after(back) for left, _, back in every]
    admitted = [left.admitted_after(back) for left, _, back in every]
    first = [next(r.tick_s for r in left.reports[robot] if r.stamp >= back) for left, robot, back in every]
    yield Row(
        "100 times kill -9: no bundle that was sent is lost, no number used twice, equal again within 10 s",
        f"{len(every)} kills in {runs} fleets: of {names} bundles {lost} lost, {reused} names used twice, {gaps} "
        f"numbers missing, {epochs} new epochs; all held by all {_spread(held)} s after the restart, in all estimates "
        f"after {_spread(admitted)} s; the first estimate after it took {_spread(first)} s CPU (median, 95 %, most); "
        f"at the end {equal} of {runs} equal; {np.mean([left.skipped for left in fleets]):.0%} of the ticks skipped",
        "`python benchmarks/live.py --only kill` (`--rate 1 --kill r1@15.4 --join r1@16.9 ...`)",
        not (lost or reused or gaps or epochs) and equal == runs and max(held) <= 10.0,
    )


def _spread(values: list[float]) -> str:
    return " / ".join(f"{np.quantile(values, q):.1f}" for q in (0.5, 0.95, 1.0))
