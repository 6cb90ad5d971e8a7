"""What ``run`` and ``demo`` share: replay a log with a progress bar, write its results, print the table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dgorl.cli.table import show
from dgorl.cli.terminal import terminal, words
from dgorl.configuration import Configuration, load, merge
from dgorl.errors import DgorlError, MissingExtraError
from dgorl.evaluation import output
from dgorl.evaluation.records import collect
from dgorl.logs.log import KINDS, Log
from dgorl.plotting.figures import write_figures
from dgorl.printable import json_line
from dgorl.replay import Replay, Tick, replay


@dataclass(frozen=True)
class Session:
    """A log and how to localise it; ``config`` is a YAML file, ``changes`` the command line's settings."""

    log: Log
    config: Path | None
    changes: Mapping[str, Any]
    initial: str
    egos: tuple[str, ...]
    out: Path
    estimator: str = "dgorl"

    def configuration(self) -> Configuration:
        """Defaults < the log's own settings < YAML file < command line. Raises ConfigurationError."""
        configuration = merge(Configuration(), self.log.configuration, str(self.log.path))
        if self.config is not None:
            configuration = merge(configuration, load(self.config), str(self.config))
        return merge(configuration, self.changes, "command line")


def default_folder(log: Path) -> Path:
    """out/NAME OF THE LOG; with -2, -3, … behind it where that holds the results of another log of this name."""
    name = log.resolve().stem if log.is_file() else log.resolve().name
    for k in count(1):
        folder = Path("out") / (name if k == 1 else f"{name}-{k}")
        owner = output.log_of(folder)
        if owner is None or owner.resolve() == log.resolve():
            return folder
    raise AssertionError  # there are numbers enough


def report(session: Session, *, json_wanted: bool) -> None:
    """Localise, write everything, print the table; as JSON on stdout if wanted, the words on stderr then."""
    errors = terminal(stderr=True)
    out = errors if json_wanted else terminal()
    summary, pictures = localize(session, errors)
    show(summary, out)
    out.print(words(f"Results: {session.out}"), soft_wrap=True)
    if pictures:
        more = f" and {len(pictures) - 1} more beside it" if len(pictures) > 1 else ""
        out.print(words(f"Pictures: {pictures[0]}{more}"), soft_wrap=True)
    if json_wanted:
        print(json_line(summary))


def localize(session: Session, errors: Console) -> tuple[dict[str, Any], list[Path]]:
    """Replay a session's log and write its folder; returns the summary and the pictures.

    Raises DgorlError; without matplotlib there are no pictures and a hint on ``errors``.
    """
    log, configuration = session.log, session.configuration()
    ticks = replay(log, configuration, initial=session.initial, egos=session.egos or None, estimator=session.estimator)
    if not len(ticks):
        period = configuration.period
        raise DgorlError(f"{log.path}: nothing to localise: it ends within one period of {period} s")
    about = {
        "log": str(log.path.absolute()),
        "robots": list(log.robots),
        "initial": session.initial,
        "estimator": session.estimator,
        "measurements": kinds_in(log),
        "solver": configuration.solver,
        "skipped": dict(log.skipped),
    }
    if session.estimator != "dgorl" and session.initial == "unknown":
        about["starts"] = "the first poses that dgorl tracked"
    pictures: list[Path] = []
    with output.replacing(session.out) as folder:
        records = collect(_watched(ticks, errors), log.truth)
        summary = output.write(records, configuration, about, folder)
        try:
            pictures = write_figures(records, folder / "figures")
        except MissingExtraError as error:
            errors.print(words(str(error)), soft_wrap=True)
    return summary, [session.out / picture.relative_to(folder) for picture in pictures]


def kinds_in(log: Log) -> list[str]:
    """The kinds of measurements between robots that a log holds."""
    return [name for name, kind in KINDS.items() if any(isinstance(m, kind) for m in log.measurements)]


def _watched(ticks: Replay, errors: Console) -> Iterator[Tick]:
    """The ticks, with a progress bar while they run if there is a terminal."""
    columns = (TextColumn("localising"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        yield from progress.track(ticks, total=len(ticks))
