"""Range-only teams of a world of its own: is the published ellipse as wide as it says, is anybody wrong while located?

    python benchmarks/independent_ranges.py --robots 2 4 --sides 10 30 100 --seeds 8 --workers 2
    python benchmarks/independent_ranges.py --robots 4 --sides 20 --nlos 0.3 --nlos-metres 5

Nothing here comes from dgorl.simulation: robots drive arcs in a square, their wheels err exactly as the default
``motion`` settings say, ranges of every pair err by a Gaussian, starts are unknown. Every team is written as a dgorl
folder and replayed causally. Figures are of located ticks (``position``, ``tracked``) of all pairs:

    inside    share inside the published 95 % ellipse of (x, y)
    wrong     off by more than 5σ (Mahalanobis) and more than 2 m
    polar     both once more, judged in (log range, bearing) by the covariance in the tangent space
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from dgorl import Configuration, logs
from dgorl.configuration import load, merge
from dgorl.evaluation.metrics import CHI2_95_2DOF, position_error, position_nees
from dgorl.evaluation.records import PairRecord, collect
from dgorl.replay import replay
from dgorl.se2 import Array, wrap

STEP = 0.1
"""Seconds from one row of odometry to the next."""
PERIOD = 0.5
"""Seconds from one range of a pair to the next."""
SPEED, TURN, HOLD = (0.3, 0.8), 0.6, (2.0, 8.0)
"""Speeds [m/s], largest turn rate [rad/s] and how long a command is held [s]."""
SECOND, RADIAN, METRE, FORWARD, SIDEWAYS, REST = 0.007, 0.10, 0.04, 0.06, 0.02, 0.003
"""Wheel noise: heading per √s, √rad, √m; position along and across per √m, and per √s."""
SIGMAS, FAR = 5.0, 2.0


@dataclass(frozen=True)
class World:
    """One team in a square of ``side`` [m]; nlos: share of the ranges that are too long, on average by ``excess`` [m].

    fixed: all by exactly that much. both: half of them too short instead.
    """

    robots: int
    side: float
    seed: int
    seconds: float
    sigma: float
    nlos: float
    excess: float
    fixed: bool
    both: bool


def commands(rng: np.random.Generator, world: World, start: Array) -> tuple[Array, Array]:
    """Twists (N, 2) that a robot's wheels report every STEP, and its true poses (N + 1, 3): these have the noise."""
    count = round(world.seconds / STEP)
    twists, poses = np.zeros((count, 2)), np.zeros((count + 1, 3))
    poses[0], until, margin = start, 0, 0.1 * world.side
    v = w = 0.0
    for k in range(count):
        x, y, heading = poses[k]
        inward = wrap(np.arctan2(-y, -x) - heading)
        if max(abs(x), abs(y)) > world.side / 2 - margin and abs(inward) > 1.0:
            v, w, until = SPEED[0], np.copysign(TURN, inward), k + 1  # turn back from the wall
        elif k >= until:
            v, w = rng.uniform(*SPEED), rng.uniform(-TURN, TURN)
            until = k + round(rng.uniform(*HOLD) / STEP)
        twists[k] = v, w
        way, turn = v * STEP, w * STEP
        noise = rng.normal(size=3)
        forward = way + noise[0] * np.sqrt(FORWARD**2 * way + REST**2 * STEP)
        aside = noise[1] * np.sqrt(SIDEWAYS**2 * way + REST**2 * STEP)
        turned = turn + noise[2] * np.sqrt(SECOND**2 * STEP + RADIAN**2 * abs(turn) + METRE**2 * way)
        middle = heading + turned / 2
        c, s = np.cos(middle), np.sin(middle)
        poses[k + 1] = x + c * forward - s * aside, y + s * forward + c * aside, heading + turned
    return twists, poses


