"""dgorl logs: a folder with team.yaml and odometry, readings and groundtruth as CSV files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

from dgorl.errors import LogError
from dgorl.logs.log import Log, Start, in_order
from dgorl.logs.stamps import Stamps, odometry_span, within
from dgorl.logs.team import Team, read_team
from dgorl.logs.terrain import read_altitudes, read_terrain
from dgorl.logs.text import Columns, Forward, Row, csv_rows, held_twist, rounding
from dgorl.logs.truth import first_odometry, read_truth, starts_from
from dgorl.measurements import (
    Bearing,
    Covariance,
    Displacement,
    Measurement,
    Odometry,
    Range,
    Rssi,
    check_covariance,
)
from dgorl.terrain import Altitude

MILLISECONDS, SHARE = 1.5e-3, 0.1
"""Overlaps of rows up to this [s], and this share of a row, come from stamps in whole milliseconds."""

HELD: Columns = ("t", "robot", "v", "omega")
TWIST: Columns = ("start", "end", "robot", "v", "omega")
DISPLACEMENT: Columns = ("start", "end", "robot", "dx", "dy", "dtheta")
COVARIANCE: Columns = (*DISPLACEMENT, "cxx", "cxy", "cxt", "cyy", "cyt", "ctt")
RSSI: Columns = ("t", "from", "to", "rssi")
RANGE: Columns = ("t", "from", "to", "range", "sigma")
EXCHANGE: Columns = (*RANGE, "exchange")
BEARING: Columns = ("t", "from", "to", "bearing", "sigma")


def read_folder(path: Path) -> Log:
    """A dgorl log. Raises LogError naming file and line."""
    team = read_team(path / "team.yaml")
    skipped: Counter[str] = Counter()
    stamps, rows = Stamps(), Counter[str]()
    measurements: list[Measurement] = list(_odometry(path / "odometry.csv", team, skipped, stamps, rows))
    if not measurements:
        raise LogError(path / "odometry.csv", None, "holds no odometry: nothing tells how the robots move")
    between: dict[str, tuple[list[Columns], Callable[[Row, Team], Measurement]]] = {
        "rssi.csv": ([RSSI], _rssi),
        "ranges.csv": ([RANGE, EXCHANGE], _range),
        "bearings.csv": ([BEARING], _bearing),
    }
    files = {name: how for name, how in between.items() if (path / name).exists()}
    if not files:
        raise LogError(path, None, f"needs one of {', '.join(between)}: nothing tells where the peers are")
    for name, (family, measured) in files.items():
        forward = Forward()
        for row in csv_rows(path / name, [family])[1]:
            forward.check(row, row.number(0))
            stamps.take(row, row.number(0), name.removesuffix(".csv"))
            measurements.append(measured(row, team))
    altitudes: tuple[Altitude, ...] = ()
    if (path / "altitude.csv").exists():
        altitudes = read_altitudes(path / "altitude.csv", team.robots, stamps)
    stamps.check()
    span = odometry_span(measurements)
    _check_team(path / "team.yaml", team, span)
    truth = read_truth(path / "groundtruth.csv", team.robots, span) if (path / "groundtruth.csv").exists() else {}
    first = first_odometry(measurements)
    starts = starts_from(truth, first) if team.start is None else _starts(path, team, first)
    return Log(
        path, team.robots, in_order(measurements), truth, starts, dict(team.configuration), dict(skipped),
        altitudes=altitudes, rows=dict(rows),
        terrain=read_terrain(path / "terrain.npz") if (path / "terrain.npz").exists() else None,
    )  # fmt: skip


def _check_team(path: Path, team: Team, span: tuple[float, float]) -> None:
    """Raises LogError for times in team.yaml that are on another clock than the odometry."""
    times = [("start_stamp", robot, stamp) for robot, stamp in team.start_stamp.items()]
    times += [("epochs", robot, stamp) for robot, stamps in team.epochs.items() for stamp in stamps]
    for key, robot, stamp in times:
        within(path, team.lines.get(f"{key}.{robot}", team.lines.get(key)), f"`{key}.{robot}`", stamp, span)


def _odometry(
    path: Path, team: Team, skipped: Counter[str], stamps: Stamps, counts: Counter[str]
) -> Iterator[Odometry | Displacement]:
    """Odometry in any of its forms, with epochs; what spans a time the robot was carried is left out."""
    form, rows = csv_rows(path, [[HELD], [TWIST], [DISPLACEMENT, COVARIANCE]])
    rows = _noted(rows, team, stamps, counts, "t" if form == 0 else "start")
    steps = (_held, _twists, _displacements)[form](rows, team)
    for step in steps:
        if team.carried_within(step.robot, step.start, step.end):
            skipped["odometry while the robot was carried"] += 1
        else:
            yield step


def _noted(rows: Iterator[Row], team: Team, stamps: Stamps, counts: Counter[str], column: str) -> Iterator[Row]:
    """The rows, their stamps noted and counted by robot."""
    who = 1 if column == "t" else 2
    for row in rows:
        stamps.take(row, row.number(0), "odometry", column)
        counts[row.robot(who, team.robots)] += 1
        yield row


def _held(rows: Iterator[Row], team: Team) -> Iterator[Odometry]:
    """Each twist from its row to the robot's next, for ``HOLD`` at most; the last row only ends the one before."""
    forward = Forward(strictly=True)
    held: dict[str, tuple[float, float, float]] = {}
    for row in rows:
        stamp, robot = row.number(0), row.robot(1, team.robots)
        forward.check(row, stamp, robot)
        if robot in held:
            start, v, omega = held[robot]
            yield from held_twist(row, robot, start, stamp, v, omega, partial(team.epoch, robot))
        held[robot] = (stamp, row.number(2), row.number(3))


