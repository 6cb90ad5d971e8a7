"""Run one live robot: measurements in, signed bundles to and from its team, an estimate a tick as JSON on stdout.

Example: dgorl agent --robot r1 --team team.yaml --key r1.key --stdin
"""

# argparse, not tyro: an agent's process stays small (80 MB), and starts fast.

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from dgorl.cli.main import FAILURE, INTERRUPTED, USAGE
from dgorl.errors import DgorlError
from dgorl.team.json_logs import log_to_stderr

if TYPE_CHECKING:
    from dgorl.team.process import Setup

log = logging.getLogger("dgorl.agent")


def main(arguments: Sequence[str]) -> None:
    """Run it until SIGTERM or SIGINT. What goes wrong is said in JSON, as all on stderr; leaves by SystemExit then."""
    options = _parser().parse_args(arguments)
    log_to_stderr(options.robot, options.log_level)
    try:
        from dgorl.team.process import run  # after the parser: --help and usage errors are quick

        run(_setup(options))
    except (DgorlError, OSError) as error:
        log.critical(str(error))
        raise SystemExit(FAILURE) from error
    except KeyboardInterrupt as error:
        raise SystemExit(INTERRUPTED) from error


class _Parser(argparse.ArgumentParser):
    """Says in JSON, too, what is wrong with its arguments: a log has one form."""

    def error(self, message: str) -> NoReturn:
        log_to_stderr("", "info")
        log.critical(f"wrong usage: {message}; see `dgorl agent --help`")
        raise SystemExit(USAGE)


def _parser() -> argparse.ArgumentParser:
    summary, example = (__doc__ or "").strip().split("\n\n")
    parser = _Parser(
        "dgorl agent",
        description=summary,
        epilog=example,
        allow_abbrev=False,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    add = parser.add_argument
    add("--robot", required=True, metavar="NAME", help="this robot; the team file lists it")
    add("--team", required=True, type=Path, metavar="FILE", help="team.yaml, the same on all robots")
    add("--key", type=Path, metavar="FILE", help="its signing key; `dgorl keys` makes one")
    add(
        "--journal",
        type=Path,
        metavar="FILE",
        help="where it remembers (default: ~/.local/state/dgorl/TEAM/NAME.journal)",
    )
    add(
        "--sync",
        choices=("full", "normal"),
        default="full",
        help="full: own bundles survive a power cut; normal: kill -9",
    )
    add("--stdin", action="store_true", help="take its own measurements as JSON lines on stdin")
    add("--local", metavar="ENDPOINT", help="... and on a Zenoh session on loopback, like tcp/127.0.0.1:7448")
    add("--log-level", choices=("debug", "info", "warning", "error"), default="info", help="of the logs on stderr")
    fleet = parser.add_argument_group("for fleets on one machine; times in seconds")
    add = fleet.add_argument
    add("--origin", type=float, metavar="S", help="time of the recording ...")
    add(
        "--at",
        type=float,
        metavar="S",
        help="... when the machine's monotonic clock is at this; or stdin's first line says",
    )
    add("--rate", type=float, default=1.0, metavar="R", help="the recording passes this many times as fast")
    add("--clock-offset", type=float, default=0.0, metavar="S", help="the robot's clock is ahead by this")
    add(
        "--clock-drift",
        type=float,
        default=0.0,
        metavar="PPM",
        help="... and by this share of the time since the origin",
    )
    add("--until", type=float, metavar="S", help="time of its last tick, on its clock")
    add("--settle", type=float, default=0.0, metavar="S", help="it goes on exchanging bundles for this long after it")
    add("--faults", type=Path, metavar="FILE", help="what goes wrong on its network: JSON, as `dgorl fleet` writes it")
    return parser


def _setup(options: argparse.Namespace) -> Setup:
    from dgorl.configuration import nearest
    from dgorl.errors import ConfigurationError
    from dgorl.team.fault_file import read_faults
    from dgorl.team.journal_place import state_journal
    from dgorl.team.lines import LinesIn
    from dgorl.team.pace import Pace, begin
    from dgorl.team.process import Setup
    from dgorl.team.team_file import TeamFile

    for name, least in (("rate", 0.001), ("settle", 0.0), ("origin", -inf), ("at", -inf), ("until", -inf)):
        value = getattr(options, name)
        if value is not None and not least <= value < inf:
            raise ConfigurationError(f"command line: --{name} must be a number, at least {least:g}, got {value}")
    for name in ("clock_offset", "clock_drift"):
        if not isfinite(getattr(options, name)):
            raise ConfigurationError(f"command line: --{name.replace('_', '-')} must be a number")
    team = TeamFile.read(options.team)
    if options.robot not in team.robots:
        hint = f"{nearest(options.robot, team.robots)}; the robots are {', '.join(team.robots)}"
        raise ConfigurationError(f"{options.team}: no robot is called `{options.robot}`{hint}")
    stdin, pace = LinesIn(sys.stdin.fileno()), None
    if options.origin is not None:
        at = begin(stdin) if options.at is None else options.at
        pace = Pace(options.origin, at, options.rate, options.clock_offset, options.clock_drift)
    return Setup(
        robot=options.robot,
        team=team,
        journal=options.journal or state_journal(team.team, options.robot),
        key=options.key,
        synchronous=options.sync,
        stdin=stdin if options.stdin else None,
        local=options.local,
        faults=None if options.faults is None else read_faults(options.faults),
        pace=pace,
        until=options.until,
        settle=options.settle,
    )
