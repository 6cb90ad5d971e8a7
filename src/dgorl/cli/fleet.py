"""Run a live team on this machine: an agent process a robot, fed from a log or the simulator, on a bad network.

Example: dgorl fleet --simulate --simulation.sensors range --simulation.area 20 --rate 2 --loss 0.2 --out out/fleet
"""

from __future__ import annotations

import dataclasses
import json
import re
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import isfinite, nan
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from dgorl import logs
from dgorl.cli.estimation import EstimationOptions
from dgorl.cli.parsing import LogPath, Names, Seconds
from dgorl.cli.session import Session, kinds_in
from dgorl.cli.table import show
from dgorl.cli.terminal import terminal, words
from dgorl.configuration import Configuration, nearest
from dgorl.errors import ConfigurationError, DgorlError, MissingExtraError
from dgorl.evaluation import output
from dgorl.logs.log import Log
from dgorl.measurements import known_at
from dgorl.plotting.figures import write_figures
from dgorl.printable import json_line
from dgorl.replay import known_starts
from dgorl.simulation import Scenario, simulate
from dgorl.team import fleet_results
from dgorl.team.fault_file import FaultFile, Parted
from dgorl.team.faults import Topology
from dgorl.team.fleet import Event, Fleet, run

Share = Annotated[float, arg(metavar="SHARE", help_behavior_hint="")]


@dataclass(frozen=True, kw_only=True)
class Options(EstimationOptions):
    """What ``dgorl fleet`` can be told. Times are the log's."""

    out: Annotated[Path, arg(metavar="DIR")]
    """where results go; earlier ones are replaced at the end. The agents' files are in its folder `live`"""
    log: Positional[LogPath] = None
    """a dgorl log folder, a UTIAS MRCLAM folder or a .pyfg file"""
    simulate: bool = False
    """take a simulated log instead, of `--simulation.*`"""
    simulation: Scenario = field(default_factory=Scenario)
    duration: Seconds = None
    """of the log, take this much alone"""
    rate: float = 1.0
    """the log's seconds a second"""
    settle: float = 10.0
    """bundles are exchanged this much longer when the log has ended"""
    loss: Share = 0.0
    """of the messages on each link, this share never comes (0 to 1)"""
    delay: Annotated[str, arg(metavar="S[-S]", help_behavior_hint="")] = "0"
    """they take this long, or between this and that"""
    duplicate: Share = 0.0
    """this share comes twice"""
    reorder: Share = 0.0
    """this share is overtaken by later ones"""
    partition: Names = ()
    """A,B|C,D:FROM-TO: in this time only robots of one group hear one another"""
    topology: Topology = "full"
    """who hears whom, in the log's order of robots"""
    kill: Names = ()
    """NAME@T: its process is killed"""
    join: Names = ()
    """NAME@T: it starts no sooner, and not from a known start; or again, after a kill"""
    clock_offset: Names = ()
    """NAME=S: its clock is ahead by this"""
    clock_drift: Names = ()
    """NAME=PPM: its clock is fast by this"""


def main(options: Options) -> None:
    """Run the team, write what it estimated, print the table and the checks."""
    fleet = fleet_of(options)
    output.check(options.out)
    errors = terminal(stderr=True)
    if errors.is_terminal:
        errors.print(f"{len(fleet.log.robots)} agents, {(fleet.last - fleet.first) / fleet.rate:.0f} s")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # no agent stays behind
    run(fleet)
    _report(options, fleet, errors)


def fleet_of(options: Options) -> Fleet:
    """The team that is to run. Raises DgorlError."""
    log = _log(options)
    changes = options.settings()
    if options.clock_offset or options.clock_drift:
        changes["clock"] = "estimated"
    configuration = Session(log, options.config, changes, options.initial, (), options.out).configuration()
    fleet = Fleet(
        log,
        configuration,
        options.out / "live",
        rate=_at_least(options.rate, 0.01, "rate"),
        faults=_faults(options, log, configuration),
        offsets=dict(_numbers(options.clock_offset, "clock-offset", log.robots)),
        drifts=dict(_numbers(options.clock_drift, "clock-drift", log.robots)),
        events=_events(options, log),
        settle=_at_least(options.settle, 0.0, "settle"),
    )
    if options.initial == "known":
        # Who comes late may have moved: the start pose is not known to hold for it.
        starts = {prior.robot: log.starts[prior.robot] for prior in known_starts(log)}
        fleet = dataclasses.replace(fleet, starts={r: start for r, start in starts.items() if not fleet.late(r)})
    return fleet


