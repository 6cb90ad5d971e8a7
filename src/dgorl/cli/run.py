"""Localise every robot's peers in a log, causally, and write poses, covariances, scores and pictures.

Example: dgorl run logs/lab --out out/lab --measurements range,bearing
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from dgorl import logs
from dgorl.baselines import NAMES
from dgorl.cli.estimation import EstimationOptions
from dgorl.cli.parsing import Folder, LogArgument, Names, one_of
from dgorl.cli.session import Session, default_folder, report
from dgorl.configuration import Solver


@dataclass(frozen=True, kw_only=True)
class Options(EstimationOptions):
    """What ``dgorl run`` can be told."""

    log: LogArgument
    """a dgorl log folder, a UTIAS MRCLAM folder or a .pyfg file"""
    out: Folder = None
    """where results go; earlier ones are replaced at the end (default: out/NAME OF THE LOG, or out/NAME-2, … where that
    holds the results of another log)"""
    ego: Names = ()
    """robot whose view is wanted; all when not given"""
    solver: Solver = "native"
    """what optimises the graph; g2o and gtsam find the same optimum, slowly"""
    estimator: Annotated[str, one_of(NAMES)] = "dgorl"
    """dgorl, or a baseline: dead-reckoning, naive, ci, split-ci, trn, gtsam-fixed-lag; with unknown starts a baseline
    begins at DGORL's first tracked poses"""


def main(options: Options) -> None:
    """Replay, write, print."""
    log = options.of(logs.read(options.log))
    out = options.out or default_folder(options.log)
    changes = {**options.settings(), "solver": options.solver}
    session = Session(log, options.config, changes, options.initial, options.ego, out, options.estimator)
    report(session, json_wanted=options.json)