def ranges(rng: np.random.Generator, world: World, a: Array, b: Array) -> Iterator[tuple[float, float]]:
    """Stamps [s] and ranges [m] between robots with poses (N + 1, 3)."""
    grid = np.arange(len(a)) * STEP
    for t in np.arange(rng.uniform(0.0, PERIOD), grid[-1], PERIOD):
        p, q = (np.array([np.interp(t, grid, poses[:, k]) for k in (0, 1)]) for poses in (a, b))
        reading = np.hypot(*(p - q)) + rng.normal(0.0, world.sigma)
        if rng.uniform() < world.nlos:
            excess = world.excess if world.fixed else rng.exponential(world.excess)
            reading += -excess if world.both and rng.uniform() < 0.5 else excess
        yield float(t), float(max(reading, 0.0))


def write(world: World, folder: Path) -> None:
    """A dgorl folder of the team."""
    rng = np.random.default_rng([world.seed, world.robots, round(world.side)])
    names = [f"r{k + 1}" for k in range(world.robots)]
    odometry, truth, heard, paths = [], [], [], []
    for name in names:
        start = np.array([*rng.uniform(-0.4, 0.4, 2) * world.side, rng.uniform(-np.pi, np.pi)])
        twists, poses = commands(rng, world, start)
        paths.append(poses)
        stamps = np.round(np.arange(len(poses)) * STEP, 6).tolist()
        for begin, end, (v, w) in zip(stamps[:-1], stamps[1:], twists.tolist(), strict=True):
            odometry.append((begin, f"{begin},{end},{name},{v},{w}"))
        truth += [(t, f"{t},{name},{x},{y},{h}") for t, (x, y, h) in zip(stamps, poses.tolist(), strict=True)]
    for i, j in ((i, j) for i, j in product(range(world.robots), repeat=2) if i < j):
        for k, (t, reading) in enumerate(ranges(rng, world, paths[i], paths[j])):
            one, other = (i, j) if k % 2 == 0 else (j, i)
            heard.append((t, f"{t},{names[one]},{names[other]},{reading},{world.sigma}"))
    (folder / "team.yaml").write_text(f"robots: [{', '.join(names)}]\n", encoding="utf-8")
    tables = {
        "odometry": ("start,end,robot,v,omega", odometry),
        "ranges": ("t,from,to,range,sigma", heard),
        "groundtruth": ("t,robot,x,y,theta", truth),
    }
    for table, (header, rows) in tables.items():
        text = "\n".join([header, *(row for _, row in sorted(rows))])
        (folder / f"{table}.csv").write_text(text + "\n", encoding="utf-8")


def polar_nees(record: PairRecord) -> Array:
    """eᵀ P⁻¹ e of (log range, bearing), P to first order from the tangent covariance: (T,)."""
    pose, truth = record.pose[:, :2], record.truth[:, :2]
    d, true = np.hypot(*pose.T), np.hypot(*truth.T)
    bearing, heading = np.arctan2(pose[:, 1], pose[:, 0]), record.pose[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.column_stack([np.log(d / true), wrap(bearing - np.arctan2(truth[:, 1], truth[:, 0]))])
    turn = heading - bearing  # from the peer's tangent to axes along and across the line of sight
    c, s = np.cos(turn), np.sin(turn)
    into = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2) / d[:, None, None]
    assert record.tangent is not None
    covariance = into @ record.tangent[:, :2, :2] @ into.swapaxes(1, 2)
    known = np.isfinite(error).all(1) & np.isfinite(covariance).all((1, 2))
    out = np.full(len(d), np.nan)
    e = error[known]
    out[known] = np.einsum("ni,ni->n", e, np.linalg.solve(covariance[known], e[..., None])[..., 0])
    return out