def _twists(rows: Iterator[Row], team: Team) -> Iterator[Odometry]:
    for row, robot, start, end in _intervals(rows, team):
        yield row.make(Odometry, robot, start, end, row.number(3), row.number(4), team.epoch(robot, start))


def _displacements(rows: Iterator[Row], team: Team) -> Iterator[Displacement]:
    for row, robot, start, end in _intervals(rows, team):
        dx, dy, dtheta = row.numbers(3, 6)
        covariance: Covariance | None = None
        if any(row.given(index) for index in range(6, 12)):
            xx, xy, xt, yy, yt, tt = row.numbers(6, 12)
            covariance = (xx, xy, xt, yy, yt, tt)
            row.make(check_covariance, covariance, advice="; leave the six empty if it is unknown")
        yield row.make(Displacement, robot, start, end, dx, dy, dtheta, covariance, team.epoch(robot, start))


def _intervals(rows: Iterator[Row], team: Team) -> Iterator[tuple[Row, str, float, float]]:
    ends: dict[str, float] = {}
    for row in rows:
        start, end, robot = row.number(0), row.number(1), row.robot(2, team.robots)
        last = ends.get(robot, start)
        if start < last - max(rounding(last), min(MILLISECONDS, SHARE * (end - last))):
            raise row.error(f"time runs backwards for {robot}: starts at {start!r}, before the last end {last!r}")
        if end > last > start + rounding(last):
            start = last  # what the row says is of all of it: nothing is cut off
        ends[robot] = end
        yield row, robot, start, end


def _rssi(row: Row, team: Team) -> Rssi:
    return row.make(Rssi, row.robot(1, team.robots), row.robot(2, team.robots), row.number(0), row.number(3))


def _range(row: Row, team: Team) -> Range:
    robot, peer = row.robot(1, team.robots), row.robot(2, team.robots)
    exchange = row.whole(5) if row.given(5) else None
    return row.make(Range, robot, peer, row.number(0), row.number(3), row.optional(4), exchange)


def _bearing(row: Row, team: Team) -> Bearing:
    observer, target = row.robot(1, team.robots), row.robot(2, team.robots)
    return row.make(Bearing, observer, target, row.number(0), row.number(3), row.optional(4))


def _starts(path: Path, team: Team, first: Mapping[str, float]) -> dict[str, Start]:
    """Start poses of team.yaml; without a stamp they are where the robot's odometry begins."""
    starts = {}
    for robot, pose in (team.start or {}).items():
        stamp = team.start_stamp.get(robot, first.get(robot))
        if stamp is None:
            raise LogError(path / "team.yaml", None, f"`start.{robot}` needs a `start_stamp`: {robot} has no odometry")
        starts[robot] = Start(stamp, pose)
    return starts
