"""A robot's sensors say nothing for a while: is anybody wrong and located then, and how soon is it found again?

    python benchmarks/outages.py --trials 8 --lengths 0 1.5 3 6 12

Robots of constant speed and wandering heading in a square, wheels at 10 Hz and ranges (0.1 m) or RSSI (2 dB) of every
pair, unknown starts. Of one or more robots all lines are missing, once, or again and again. A row is wrong when it is
located and off by more than 1 m and 4 σ. Found again: from the end of an outage until a pair is located.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dgorl import Configuration, Odometry, Range, Rssi, se2
from dgorl.configuration import merge
from dgorl.evaluation.metrics import position_error
from dgorl.evaluation.records import collect
from dgorl.logs.log import Log, Start, in_order
from dgorl.measurements import Measurement
from dgorl.radio import range_to_rssi
from dgorl.replay import replay
from dgorl.se2 import Array

STEP = 0.1
"""Time of a row of odometry [s]."""

SPEED, SPEED_SIGMA, TURN_SIGMA = 0.5, 0.02, 0.02
"""How robots drive [m/s], and how well their wheels tell it [m/s, rad/s]."""


class Outage(NamedTuple):
    """A robot's sensors say nothing from ``begin`` to ``end`` [s]."""

    robot: str
    begin: float
    end: float


@dataclass(frozen=True)
class Team:
    """robots in a square of ``area`` metres for ``seconds``; every pair measured each ``every`` seconds both ways."""

    robots: int = 4
    area: float = 16.0
    seconds: float = 50.0
    every: float = 0.5
    sensor: str = "range"
    only_odometry: bool = False
    """ranges go on while odometry is missing"""


def drive(team: Team, rng: np.random.Generator) -> tuple[Array, Array]:
    """True poses (steps + 1, n, 3) and twists (steps, n, 2)."""
    n, steps, middle = team.robots, round(team.seconds / STEP), team.area / 2
    at = np.column_stack([rng.uniform(0.2, 0.8, (n, 2)) * team.area, rng.uniform(-np.pi, np.pi, n)])
    omega, poses, twists = np.zeros(n), [at], []
    for _ in range(steps):
        omega = np.clip(0.95 * omega + 0.12 * rng.normal(size=n), -1.2, 1.2)
        home = middle - at[:, :2]
        turn = np.clip(2 * se2.wrap(np.arctan2(home[:, 1], home[:, 0]) - at[:, 2]), -1, 1)
        omega_now = np.where(np.hypot(*home.T) > 0.375 * team.area, turn, omega)
        twists.append(np.column_stack([np.full(n, SPEED), omega_now]))
        at = se2.compose(at, se2.exp(np.column_stack([np.full(n, SPEED), np.zeros(n), omega_now]) * STEP))
        poses.append(at)
    return np.array(poses), np.array(twists)


def make(team: Team, seed: int, outages: Sequence[Outage]) -> Log:
    """The log of a team with outages."""
    rng = np.random.default_rng([seed, 11])
    poses, twists = drive(team, rng)
    names = tuple(f"r{k + 1}" for k in range(team.robots))
    found: list[Measurement] = []
    radio = Configuration().radio
    for k, twist in enumerate(twists):
        a, b = round(k * STEP, 6), round((k + 1) * STEP, 6)
        told = twist + rng.normal(size=twist.shape) * (SPEED_SIGMA, TURN_SIGMA)
        for name, (v, omega) in zip(names, told.tolist(), strict=True):
            if not _silent(outages, name, a):
                found.append(Odometry(name, a, b, v, omega))
        for i, name in enumerate(names):
            if round(b / STEP) % round(team.every / STEP) != i % round(team.every / STEP):
                continue
            for j, other in enumerate(names):
                noise, d = rng.normal(), float(np.hypot(*(poses[k + 1, i] - poses[k + 1, j])[:2]))
                if i == j or (_silent(outages, name, b - STEP) and not team.only_odometry):
                    continue
                if team.sensor == "range":
                    found.append(Range(name, other, b, max(d + 0.1 * noise, 0.0), 0.1))
                else:
                    found.append(Rssi(other, name, b, float(range_to_rssi(d, radio)) + 2.0 * noise))
    stamps = STEP * np.arange(len(poses))
    truth = {name: np.column_stack([stamps, poses[:, i]]) for i, name in enumerate(names)}
    starts = {name: Start(0.0, tuple(poses[0, i].tolist())) for i, name in enumerate(names)}
    return Log(Path(f"outage{seed}"), names, in_order(found), truth, starts)


def _silent(outages: Sequence[Outage], name: str, stamp: float) -> bool:
    return any(o.robot == name and o.begin - 1e-6 <= stamp < o.end - 1e-6 for o in outages)


