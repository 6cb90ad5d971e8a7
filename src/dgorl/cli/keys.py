"""Make a robot's signing key; print the line of its public half for team.yaml. The key file never leaves the robot.

Example: dgorl keys --robot r1 --out r1.key
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from dgorl.errors import DgorlError
from dgorl.logs.team import valid_name
from dgorl.printable import json_line, printable
from dgorl.team.keys import load_key, make_key


@dataclass(frozen=True)
class Options:
    """What ``dgorl keys`` can be told."""

    robot: Annotated[str, arg(metavar="NAME")]
    """whose key it is"""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: NAME.key)")] = None
    """where the private half goes; a file that exists is not overwritten"""
    show: bool = False
    """make none; print the public half of the key in that file"""
    json: bool = False
    """one JSON object"""


def main(options: Options) -> None:
    """Make or show it. Raises DgorlError if the name cannot be a robot's, the file exists or cannot be written."""
    if not valid_name(options.robot):
        raise DgorlError(f"`{options.robot}` cannot be a robot's name (letters, digits, `_`, `-`, dots; not `world`)")
    path = options.out or Path(f"{options.robot}.key")
    key = load_key(path) if options.show else make_key(path)
    line = f"{options.robot}: {{key: {key.public}}}"
    if options.json:
        print(json_line({"robot": options.robot, "file": str(path), "public": key.public, "team_yaml": line}))
    else:
        print(printable(f"{path}: the private half, for {options.robot} alone"))
        print(f"Below `robots:` in team.yaml:\n  {line}")
