"""Localise every robot's peers in a log, causally, and write poses, covariances, scores and pictures.

Example: dgorl run logs/lab --out out/lab --measurements range,bearing
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from tyro.conf import arg

from dgorl import logs
from dgorl.baselines import NAMES
from dgorl.cli.parsing import File, Folder, LogArgument, Names, Seconds, Seed, Window, one_of
from dgorl.cli.session import Session, default_folder, report
from dgorl.configuration import Solver
from dgorl.errors import ConfigurationError

Kind = Literal["range", "bearing", "rssi"]


@dataclass(frozen=True)
class Options:
    """What ``dgorl run`` can be told."""

    log: LogArgument
    """a dgorl log folder, a UTIAS MRCLAM folder or a .pyfg file"""
    out: Folder = None
    """where results go; earlier ones are replaced (default: out/NAME OF THE LOG)"""
    ego: Names = ()
    """robot whose view is wanted; all when not given"""
    initial: Literal["known", "unknown"] = "unknown"
    """unknown finds out where everybody is; known takes the log's start poses, good to 0.05 m and 1°"""
    measurements: Annotated[tuple[Kind, ...], arg(help_behavior_hint="")] = ()
    """use these alone; all in the log when not given"""
    solver: Solver = "native"
    """what optimises the graph; g2o and gtsam find the same optimum, slowly"""
    estimator: Annotated[str, one_of(NAMES)] = "dgorl"
    """dgorl, or a baseline: dead-reckoning, naive, ci, split-ci, trn, gtsam-fixed-lag; with unknown starts a baseline
    begins at DGORL's first tracked poses"""
    window: Window = None
    """length of the window that is optimised, a multiple of 5 s (default: 30)"""
    history: Seconds = None
    """measurements later than this are too late (default: 180)"""
    candidates: Annotated[int | None, arg(metavar="K", help_behavior_hint="")] = None
    """places kept in mind for each robot not yet found (default: 5)"""
    period: Seconds = None
    """time between two ticks (default: 0.5)"""
    truth: File = None
    """a groundtruth.csv (t,robot,x,y,theta) to score against, in place of the log's"""
    config: File = None
    """YAML settings, over the log's own, under the command line's; see `dgorl config`"""
    seed: Seed = None
    """of everything drawn by chance (default: 0)"""
    json: bool = False
    """put the summary on stdout as one JSON object"""


def main(options: Options) -> None:
    """Replay, write, print."""
    log = logs.read(options.log)
    if options.measurements:
        log = logs.select(log, options.measurements)
    if options.truth is not None:
        log = dataclasses.replace(log, truth=logs.read_truth(options.truth, log.robots))
    out = options.out or default_folder(options.log)
    session = Session(log, options.config, settings(options), options.initial, options.ego, out, options.estimator)
    report(session, json_wanted=options.json)


def settings(options: Options) -> dict[str, Any]:
    """The settings given on the command line. Raises ConfigurationError for a window that is not a number."""
    changes: dict[str, Any] = {"solver": options.solver}
    for name in ("history", "candidates", "period", "seed"):
        if getattr(options, name) is not None:
            changes[name] = getattr(options, name)
    if options.window is not None:
        changes["window"] = window_of(options.window)
    return changes


def window_of(text: str) -> float | str:
    """Seconds, or all. Raises ConfigurationError."""
    if text == "all":
        return text
    try:
        return float(text)
    except ValueError:
        raise ConfigurationError(f"command line: window must be seconds or all, got {text!r}") from None
