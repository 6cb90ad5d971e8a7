"""Look for what is wrong: with this installation, a log, a robot's journal, or the network of a live team.

Example: dgorl doctor --team team.yaml
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.text import Text
from tyro.conf import Positional, arg

from dgorl import logs
from dgorl.cli.parsing import File
from dgorl.cli.terminal import terminal, words
from dgorl.errors import ConfigurationError, DgorlError, LogError
from dgorl.findings import Finding, Level, problem
from dgorl.installation import installation
from dgorl.logs.checkup import checkup
from dgorl.printable import json_line

MARKS = {Level.OK: ("✓", "green"), Level.NOTE: ("·", "yellow"), Level.PROBLEM: ("✗", "bold red")}


@dataclass(frozen=True)
class Options:
    """What ``dgorl doctor`` can be told."""

    log: Positional[Annotated[Path | None, arg(metavar="[LOG]", help_behavior_hint="")]] = None
    """a log, in any format that `dgorl run` reads"""
    team: File = None
    """a live team's team.yaml: listen on its network"""
    journal: File = None
    """a robot's journal; its agent may be running"""
    seconds: Annotated[float, arg(metavar="SECONDS")] = 5.0
    """listen to the team for this long"""
    name: Annotated[str, arg(metavar="NAME")] = "doctor"
    """stands for {robot} in the paths of the team file's TLS certificates"""
    json: bool = False
    """one JSON object"""


def main(options: Options) -> None:
    """Say what was found. Raises DgorlError, exit code 1, if there are problems."""
    if not 0.0 < options.seconds < inf:
        raise ConfigurationError(f"command line: --seconds must be positive, got {options.seconds}")
    findings = []
    console = terminal()
    for finding in examined(options):
        findings.append(finding)
        if not options.json:
            _show(finding, console)
    counts = Counter(finding.level for finding in findings)
    if options.json:
        found = [dataclasses.asdict(finding) for finding in findings]
        print(json_line({"well": not counts[Level.PROBLEM], "findings": found}))
    if counts[Level.PROBLEM]:
        what = "1 problem" if counts[Level.PROBLEM] == 1 else f"{counts[Level.PROBLEM]} problems"
        first = next(finding for finding in findings if finding.level == Level.PROBLEM)
        raise DgorlError(f"{what} found; the first, {first.area}: {first.what}; {first.advice}")
    if not options.json:
        console.print("All is well." if not counts[Level.NOTE] else f"All is well; notes: {counts[Level.NOTE]}.")


def examined(options: Options) -> Iterator[Finding]:
    """All that is asked for, the installation in any case."""
    yield from installation()
    if options.log is not None:
        yield from _log(options.log)
    if options.journal is not None:
        from dgorl.team.journal_checkup import journal_checkup

        yield from journal_checkup(options.journal)
    if options.team is not None:
        yield from _network(options.team, options)


def _log(path: Path) -> Iterator[Finding]:
    try:
        log = logs.read(path)
    except LogError as error:
        yield problem("log", str(error), "correct it; docs/logs.md describes the formats")
        return
    yield from checkup(log)


def _network(path: Path, options: Options) -> Iterator[Finding]:
    from dgorl.cli.watcher import Watcher
    from dgorl.team.diagnosis import Heard, diagnosis
    from dgorl.team.interfaces import Advice, Interfaces, addresses
    from dgorl.team.team_file import TeamFile

    try:
        team = TeamFile.read(path)
        with closing(Watcher(team, options.name)) as watcher:
            for _ in watcher.listen(options.seconds):
                pass
            present, nameless, now = watcher.network.present(), watcher.network.nameless, watcher.now()
    except DgorlError as error:
        yield problem("network", str(error), "nobody of the team can be heard from here until that is put right")
        return
    if Interfaces(team.transport).look(addresses(team.transport.group)) is Advice.WAIT:
        what = "this machine has no network: no interface has an address"
        yield problem("network", what, "plug it in, or see `ip address`; agents join when it has one")
    yield from diagnosis(Heard(team, watcher.watch, present, now, options.seconds, nameless))


def _show(finding: Finding, console: Console) -> None:
    mark, style = MARKS[finding.level]
    line = Text(f"{mark} ", style=style)
    line.append(f"{finding.area:<8}", style="dim" if finding.level == Level.OK else style)
    line.append(words(finding.what))
    if finding.advice:
        line.append(words(f" → {finding.advice}", style="italic"))
    console.print(line, soft_wrap=True)