class Result(NamedTuple):
    """Rows of the pairs in an outage, located and wrong, after its begin; the same of the others; delays [s]."""

    rows: int
    located: int
    wrong: int
    other_rows: int
    other_located: int
    other_wrong: int
    inside: int
    found: list[float]


def trial(seed: int, team: Team, outages: Sequence[Outage], window: float, initial: str = "unknown") -> Result:
    """One team replayed."""
    log = make(team, seed, outages)
    configuration = merge(Configuration(), {"window": window, "history": 3 * window}, "outages")
    records = collect(replay(log, configuration, initial=initial), log.truth)
    names = {o.robot for o in outages}
    begin = min((o.begin for o in outages), default=0.0)
    counts, found, inside = np.zeros((2, 3), int), [], 0
    for record in records.between_robots():
        mine = bool(names & {record.ego, record.peer})
        error = position_error(record)
        off = np.hypot(*error.T)
        sigma = np.sqrt(np.linalg.eigvalsh(record.covariance[:, :2, :2])[:, -1])
        after = record.t >= begin
        located = record.located & after
        wrong = located & (off > np.maximum(1.0, 4 * sigma))
        counts[0 if mine else 1] += after.sum(), located.sum(), wrong.sum()
        known = error[located]
        square = np.einsum("ki,kij,kj->k", known, np.linalg.inv(record.covariance[located][:, :2, :2]), known)
        inside += int((square <= 5.991).sum())
        for o in outages:
            if o.robot in (record.ego, record.peer):
                later = [p.begin for p in outages if p.begin > o.begin and p.robot in (record.ego, record.peer)]
                t = record.t[(record.t > o.end) & located & (record.t < min(later, default=np.inf))]
                found.append(float(t[0] - o.end) if len(t) else np.inf)
    return Result(*counts[0].tolist(), *counts[1].tolist(), inside, found)


def pattern(name: str, length: float, team: Team) -> list[Outage]:
    """Outages of this length: of r2, of r1, of all, of one after another, or of r2 every ten seconds."""
    if not length:
        return []
    robots = [f"r{k + 1}" for k in range(team.robots)]
    at = 16.0
    match name:
        case "all":
            return [Outage(robot, at, at + length) for robot in robots]
        case "chain":
            return [Outage(robot, at + 7 * k, at + 7 * k + length) for k, robot in enumerate(robots)]
        case "flaky":
            return [Outage("r2", t, t + length) for t in np.arange(at, team.seconds - length, 10.0).tolist()]
        case "begin":
            return [Outage("r2", 1.0, 1.0 + length)]
        case _:
            return [Outage(name, at, at + length)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--lengths", type=float, nargs="+", default=[0.0, 1.5, 3.0, 6.0, 12.0])
    parser.add_argument("--who", nargs="+", default=["r2"], help="r2, all, chain, flaky, begin")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--area", type=float, default=16.0)
    parser.add_argument("--seconds", type=float, default=50.0)
    parser.add_argument("--every", type=float, default=0.5)
    parser.add_argument("--sensor", default="range", choices=("range", "rssi"))
    parser.add_argument("--only-odometry", action="store_true")
    parser.add_argument("--window", type=float, default=20.0)
    parser.add_argument("--initial", default="unknown", choices=("unknown", "known"))
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    team = Team(given.robots, given.area, given.seconds, given.every, given.sensor, given.only_odometry)
    print("who    length  located  wrong [%]   (others)        in 95 %   found again [s] median, 90 %, within the log")
    for who in given.who:
        for length in given.lengths:
            run = partial(trial, team=team, outages=pattern(who, length, team), window=given.window,
                          initial=given.initial)  # fmt: skip
            seeds = range(given.seed, given.seed + given.trials)
            if given.workers > 1:
                with ProcessPoolExecutor(given.workers) as pool:
                    results = list(pool.map(run, seeds))
            else:
                results = [run(seed) for seed in seeds]
            total = np.array([r[:7] for r in results]).sum(axis=0)
            found = np.array([t for r in results for t in r.found])
            share = 100 * total[[1, 2, 4, 5]] / np.maximum(total[[0, 1, 3, 4]], 1)
            delays = (f"{np.median(found):5.1f} {np.quantile(found, 0.9, method='lower'):5.1f}"
                      f" {100 * np.mean(np.isfinite(found)):5.0f} %" if len(found) else "")  # fmt: skip
            bad = [seed for seed, r in zip(seeds, results, strict=True) if r.wrong or r.other_wrong]
            print(f"{who:6} {length:6.1f}  {share[0]:6.1f}  {share[1]:8.2f}   {share[2]:5.1f} {share[3]:6.2f}"
                  f"  {100 * total[6] / max(total[1] + total[4], 1):8.1f}     {delays}"
                  + (f"   wrong in {bad}" if bad else ""), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