def run(world: World, changes: dict[str, Any]) -> dict[str, Any]:
    """Sums over the located ticks of one team."""
    with tempfile.TemporaryDirectory() as name:
        write(world, Path(name))
        log = logs.read(Path(name))
    configuration = merge(merge(Configuration(), log.configuration, "the log"), changes, "--config")
    records = collect(replay(log, configuration, initial="unknown"), log.truth)
    pairs = records.between_robots()
    located = np.concatenate([r.located for r in pairs])
    error = np.concatenate([np.hypot(*position_error(r).T) for r in pairs])[located]
    nees = np.concatenate([position_nees(r) for r in pairs])[located]
    polar = np.concatenate([polar_nees(r) for r in pairs])[located]
    wrong = (nees > SIGMAS**2) & (error > FAR)
    return {
        **asdict(world),
        "ticks": len(located),
        "located": len(error),
        "inside": int((nees <= CHI2_95_2DOF).sum()),
        "wrong": int(wrong.sum()),
        "polar_inside": int((polar <= CHI2_95_2DOF).sum()),
        "polar_wrong": int(((polar > SIGMAS**2) & (error > FAR)).sum()),
        "square": float((error**2).sum()),
        "cpu_ms": 1e3 * float(np.mean([s.mean() for s in records.tick_s.values()])),
    }


def line(found: Sequence[dict[str, Any]]) -> str:
    """One row: figures of all teams of one kind, with the least and the most inside in one of them."""
    total = {name: sum(f[name] for f in found) for name in found[0]}
    located = max(total["located"], 1)

    def percent(name: str) -> float:
        return 100 * total[name] / located

    inside = [100 * f["inside"] / f["located"] for f in found if f["located"]] or [np.nan]
    return (
        f"{found[0]['robots']:>6}  {found[0]['side']:>4g}  {100 * total['located'] / total['ticks']:>7.1f}"
        f"  {np.sqrt(total['square'] / located):>5.2f}"
        f"  {percent('inside'):>6.1f}  {min(inside):>5.1f} {max(inside):>5.1f}"
        f"  {percent('wrong'):>5.2f}  {percent('polar_inside'):>6.1f}  {percent('polar_wrong'):>5.2f}"
        f"  {np.mean([f['cpu_ms'] for f in found]):>5.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--robots", type=int, nargs="+", default=[2, 4])
    add("--sides", type=float, nargs="+", default=[10.0, 30.0, 100.0], help="of the square [m]")
    add("--seeds", type=int, default=8, help="teams a row")
    add("--seed", type=int, default=0, help="of the first team")
    add("--seconds", type=float, default=120.0)
    add("--sigma", type=float, default=0.1, help="of a range [m]")
    add("--nlos", type=float, default=0.0, help="share of the ranges without line of sight")
    add("--nlos-metres", type=float, default=5.0, help="so much too long these are on average, exponentially [m]")
    add("--fixed", action="store_true", help="... or all by just that much")
    add("--both-sides", action="store_true", help="half of them too short instead")
    add("--kernel", help="of the ranges, in place of the default")
    add("--config", type=Path, help="YAML file of settings")
    add("--workers", type=int, default=1)
    add("--dump", type=Path, help="JSON file of every team's numbers")
    given = parser.parse_args()
    changes = dict(load(given.config)) if given.config else {}
    if given.kernel:
        changes["ranging"] = {**changes.get("ranging", {}), "kernel": given.kernel}
    rest = (given.seconds, given.sigma, given.nlos, given.nlos_metres, given.fixed, given.both_sides)
    found = []
    print("robots  side  located   RMSE  inside  least  most  wrong   polar  wrong   tick")
    print("         [m]      [%]    [m]     [%]    [%]   [%]    [%]     [%]    [%]   [ms]")
    with ProcessPoolExecutor(given.workers) as pool:
        for robots, side in product(given.robots, given.sides):
            worlds = [World(robots, side, seed, *rest) for seed in range(given.seed, given.seed + given.seeds)]
            row = list(pool.map(run, worlds, [changes] * len(worlds)))
            print(line(row), flush=True)
            found += row
    if given.dump:
        given.dump.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
