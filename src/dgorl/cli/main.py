"""The command line: picks the subcommand; the only place that prints errors and decides exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper

import dgorl
from dgorl.cli.interrupts import interruptible
from dgorl.configuration import nearest
from dgorl.errors import DgorlError
from dgorl.printable import printable

COMMANDS = {
    "demo": "simulate a team, or take a log, localise it, draw pictures",
    "run": "localise every robot's peers in a log",
    "simulate": "write a synthetic log",
    "paper": "the paper's experiment: every claim beside a measured figure",
    "agent": "run one live robot",
    "fleet": "run a live team on this machine, on a network with faults",
    "monitor": "watch a live team",
    "doctor": "check the install, a log, a journal, the network of a team",
    "keys": "make a robot's signing key, print its public half for team.yaml",
    "config": "print the full configuration with comments",
}
OK, FAILURE, USAGE, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand and return its exit code; usage errors leave by SystemExit(2)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        with interruptible():
            code = _dispatch(list(sys.argv[1:] if arguments is None else arguments))
            sys.stdout.flush()
        return code
    except DgorlError as error:
        return _fail(str(error))
    except BrokenPipeError:
        # Who read our output has left; without this, the interpreter would complain when it flushes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def _dispatch(arguments: list[str]) -> int:
    command = arguments[0] if arguments else ""
    if command in ("-h", "--help"):
        print(_overview())
    elif command == "--version":
        print(f"dgorl {dgorl.__version__}")
    elif command in COMMANDS:
        module = import_module(f"dgorl.cli.{command}")
        if hasattr(module, "Options"):
            from dgorl.cli.parsing import parse  # large; an agent does without

            module.main(parse(module.Options, command, module.__doc__, arguments[1:]))
        else:
            module.main(arguments[1:])
    else:
        what = f"unknown command `{command}`{nearest(command, COMMANDS)}" if command else "no command given"
        print(f"dgorl: {printable(what)}\n\n{_overview()}", file=sys.stderr)
        return USAGE
    return OK


def _overview() -> str:
    rows = "\n".join(f"  {name:<10} {what}" for name, what in COMMANDS.items())
    return (
        "usage: dgorl [-h] [--version] COMMAND ...\n\n"
        "Where are the others? Relative localization of robot teams by window graph optimization.\n\n"
        f"{rows}\n\n"
        "Example: dgorl demo\n"
        "Each command explains itself: dgorl COMMAND --help"
    )


def _fail(what: str) -> int:
    print(f"dgorl: {printable(' '.join(what.split()))}", file=sys.stderr)
    return FAILURE
