"""What a fleet left: its agents' estimates as records, what they sent, and whether all know and estimate the same."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dgorl.errors import DgorlError
from dgorl.estimate import Estimate, OptimizedGraph
from dgorl.evaluation.records import PairRecord, Records, collect
from dgorl.replay import Tick, start_priors
from dgorl.se2 import Array
from dgorl.team.fleet import Fleet
from dgorl.team.journal_data import held, ranges, recompute
from dgorl.team.journal_read import contents
from dgorl.team.pace import Pace
from dgorl.team.report import Report, estimates_of, peers_of, read_report


@dataclass(frozen=True)
class Checks:
    """Whether the robots that were there at the end agree, by their journals.

    data: all hold the same bundles. estimates: of these, at the log's last tick, the journals of any two give the same
    to the bit; None where data differ, or clocks are estimated (each journal then tells its own story alone).
    differences: in words. last: each robot's estimate at the last tick, of all its journal holds.
    """

    robots: tuple[str, ...]
    data: bool
    estimates: bool | None
    differences: tuple[str, ...]
    last: Mapping[str, Estimate]


def reports_of(fleet: Fleet) -> dict[str, list[Report]]:
    """What each agent said, restarts one after another; a line torn by a kill is left out."""
    return {robot: list(_reports(fleet.reports(robot))) for robot in fleet.log.robots}


def records_of(fleet: Fleet, reports: Mapping[str, Sequence[Report]]) -> Records:
    """The estimates beside the log's truth, stamps in the log's time; ticks an agent skipped are not there.

    Raises DgorlError when no agent said anything.
    """
    pairs: dict[tuple[str, str], PairRecord] = {}
    tick_s: dict[str, Array] = {}
    stamps: list[Array] = []
    for robot, said in _counted(fleet, reports).items():
        own = collect((_tick(report, fleet.pace(robot)) for report in said), fleet.log.truth)
        data = tuple(report.data for report in said)
        pairs |= {names: replace(pair, data=data) for names, pair in own.pairs.items()}
        tick_s |= own.tick_s
        stamps.append(own.stamps)
    if not stamps:
        raise DgorlError(f"{fleet.folder}: no agent said anything; see its *.log")
    every = np.unique(np.concatenate(stamps))
    return Records(tuple(sorted(tick_s)), every, tick_s, dict(sorted(pairs.items())), fleet.log.truth)


def drawn(fleet: Fleet, reports: Mapping[str, Sequence[Report]], last: Mapping[str, Estimate]) -> Records:
    """The records for figures: one row a tick whoever skipped it, of the robots that have a last estimate."""
    ticks: dict[float, dict[str, Report]] = {}
    for robot, said in _counted(fleet, reports).items():
        for report in said:
            ticks.setdefault(fleet.pace(robot).to_recording(report.stamp), {})[robot] = report
    rows = (
        Tick(t, {name: _estimate(r, t) for name, r in heard.items()}, {name: r.tick_s for name, r in heard.items()})
        for t, heard in sorted(ticks.items())
    )
    return replace(collect(rows, fleet.log.truth), egos=tuple(sorted(last)), last=last)


def traffic_of(fleet: Fleet, reports: Mapping[str, Sequence[Report]]) -> dict[str, dict[str, float | None]]:
    """Bytes a log second and bundles each robot sent, restarts together."""
    return {robot: _traffic(said, fleet) for robot, said in reports.items() if said}


def check(fleet: Fleet, reports: Mapping[str, Sequence[Report]]) -> Checks:
    """Compare what the journals hold, and what estimates come of it at one common time."""
    robots = tuple(robot for robot, said in reports.items() if said and said[-1].final)
    holdings = {robot: ranges(held(contents(fleet.journal(robot)).bundles)) for robot in robots}
    equal = len(set(holdings.values())) <= 1
    differences = [] if equal else [f"{robot} holds {data}" for robot, data in holdings.items()]
    if fleet.configuration.clock == "estimated":
        return Checks(robots, equal, None, tuple(differences), {})

    def made(ego: str, keeper: str) -> Estimate:
        journals, starts = [fleet.journal(keeper)], start_priors(fleet.starts)
        return recompute(journals, holdings[keeper], fleet.last, ego, fleet.configuration, starts)

    last = {robot: made(robot, robot) for robot in robots}
    if not equal:
        return Checks(robots, False, None, tuple(differences), last)
    for ego, keeper in pairwise([*robots, *robots[:1]]):
        own, others = peers_of(last[ego]), peers_of(made(ego, keeper))
        unlike = [peer for peer in sorted({*own, *others}) if own.get(peer) != others.get(peer)]
        differences += [f"{ego} sees {peer} otherwise out of the journal of {keeper}" for peer in unlike]
    return Checks(robots, True, not differences, tuple(differences), last)


def _reports(path: Path) -> Iterator[Report]:
    if not path.exists():
        return
    for line in path.read_bytes().splitlines():
        try:
            yield read_report(line)
        except msgspec.MsgspecError:
            continue


def _counted(fleet: Fleet, reports: Mapping[str, Sequence[Report]]) -> dict[str, list[Report]]:
    """Reports on the log's time; the last ones, made as the agents left, repeat its last tick."""
    counted = {}
    for robot, said in reports.items():
        stamps = [fleet.pace(robot).to_recording(report.stamp) for report in said]
        inside = [r for r, t in zip(said, stamps, strict=True) if fleet.first <= t <= fleet.last + 1e-9 and not r.final]
        if inside:
            counted[robot] = inside
    return counted


def _tick(report: Report, pace: Pace) -> Tick:
    stamp = pace.to_recording(report.stamp)
    return Tick(stamp, {report.robot: _estimate(report, stamp)}, {report.robot: report.tick_s})


def _estimate(report: Report, stamp: float) -> Estimate:
    return Estimate(report.robot, stamp, estimates_of(report.peers), report.rejected, _no_graph)


def _no_graph() -> OptimizedGraph:
    raise DgorlError("a report holds no graph; recompute the estimate from journals")


def _traffic(said: Sequence[Report], fleet: Fleet) -> dict[str, float | None]:
    """Counters begin anew with each start of the agent."""
    ends = [a for a, b in pairwise(said) if b.traffic.sent_messages < a.traffic.sent_messages]
    ends.append(said[-1])
    seconds = max(fleet.last - fleet.first, fleet.configuration.period)
    wire = [report.traffic.wire_bytes for report in ends]
    return {
        "payload_bytes_per_s": sum(report.traffic.sent_bytes for report in ends) / seconds,
        "wire_bytes_per_s": None if None in wire else sum(count or 0 for count in wire) / seconds,
        "bundles": sum(report.traffic.bundles for report in ends),
    }


def final_of(fleet: Fleet, checks: Checks) -> dict[str, Any]:
    """What final.json says: each robot's estimate at the last tick, of all its journal holds."""
    egos = {ego: msgspec.to_builtins(peers_of(estimate)) for ego, estimate in checks.last.items()}
    return {"stamp": fleet.last, "egos": egos}


def as_summary(checks: Checks) -> dict[str, Any]:
    """For summary.json."""
    return {"robots": list(checks.robots), "equal_data": checks.data, "equal_estimates": checks.estimates}
