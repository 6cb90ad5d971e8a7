"""CPU time of one robot's tick, Python included, and of its solver beside GTSAM on the same window.

    pip install gtsam
    python benchmarks/tick.py --repeats 5

Five robots, 30 s window (60 to 72 keyframes), a tick every 0.5 s of a long simulated log. A tick is everything since
the last one: taking the measurements and `Localizer.update`, node ticks included. The rewind is one reading 175 s
late, which recomputes every node since. Medians over repeats; process CPU time. The last figure is of unknown starts:
ticks of r1 from the first hypothesis until all its peers are joined, nodes and their searches included.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from dgorl import Configuration, Localizer, Range
from dgorl.configuration import merge
from dgorl.estimate import Estimate, Status
from dgorl.measurements import Measurement, known_at
from dgorl.optimization import native
from dgorl.optimization.problem import Problem
from dgorl.replay import known_starts
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate

UNJOINED = (Status.ISOLATED, Status.AMBIGUOUS)

STEADY = 40.0
"""Ticks before this time [s] do not count: the window is not full yet."""


def feed(steps: int, sensor: str) -> tuple[list[Measurement], Configuration]:
    log = simulate(Scenario(steps=steps, sensors=(sensor,)))
    configuration = merge(Configuration(), log.configuration, "the simulated log")
    configuration = merge(configuration, {"ranging": {"kernel": "none"}}, "the benchmark")  # as in GTSAM's graph
    return sorted([*known_starts(log), *log.measurements], key=known_at), configuration


def timed(
    localizer: Localizer, measurements: Iterable[Measurement], steps: int
) -> Iterator[tuple[float, Estimate, float]]:
    """Stamp [s], estimate and CPU time [s] of every tick, the measurements since the last one included."""
    waiting = iter([*measurements, None])
    measurement = next(waiting)
    gc.collect()
    for k in range(1, steps + 1):
        now = k * 0.5
        began = time.process_time()
        while measurement is not None and known_at(measurement) <= now:
            localizer.add(measurement)
            measurement = next(waiting)
        estimate = localizer.update(now)
        yield now, estimate, time.process_time() - began


def ticks(steps: int) -> tuple[Array, float]:
    """CPU time of every steady tick [s], and of the worst rewind."""
    measurements, configuration = feed(steps, "rssi")
    localizer = Localizer("r1", configuration)
    spent = [took for now, _, took in timed(localizer, measurements, steps) if now > STEADY]
    now = (np.floor(steps * 0.5 / 5) + 1) * 5 + 1.0
    began = time.process_time()
    localizer.add(Range("r1", "r2", now - 175.0, 10.0, 5.0))
    localizer.update(now)
    return np.array(spent), time.process_time() - began


def unjoined_ticks(seed: int, steps: int = 300) -> list[float]:
    """CPU time of r1's ticks while a peer is not joined [s], unknown starts, k = 3."""
    log = simulate(Scenario(steps=steps, seed=seed))
    configuration = merge(merge(Configuration(), log.configuration, "the simulated log"), {"candidates": 3}, "here")
    spent = []
    for _, estimate, took in timed(Localizer("r1", configuration), sorted(log.measurements, key=known_at), steps):
        statuses = [peer.status for peer in estimate.values()]
        if len(statuses) == 4 and not any(status in UNJOINED for status in statuses):
            break
        if Status.AMBIGUOUS in statuses:
            spent.append(took)
    return spent


def median_cpu(call: Callable[[], object], repeats: int = 100) -> float:
    spent = []
    for _ in range(repeats):
        began = time.process_time()
        call()
        spent.append(time.process_time() - began)
    return float(np.median(spent))


def window_problem() -> tuple[Problem, Array]:
    """One tick's problem with ranges, and the indices of the newest poses."""
    measurements, configuration = feed(139, "range")
    localizer = Localizer("r1", configuration)
    for measurement in measurements:
        localizer.add(measurement)
    localizer.update(64.0)
    window = localizer.team.update(69.5).joined[0].window
    newest = np.array([offset + count - 1 for offset, _, count in window.layout.values()])
    return window.problem, newest


def gtsam_solve(problem: Problem, newest: Array) -> Callable[[], float]:
    """The same factors in GTSAM: its Levenberg–Marquardt and the marginals of the newest poses."""
    import gtsam

    def pose(row: Array) -> gtsam.Pose2:
        return gtsam.Pose2(float(row[0]), float(row[1]), float(row[2]))

    def information(matrix: Array) -> gtsam.noiseModel.Base:
        return gtsam.noiseModel.Gaussian.Information(matrix)

    def run() -> float:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for index in np.flatnonzero(~problem.fixed):
            values.insert(int(index), pose(problem.initial[index]))
        for i, j, delta, weight in zip(*problem.odometry, strict=True):
            graph.add(gtsam.BetweenFactorPose2(int(i), int(j), pose(delta), information(weight)))
        ranges = problem.scalars[0]
        for i, j, value, sigma in zip(ranges.i, ranges.j, ranges.value, ranges.sigma, strict=True):
            noise = gtsam.noiseModel.Isotropic.Sigma(1, float(sigma))
            graph.add(gtsam.RangeFactorPose2(int(i), int(j), float(value), noise))
        # GTSAM has no dense prior on relative poses: each pose's own block keeps the problem determined.
        for prior in problem.priors:
            for k, index in enumerate([*prior.members]):
                if problem.fixed[index]:
                    continue
                block = prior.information[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
                graph.add(gtsam.PriorFactorPose2(int(index), pose(problem.initial[index]), information(block)))
            reference = prior.reference
            anchor = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
            graph.add(gtsam.PriorFactorPose2(int(reference), pose(problem.initial[reference]), anchor))
        found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        marginals = gtsam.Marginals(graph, found)
        for index in newest:
            marginals.marginalCovariance(int(index))
        return graph.error(found)

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    runs = [ticks(arguments.steps) for _ in range(arguments.repeats)]
    medians, tails = zip(*((np.median(t), np.quantile(t, 0.99)) for t, _ in runs), strict=True)
    print(f"tick: median {1e3 * np.median(medians):.2f} ms, p99 {1e3 * np.median(tails):.2f} ms CPU", end="")
    print(f" ({arguments.repeats} runs of {len(runs[0][0])} ticks)")
    print(f"rewind of 175 s: {1e3 * np.median([rewind for _, rewind in runs]):.0f} ms CPU")
    spent = np.concatenate([unjoined_ticks(seed) for seed in range(4 * arguments.repeats)])
    print(f"tick while a peer is not joined, k = 3: median {1e3 * np.median(spent):.1f} ms,", end="")
    print(f" p99 {1e3 * np.quantile(spent, 0.99):.0f} ms CPU ({4 * arguments.repeats} teams, {len(spent)} ticks)")
    problem, newest = window_problem()
    size = f"{len(problem.initial)} poses, {len(problem.scalars[0].value)} ranges"
    ours = median_cpu(lambda: native.solve(problem, newest, 1e-5))
    print(f"build + optimise + marginals of the newest poses ({size}): {1e3 * ours:.2f} ms CPU")
    try:
        theirs = median_cpu(gtsam_solve(problem, newest), 20)
    except ImportError:
        print("GTSAM is not installed: no comparison (pip install gtsam)")
        return
    print(f"GTSAM from Python, same window: {1e3 * theirs:.2f} ms CPU, {theirs / ours:.0f} × ours")


if __name__ == "__main__":
    main()
