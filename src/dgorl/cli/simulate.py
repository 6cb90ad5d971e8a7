"""Write a synthetic log of robots r1..rN with ground truth; the defaults are the paper's experiment.

Example: dgorl simulate --robots 4 --sensors range,bearing --seed 1 --out logs/four
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg

from dgorl import logs
from dgorl.errors import DgorlError
from dgorl.printable import json_line, printable
from dgorl.simulation import Scenario, simulate


@dataclass(frozen=True)
class Options:
    """What ``dgorl simulate`` can be told."""

    out: Annotated[Path, arg(metavar="LOG")]
    """folder of the log; an earlier log in it is replaced"""
    scenario: OmitArgPrefixes[Scenario]
    json: bool = False
    """say what was written as one JSON object"""


def main(options: Options) -> None:
    """Simulate and write."""
    check_replaceable(options.out)
    log = simulate(options.scenario)
    logs.write(log, options.out)
    count = len(log.measurements)
    if options.json:
        print(json_line({"log": str(options.out), "robots": list(log.robots), "measurements": count}))
    else:
        print(printable(f"{options.out}: {len(log.robots)} robots, {count} measurements"))


def check_replaceable(path: Path) -> None:
    """Raises DgorlError unless a log can be written there without harm to anything but an earlier log."""
    if path.is_dir() and any(path.iterdir()) and not (path / "team.yaml").is_file():
        raise DgorlError(f"{path}: holds files that are no dgorl log; name a new folder with --out")
    if path.exists() and not path.is_dir():
        raise DgorlError(f"{path}: is a file, not a folder; name a new folder with --out")
