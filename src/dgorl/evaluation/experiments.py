"""The paper's experiment: which trials it has, and how they are run, kept and gone on with. METHOD §9."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dgorl.baselines import NAMES
from dgorl.errors import DgorlError
from dgorl.evaluation.results import Parts, program, write
from dgorl.evaluation.trials import Initial, Outcome, Trial, run
from dgorl.evaluation.workers import on_cluster, on_processes
from dgorl.simulation import Scenario

LONGER = 2
"""Trials with unknown starts are so many times as long: finding everybody takes about as long as the paper's trial"""
UNKNOWN = ("dgorl", "split-ci", "gtsam-fixed-lag")
"""estimators of the trials with unknown starts; the baselines begin where DGORL first tracks everybody"""
MODULES = {"gtsam-fixed-lag": "gtsam"}
"""packages that estimators need"""

SWEEPS: dict[str, tuple[float, ...]] = {
    "shadowing_db": (0.5, 1.0, 2.0, 4.0, 6.0),
    "path_loss_exponent": (2.0, 3.0, 4.0, 5.0, 6.0),
    "robots": (2, 3, 5, 10, 20),
    "area": (20.0, 40.0, 60.0, 100.0),
    "odometry_noise": (0.5, 1.0, 2.0, 4.0),
    "reciprocity": (0.0, 0.5, 1.0),
}
"""what is varied, one at a time, around the paper's setting"""
SWEEP_TRIALS = 4
"""trials of each setting of a sweep, unless fewer are wanted"""
SWEEP_BOUND_EVERY = 5


@dataclass(frozen=True)
class Paper:
    """The paper's setting, how often it is repeated, and whether settings are varied around it."""

    trials: int = 10
    seed: int = 0
    steps: int = 100
    sweep: bool = False

    def scenario(self, trial: int) -> Scenario:
        """That of one trial, with terrain for those who navigate by it."""
        return Scenario(seed=self.seed + trial, steps=self.steps, terrain=True)

    def plan(self) -> list[Trial]:
        """The trials of the paper's setting, known starts first."""
        known, unknown = (tuple(n for n in names if available(n)) for names in (NAMES, UNKNOWN))
        scenarios = [self.scenario(k) for k in range(self.trials)]
        return [
            *(Trial(scenario, "known", known) for scenario in scenarios),
            *(Trial(replace(s, steps=LONGER * s.steps), "unknown", unknown) for s in scenarios),
        ]

    def sweeps(self) -> list[Trial]:
        """The trials around it, if they are wanted."""
        starts: tuple[Initial, ...] = ("known", "unknown")
        return [
            Trial(scenario, initial, name=f"{field}={value:g}", bound_every=SWEEP_BOUND_EVERY)
            for field, values in (SWEEPS.items() if self.sweep else ())
            for value in values
            for initial in starts
            for scenario in self._varied(field, value)
        ]

    def _varied(self, field: str, value: float) -> Iterator[Scenario]:
        change: dict[str, Any] = {field: value}
        for k in range(min(self.trials, SWEEP_TRIALS)):
            yield replace(self.scenario(k), terrain=False, **change)


def available(estimator: str) -> bool:
    """Whether the package an estimator needs is installed."""
    return estimator not in MODULES or find_spec(MODULES[estimator]) is not None


def compute(trials: Sequence[Trial], parts: Parts, workers: int, cluster: str | None = None) -> Iterator[Trial]:
    """Run the trials that ``parts`` does not hold yet and keep each when it ends; yields those finished.

    Raises DgorlError when a cluster cannot be reached or runs another program.
    """
    missing = [trial for trial in trials if not parts.holds(trial)]
    yield from (trial for trial in trials if trial not in missing)
    if not missing:
        return
    missing.sort(key=_cost, reverse=True)  # long ones first, so that no worker is left with one at the end
    done = on_cluster(_measured, missing, cluster) if cluster else on_processes(_measured, missing, workers)
    for trial, (by, outcome) in done:
        if by != program():
            where = f"--cluster {cluster}: its workers run" if cluster else "the program changed meanwhile: trials ran"
            raise DgorlError(f"{where} {by}, this is {program()}; install the same there and start again")
        parts.keep(trial, outcome)
        yield trial


def combine(trials: Sequence[Trial], parts: Parts, folder: Path, name: str) -> Outcome:
    """All trials as two tables in ``folder``: NAME.parquet repeats bit for bit, NAME_timings.parquet is measured."""
    outcome = parts.read(trials)
    write(outcome.errors, folder / f"{name}.parquet")
    write(outcome.timings, folder / f"{name}_timings.parquet")
    return outcome


def _cost(trial: Trial) -> float:
    """About how long a trial takes, in any unit: an estimator counts one, a search for unknown starts five."""
    search = 5 if trial.initial == "unknown" else 0
    return float(trial.scenario.steps * trial.scenario.robots**1.5 * (len(trial.estimators) + search))


def _measured(trial: Trial) -> tuple[str, Outcome]:
    """What a worker is asked: its program, and a trial's outcome."""
    return program(), run(trial)
