"""T2: does λ_min(S_bc) tell random from degenerate motion? Area under the ROC curve. METHOD §3.

    python benchmarks/observability.py --trials 300
    python benchmarks/observability.py --trials 300 --noise paper

A trial drives one team at random (the simulator's walk: ω ~ U(−1, 1) rad/s each 0.5 s step) and one degenerately, in
turn: one robot standing, one spinning, all parallel at equal velocity, all on identical translated curves, all on
constant bearings, all standing. Starts are in a square of ``--area``; truth is exact and odometry reports it with
noise, as displacements, for a twist cannot be wrong sideways. ``--noise wheels`` is that of real wheels, by the
estimator's motion model at its defaults (METHOD §1; at 0.5 m/s, 3 cm a step and 1° straight on, 3° at a mean turn);
``paper`` is the simulator's, as stated covariance: (0.1 m, 0.1 m, 0.5°) a step, (1 mm, 1 mm, 1 mrad) of a robot that
stands. All pairs measure each step: RSSI of 2 dB in both directions, or a range of 0.1 m. X̂ is the optimum with known
starts (0.05 m, 1°), which T2 then does not count. Intervals are 95 % bootstraps over trials.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Literal, get_args

import numpy as np

from dgorl import _core, se2
from dgorl.configuration import Motion
from dgorl.measurements import Covariance, Displacement
from dgorl.observability_information import RESAMPLES, Excitation, excited
from dgorl.optimization import native
from dgorl.optimization.problem import DensePrior, Indices, Loss, Problem, Scalars
from dgorl.se2 import Array
from dgorl.simulation.scenario import MOVING_SIGMA, STANDING_SIGMA, START_SIGMA
from dgorl.tracks import Trail

Noise = Literal["wheels", "paper"]

PERIOD = 0.5
START = np.array(START_SIGMA)
REACH = 40.0
REQUIRED = 0.93
DEGENERATE = ("one stands", "one spins", "parallel", "translated", "bearing", "all stand")


@dataclass(frozen=True)
class Setting:
    """What a trial depends on; area and speed in m and m/s."""

    sensor: str = "rssi"
    robots: int = 2
    steps: int = 20
    area: float = 20.0
    speed: float = 0.5
    resamples: int = RESAMPLES
    noise: Noise = "wheels"


def random_walk(setting: Setting, rng: np.random.Generator) -> Array:
    """True poses (n, T + 1, 3)."""
    n, steps = setting.robots, setting.steps
    start = np.column_stack([rng.uniform(0, setting.area, (n, 2)), rng.uniform(-pi, pi, n)])
    turns = PERIOD * rng.uniform(-1, 1, (n, steps))
    motion = np.stack([np.full((n, steps), PERIOD * setting.speed), np.zeros((n, steps)), turns], axis=-1)
    return np.array([_core.chain(start[k], motion[k]) for k in range(n)])


def degenerate(setting: Setting, kind: str, rng: np.random.Generator) -> Array:
    """True poses (n, T + 1, 3) of a motion that ranges cannot resolve."""
    poses = random_walk(setting, rng)
    start = poses[:, :1].copy()
    way = PERIOD * setting.speed * np.arange(setting.steps + 1)
    match kind:
        case "one stands":
            poses[0] = start[0]
        case "one spins":
            poses[0, :, :2] = start[0, :, :2]
        case "parallel":
            heading = rng.uniform(-pi, pi)
            poses[..., :2] = start[..., :2] + way[:, None] * [np.cos(heading), np.sin(heading)]
            poses[..., 2] = heading
        case "translated":
            poses[..., :2] = start[..., :2] + poses[0, :, :2] - start[0, :, :2]
            poses[..., 2] = poses[0, :, 2]
        case "bearing":  # all fly apart from, or towards, one point, each at a speed in proportion to its distance
            centre = rng.uniform(0, setting.area, 2)
            arm = start[..., :2] - centre
            grown = 1.0 + way / np.linalg.norm(arm, axis=-1).max() * rng.choice([-0.5, 1.0])
            poses[..., :2] = centre + grown[:, None] * arm
            poses[..., 2] = np.arctan2(arm[..., 1], arm[..., 0])
        case "all stand":
            poses[:] = start
    return poses


def certainty(setting: Setting, steps: Array) -> Array:
    """Information (nT, 3, 3) that the estimator's motion model gives displacements (n, T, 3), a period each."""
    tracks = []
    for k, own in enumerate(steps.tolist()):
        trail = Trail(f"r{k + 1}", Motion())
        trail.add(
            [
                Displacement(trail.robot, PERIOD * t, PERIOD * (t + 1), x, y, turn, _stated(setting, (x, y, turn)))
                for t, (x, y, turn) in enumerate(own)
            ]
        )
        tracks.append(trail.tracks[0].core)
    return _core.odometry(tracks, [0] * len(tracks), [len(own) for own in steps])[1]


def _stated(setting: Setting, step: Sequence[float]) -> Covariance | None:
    if setting.noise == "wheels":
        return None
    x, y, theta = (s * s for s in (MOVING_SIGMA if any(step) else STANDING_SIGMA))
    return x, 0.0, 0.0, y, 0.0, theta


