"""Watch a live team: where each robot sees the others, how surely, clocks, losses, traffic. It says nothing itself.

Example: dgorl monitor --team team.yaml --robot r1
"""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Annotated, Any

from rich.live import Live
from tyro.conf import arg

from dgorl.cli.parsing import File
from dgorl.cli.terminal import terminal
from dgorl.cli.watch_table import WIDTH, tables
from dgorl.cli.watcher import Watcher
from dgorl.configuration import nearest
from dgorl.errors import ConfigurationError
from dgorl.printable import json_line
from dgorl.team.team_file import TeamFile


@dataclass(frozen=True)
class Options:
    """What ``dgorl monitor`` can be told."""

    team: Annotated[Path, arg(metavar="FILE")]
    """the team's team.yaml"""
    robot: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """the robot whose view is wanted; all in one table when not given"""
    once: bool = False
    """print one table as soon as all who are there were heard, and exit"""
    seconds: Annotated[float, arg(metavar="SECONDS")] = 5.0
    """... wait for them this long at most"""
    every: Annotated[float, arg(metavar="SECONDS")] = 1.0
    """time between two tables"""
    viewer: bool = False
    """a picture in a window in place of the table, or in the file --out names"""
    out: File = None
    """a PNG that is replaced with every picture"""
    name: Annotated[str, arg(metavar="NAME")] = "monitor"
    """stands for {robot} in the paths of the team file's TLS certificates"""
    json: bool = False
    """one JSON object in place of every table"""


def main(options: Options) -> None:
    """Watch until interrupted, once with ``--once``. Raises DgorlError when nobody is heard then."""
    team = TeamFile.read(options.team)
    if options.robot is not None and options.robot not in team.robots:
        hint = f"{nearest(options.robot, team.robots)}; the robots are {', '.join(team.robots)}"
        raise ConfigurationError(f"{options.team}: no robot is called `{options.robot}`{hint}")
    if options.out is not None and not options.viewer:
        raise ConfigurationError("command line: --out names the picture of --viewer; give both")
    if not (0.0 < options.every < inf and 0.0 < options.seconds < inf):
        raise ConfigurationError("command line: --every and --seconds must be positive")
    with closing(Watcher(team, options.name)) as watcher:
        if options.viewer:
            from dgorl.cli.viewer import view  # needs matplotlib

            view(watcher, options.robot, options.every, options.out, once=options.once, patience=options.seconds)
        elif options.once:
            watcher.meet(options.seconds)
            _print(watcher.state(), options)
        else:
            _follow(watcher, options)


def _follow(watcher: Watcher, options: Options) -> None:
    console = terminal()
    if options.json or not console.is_terminal:
        while True:
            for _ in watcher.listen(options.every):
                pass
            _print(watcher.state(), options)
    with Live(tables(watcher.state(), options.robot), console=console, auto_refresh=False) as live:
        while True:
            for _ in watcher.listen(options.every):
                pass
            live.update(tables(watcher.state(), options.robot), refresh=True)


def _print(state: dict[str, Any], options: Options) -> None:
    if options.json:
        if options.robot is not None:
            state = state | {"robots": {options.robot: state["robots"][options.robot]}}
        print(json_line(state), flush=True)
        return
    console = terminal()
    if not console.is_terminal:
        console = terminal(width=max(console.width, WIDTH))
    console.print(tables(state, options.robot))
    sys.stdout.flush()
