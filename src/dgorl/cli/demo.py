"""Simulate the paper's team of five, localise it, print the table and draw pictures; or do so for a log.

Example: dgorl demo --log logs/lab
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from dgorl import logs
from dgorl.cli.parsing import Folder, LogPath
from dgorl.cli.session import Session, default_folder, report
from dgorl.cli.simulate import check_replaceable
from dgorl.simulation import Scenario, simulate


@dataclass(frozen=True)
class Options:
    """What ``dgorl demo`` can be told."""

    log: LogPath = None
    """localise this log; without it a team is simulated into DIR/log"""
    out: Folder = None
    """where results go (default: out/demo, or out/NAME OF THE LOG)"""
    seed: int = 0
    """of the simulated team"""
    json: bool = False
    """put the summary on stdout as one JSON object"""


def main(options: Options) -> None:
    """Simulate unless given a log, then do what `dgorl run` does."""
    out = options.out or (Path("out/demo") if options.log is None else default_folder(options.log))
    if options.log is not None:
        log = logs.read(options.log)
    else:
        log = dataclasses.replace(simulate(Scenario(seed=options.seed)), path=out / "log")
        check_replaceable(log.path)
    report(Session(log, None, {}, "known", (), out), json_wanted=options.json)
    if options.log is None:
        logs.write(log, log.path)
