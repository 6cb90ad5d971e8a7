"""One function, three solvers, one optimum. METHOD §5."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from dgorl import Configuration, se2
from dgorl.configuration import Kernel, merge
from dgorl.errors import MissingExtraError
from dgorl.evaluation.records import truth_at
from dgorl.history import History
from dgorl.optimization import linearization, native
from dgorl.optimization.problem import DensePrior, Loss, Problem, RelativePoses, Scalars
from dgorl.optimization.solver import solve
from dgorl.replay import replay
from dgorl.simulation import Scenario, simulate
from dgorl.window import assemble, grow, merged
from tests.unit.reference import random_information, retract

KERNELS = get_args(Kernel)
OTHERS = ["g2o", "gtsam"]
NOBODY = np.zeros(0, np.int64)
SENSORS = (("rssi",), ("range",), ("rssi", "bearing"), ("range", "bearing"))


def every_factor(seed: int, kernel: Kernel, steps: int = 4, robots: int = 3) -> Problem:
    """A small window with all kinds of factors, offsets and heights; the world and one robot's pose are fixed."""
    rng = np.random.default_rng(seed)
    truth = [np.zeros(3)]
    for r in range(robots):
        x = np.array([5.0 * r, 4.0 * (-1) ** r, rng.uniform(-3, 3)])
        for _ in range(steps):
            truth.append(x)
            x = se2.compose(x, [0.6, 0.0, rng.uniform(-0.5, 0.5)])
    x = np.array(truth)
    slots = np.array([-1, *np.tile(np.arange(steps), robots)])
    fixed = np.zeros(len(x), dtype=bool)
    fixed[[0, 1]] = True
    i = np.array([1 + r * steps + t for r in range(robots) for t in range(steps - 1)])
    noise = rng.normal(size=(len(i), 3)) * [0.05, 0.03, 0.04]
    odometry = (i, i + 1, se2.compose(se2.between(x[i], x[i + 1]), noise), 100 * random_information(rng, len(i)))

    def pairs(count: int):
        a = rng.permuted(np.tile(np.arange(robots), (count, 1)), axis=1)[:, :2] * steps
        a += 1 + rng.integers(steps, size=(count, 1))
        return a[:, 0], a[:, 1], *(0.3 * rng.normal(size=(2, count, 3)))

    i, j, at_i, at_j = pairs(8)
    i[:3] = 0  # the world
    delta = se2.between(se2.compose(x[i], at_i), se2.compose(x[j], at_j)) + 0.1 * rng.normal(size=(8, 3))
    information = random_information(rng, 8)
    information[-2:] = np.diag([4.0, 0.0, 0.0])
    scalars = []
    for kind, sigma in (("rssi", 2.0), ("range", 0.2), ("bearing", 0.1)):
        i, j, at_i, at_j = pairs(20)
        reading = Scalars(kind, i, j, at_i, at_j, rng.normal(size=20), np.zeros(20), np.ones(20), Loss())
        exact = native.graph(replace(problem_of(x, slots, fixed, odometry), scalars=(reading,))).residuals(x)[-1][1][:, 0]
        value = (-exact if kind == "rssi" else exact) + sigma * rng.standard_t(2, 20)
        scalars.append(replace(reading, value=value, sigma=np.full(20, sigma), loss=Loss(kernel, rng.uniform(0.7, 1.5))))
    members = np.array([0, 1 + steps, 1 + 2 * steps])
    relative = se2.between(x[1], x[members]) + 0.1 * rng.normal(size=(3, 3))
    prior = DensePrior(1, members, relative, random_information(rng, 1, 9)[0], rng.normal(size=9))
    start = np.where(fixed[:, None], x, retract(x, 0.1 * rng.normal(size=x.shape)))
    return replace(
        problem_of(start, slots, fixed, odometry),
        scalars=tuple(scalars),
        relative_poses=RelativePoses(*_ends(x, rng, steps, robots), delta, information)
        if False
        else RelativePoses(np.array([0, 0, 0, *i[3:8]]), j[:8], at_i[:8], at_j[:8], delta, information),
        priors=(prior,),
    )
