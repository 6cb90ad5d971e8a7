"""Run the paper's experiment: baselines, bound, figures, and a table that answers each of its claims.

Example: dgorl paper --out out/paper --trials 10
"""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text
from tyro.conf import arg

from dgorl.cli.terminal import terminal, words
from dgorl.errors import ConfigurationError, DgorlError, MissingExtraError
from dgorl.evaluation import answers
from dgorl.evaluation.claims import FIRST, Claim
from dgorl.evaluation.experiments import LONGER, Paper, combine, compute
from dgorl.evaluation.measured import Clocked
from dgorl.evaluation.report import cells, write_claims
from dgorl.evaluation.results import Parts, parquet
from dgorl.evaluation.trials import Outcome, Trial
from dgorl.plotting.experiment import write_figures
from dgorl.printable import json_line

COLUMNS = (0, 1, 2, 3, 6, 7)
"""of the claims' table that fit a terminal"""


@dataclass(frozen=True)
class Options:
    """What ``dgorl paper`` can be told."""

    out: Annotated[Path, arg(metavar="DIR")]
    """where tables, figures and claims go; finished trials there are not run again"""
    trials: int = 10
    """repetitions, each with its own seed"""
    workers: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None
    """processes (default: one a core)"""
    cluster: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """run the trials on the Dask cluster whose scheduler is there, in place of processes of this machine"""
    sweep: bool = False
    """vary noise, radio, area, team size and odometry around the paper's setting as well; minutes more"""
    seed: int = 0
    """of the first trial"""
    steps: int = 100
    """time steps of a trial"""
    json: bool = False
    """put the claims on stdout as one JSON object"""


def main(options: Options) -> None:
    """Run what is missing, then write tables, figures and claims."""
    paper = Paper(trials=options.trials, seed=options.seed, steps=options.steps, sweep=options.sweep)
    errors = terminal(stderr=True)
    parts = _prepare(options)
    try:
        outcome, sweeps, found = _measure(options, paper, parts, errors)
    except KeyboardInterrupt:
        again = "the same command goes on from there"
        errors.print(words(f"finished trials are kept in {parts.folder}; {again}"), soft_wrap=True)
        raise
    summary = write_claims(found, _setting(options), options.out)
    out = errors if options.json else terminal()
    _show(found, out)
    out.print(words(f"Claims: {options.out / 'claims.md'}"), soft_wrap=True)
    try:
        pictures = write_figures(paper.scenario(0), outcome, sweeps, options.out / "figures")
        out.print(words(f"Pictures: {pictures[0]} and {len(pictures) - 1} more beside it"), soft_wrap=True)
    except MissingExtraError as error:
        errors.print(words(str(error)), soft_wrap=True)
    if options.json:
        print(json_line(summary))


def _prepare(options: Options) -> Parts:
    """Check what was asked and make the folder. Raises DgorlError."""
    for name, least in (("trials", 1), ("steps", 1), ("seed", 0), ("workers", 1)):
        value = getattr(options, name)
        if value is not None and value < least:
            raise ConfigurationError(f"--{name} must be at least {least}, got {value}")
    parquet()
    for part in (options.out, *options.out.parents):
        if part.exists() and not part.is_dir():
            raise DgorlError(f"{part}: is a file, not a folder; name another folder with --out")
    return Parts(options.out / "parts")


def _measure(
    options: Options, paper: Paper, parts: Parts, errors: Console
) -> tuple[Outcome, Outcome | None, list[Claim]]:
    """The paper's trials and what clocks tell beside them, then the sweeps."""
    trials, around = paper.plan(), paper.sweeps()
    scenarios = [paper.scenario(k) for k in range(paper.trials)]
    with Clocked.started(parts, scenarios, pace=1.0) as clocked:
        _run([*trials, *around], parts, options, errors)
        robots, solvers = clocked.robots(), clocked.solvers()
    outcome = combine(trials, parts, options.out, "trials")
    sweeps = combine(around, parts, options.out, "sweeps") if around else None
    found = [
        *answers.comparison(outcome.errors),
        *answers.absolute(outcome.errors),
        *answers.effort(outcome.timings, robots, solvers["summary"]),
        *answers.accuracy(outcome.errors),
        *answers.consistency(outcome.errors),
        *answers.not_measured({f"solver {name}": why for name, why in solvers["missing"].items()}),
    ]
    command = _setting(options)["command"]
    return outcome, sweeps, [replace(claim, command=command) for claim in found]


def _run(trials: Sequence[Trial], parts: Parts, options: Options, errors: Console) -> None:
    """All trials, with a progress bar if there is a terminal."""
    workers = options.workers or os.cpu_count() or 1
    columns = (TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        for _ in progress.track(compute(trials, parts, workers, options.cluster), total=len(trials)):
            pass


def _setting(options: Options) -> dict[str, Any]:
    """What the claims say of how they were measured."""
    command = f"dgorl paper --out {options.out} --trials {options.trials}"
    command += f" --seed {options.seed}" if options.seed else ""
    command += f" --steps {options.steps}" if options.steps != Options.steps else ""
    return {
        "trials": options.trials,
        "steps": options.steps,
        "seed": options.seed,
        "command": command,
        "first": FIRST,
        "longer": LONGER,
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
    }


def _show(claims: Sequence[Claim], console: Console) -> None:
    """The claims, briefly."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("claim", "paper", "ours", "spread", "asked", "met"):
        table.add_column(name, overflow="fold")
    for claim in claims:
        row = cells(claim)
        table.add_row(*(Text(row[k].replace("*", "")) for k in COLUMNS))
    console.print(table)