def _report(options: Options, fleet: Fleet, errors: Console) -> None:
    reports = fleet_results.reports_of(fleet)
    checks = fleet_results.check(fleet, reports)
    records = fleet_results.records_of(fleet, reports)
    about = {
        "log": str(fleet.log.path.absolute()),
        "robots": list(fleet.log.robots),
        "initial": options.initial,
        "measurements": kinds_in(fleet.log),
        "solver": fleet.configuration.solver,
        "skipped": dict(fleet.log.skipped),
        "traffic": fleet_results.traffic_of(fleet, reports),
        "checks": fleet_results.as_summary(checks),
    }
    with output.replacing(options.out) as folder:
        summary = output.write(records, fleet.configuration, about, folder)
        final = json.dumps(fleet_results.final_of(fleet, checks), ensure_ascii=False, allow_nan=False)
        (folder / "final.json").write_text(final + "\n", encoding="utf-8")
        try:
            if checks.last:
                write_figures(fleet_results.drawn(fleet, reports, checks.last), folder / "figures")
        except MissingExtraError as error:
            errors.print(words(str(error)), soft_wrap=True)
    out = errors if options.json else terminal()
    show(summary, out)
    for line in _said(checks):
        out.print(words(line), soft_wrap=True)
    out.print(words(f"Results: {options.out}"), soft_wrap=True)
    if options.json:
        print(json_line(summary))


def _said(checks: fleet_results.Checks) -> list[str]:
    there = ", ".join(checks.robots)
    lines = [f"Data: {'equal' if checks.data else 'not equal'} ({there})"]
    if checks.estimates is not None:
        how = "made of any two journals, to the bit"
        lines.append(f"Estimates: {'equal' if checks.estimates else 'not equal'} ({how})")
    return [*lines, *checks.differences]


def _log(options: Options) -> Log:
    if (options.log is None) != options.simulate:
        raise DgorlError("command line: give a log or --simulate, and not both")
    if options.log is None:
        seed = options.simulation.seed if options.seed is None else options.seed
        log = simulate(dataclasses.replace(options.simulation, seed=seed))
    else:
        log = logs.read(options.log)
    log = options.of(log)
    if options.duration is not None:
        _at_least(options.duration, 0.0, "duration")
        end = min(map(known_at, log.measurements)) + options.duration
        log = dataclasses.replace(log, measurements=tuple(m for m in log.measurements if known_at(m) <= end))
    if not log.measurements:
        raise DgorlError(f"{log.path}: nothing to localise: it holds no measurements, or none in this time")
    return log


def _faults(options: Options, log: Log, configuration: Configuration) -> FaultFile | None:
    faults = FaultFile(
        robots=log.robots,
        seed=configuration.seed,
        loss=_share(options.loss, "loss"),
        delay=_span(options.delay, "delay"),
        duplicate=_share(options.duplicate, "duplicate"),
        reorder=_share(options.reorder, "reorder"),
        partitions=tuple(_partition(text, log.robots) for text in options.partition),
        topology=options.topology,
    )
    return faults if faults != FaultFile(robots=log.robots, seed=configuration.seed) else None


def _partition(text: str, robots: Sequence[str]) -> Parted:
    names, _, times = text.rpartition(":")
    groups = tuple(tuple(group.split(",")) for group in names.split("|"))
    if len(groups) < 2:
        raise ConfigurationError(f"command line: partition must be like A,B|C,D:10-20, got {text!r}")
    for robot in (name for group in groups for name in group):
        _known(robot, robots, "partition")
    return Parted(groups, *_span(times, "partition"))


def _span(text: str, option: str) -> tuple[float, float]:
    """FROM-TO, or one number for both."""
    number = r"\d+\.?\d*|\.\d+"
    match = re.fullmatch(rf"({number})(?:-({number}))?", text)
    low, high = (float(match[1]), float(match[2] or match[1])) if match else (1.0, 0.0)
    if low > high:
        raise ConfigurationError(f"command line: {option} needs seconds like 0.1-0.5, the smaller first, got {text!r}")
    return low, high


def _events(options: Options, log: Log) -> tuple[Event, ...]:
    events = []
    for kind in ("kill", "join"):
        for text in getattr(options, kind):
            robot, _, stamp = text.rpartition("@")
            _known(robot, log.robots, kind)
            events.append(Event(_number(stamp, kind, text), robot, kind))
    events.sort(key=lambda event: event.stamp)
    for robot in log.robots:
        kinds = [event.kind for event in events if event.robot == robot]
        if any(a == b for a, b in pairwise(kinds)):
            raise ConfigurationError(f"command line: {robot} must be killed before it can join again, and the reverse")
    return tuple(events)


def _numbers(texts: Sequence[str], option: str, robots: Sequence[str]) -> list[tuple[str, float]]:
    found = []
    for text in texts:
        robot, _, number = text.rpartition("=")
        _known(robot, robots, option)
        found.append((robot, _number(number, option, text)))
    return found


def _number(text: str, option: str, whole: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = nan
    if not isfinite(number):
        raise ConfigurationError(f"command line: {option} must end in a number, got {whole!r}")
    return number


def _known(robot: str, robots: Sequence[str], option: str) -> None:
    if robot not in robots:
        hint = f"{nearest(robot, robots)}; the robots are {', '.join(robots)}"
        raise ConfigurationError(f"command line: {option} names an unknown robot `{robot}`{hint}")


def _share(value: float, option: str) -> float:
    if not 0.0 <= value <= 1.0:
        raise ConfigurationError(f"command line: {option} must be from 0 to 1, got {value}")
    return value


def _at_least(value: float, least: float, option: str) -> float:
    if not least <= value < float("inf"):
        raise ConfigurationError(f"command line: {option} must be at least {least:g}, got {value}")
    return value