def window(setting: Setting, truth: Array, rng: np.random.Generator) -> tuple[Problem, Indices]:
    """A noisy window of true poses (n, T + 1, 3), with known starts, and the newest poses' indices."""
    n, count, _ = truth.shape
    index = np.arange(n * count).reshape(n, count)
    flat = truth.reshape(-1, 3)
    i, j = index[:, :-1].ravel(), index[:, 1:].ravel()
    step = se2.between(flat[i], flat[j])
    information = certainty(setting, step.reshape(n, count - 1, 3))
    sigma = np.linalg.inv(information).diagonal(axis1=1, axis2=2) ** 0.5
    delta = se2.compose(step, rng.normal(size=step.shape) * sigma)
    start = se2.compose(truth[:, 0], rng.normal(size=(n, 3)) * START)
    chains = [_core.chain(start[k], part) for k, part in enumerate(delta.reshape(n, count - 1, 3))]
    known = np.diag(START**-2.0)
    priors = tuple(DensePrior(-1, index[k, :1], start[k : k + 1], known, np.zeros(3)) for k in range(n))
    problem = Problem(
        slots=np.tile(np.arange(count), n),
        fixed=np.zeros(n * count, dtype=bool),
        initial=np.concatenate(chains),
        odometry=(i, j, delta, information),
        scalars=(_readings(setting, flat, index, rng),),
        priors=priors,
    )
    return problem, index[:, -1]


def _readings(setting: Setting, flat: Array, index: Indices, rng: np.random.Generator) -> Scalars:
    a, b = np.triu_indices(len(index), 1)
    i, j = index[a, 1:].ravel(), index[b, 1:].ravel()
    if setting.sensor == "rssi":
        i, j = np.concatenate([i, j]), np.concatenate([j, i])
    distance = np.linalg.norm(flat[i, :2] - flat[j, :2], axis=1)
    heard = distance <= REACH
    i, j, distance = i[heard], j[heard], distance[heard]
    if setting.sensor == "rssi":
        sigma = np.full(len(i), 2.0)
        value = -40.0 - 30.0 * np.log10(np.maximum(distance, 0.1)) + sigma * rng.normal(size=len(i))
    else:
        sigma = np.full(len(i), 0.1)
        value = distance + sigma * rng.normal(size=len(i))
    zero = np.zeros((len(i), 3))
    return Scalars(setting.sensor, i, j, zero, zero, np.zeros(len(i)), value, sigma, Loss())


def tested(setting: Setting, kind: str, seed: int) -> Excitation:
    """T2 of one window: a pure function of its arguments."""
    rng = np.random.default_rng([seed, setting.robots, setting.steps, *kind.encode()])
    truth = random_walk(setting, rng) if kind == "random" else degenerate(setting, kind, rng)
    problem, current = window(setting, truth, rng)
    estimate = native.solve(problem, current, 1e-6).poses
    names = [f"r{k + 1}" for k in range(setting.robots)]
    return excited(problem, estimate, current, names, seed=seed, resamples=setting.resamples)


def pairs(setting: Setting, trials: int, first: int = 0) -> tuple[list[Excitation], list[Excitation]]:
    """T2 of random and of degenerate motions."""
    seeds = range(first, first + trials)
    bent = [tested(setting, "random", seed) for seed in seeds]
    return bent, [tested(setting, DEGENERATE[seed % len(DEGENERATE)], seed) for seed in seeds]


def area_under_roc(above: Array, below: Array) -> float:
    """Share of pairs in which the first is larger, ties half."""
    return float((np.greater.outer(above, below) + 0.5 * np.equal.outer(above, below)).mean())


def with_interval(above: Array, below: Array, draws: int = 500) -> tuple[float, float, float]:
    """Area under the ROC curve and its 95 % bootstrap interval."""
    rng = np.random.default_rng(0)
    drawn = [area_under_roc(rng.choice(above, len(above)), rng.choice(below, len(below))) for _ in range(draws)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return area_under_roc(above, below), float(low), float(high)


def row(setting: Setting, trials: int, first: int) -> str:
    """A line of the Markdown table."""
    began = time.process_time()
    bent, flat = pairs(setting, trials, first)
    spent = 1e3 * (time.process_time() - began) / (2 * trials)

    def column(value: Callable[[Excitation], float]) -> str:
        area, low, high = with_interval(np.array([value(e) for e in bent]), np.array([value(e) for e in flat]))
        return f"{area:.3f} [{low:.3f}, {high:.3f}]{'' if area >= REQUIRED else ' **short**'}"

    smallest, margin = column(lambda e: e.smallest), column(lambda e: e.margin)
    yes, no = (100 * np.mean([e.excited for e in found]) for found in (bent, flat))
    return (
        f"| {setting.sensor} | {setting.robots} | {setting.steps} | {smallest} | {margin}"
        f" | {yes:.0f} % / {no:.0f} % | {spent:.1f} ms |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--area", type=float, default=20.0, help="side of the square of starts [m]")
    parser.add_argument("--speed", type=float, default=0.5, help="[m/s]; 0.5 is the paper's")
    parser.add_argument("--noise", choices=get_args(Noise), default="wheels", help="of odometry")
    parser.add_argument("--resamples", type=int, default=RESAMPLES, help="of the odometry")
    given = parser.parse_args()
    print(
        f"{given.trials} trials, {given.speed:g} m/s, {given.area:g} m square, noise of {given.noise},"
        f" {given.resamples} resamples; required {REQUIRED}"
    )
    print("| sensor | n | T | AUC of λ_min(S_bc) | AUC of the margin | excited: random / degenerate | solve and T2 |")
    print("|---|---|---|---|---|---|---|")
    for sensor in ("rssi", "range"):
        for robots in (2, 5):
            for steps in (20, 60):
                setting = Setting(sensor, robots, steps, given.area, given.speed, given.resamples, given.noise)
                print(row(setting, given.trials, given.seed), flush=True)


if __name__ == "__main__":
    main()
