"""dgorl logs: a folder with team.yaml and odometry, readings and groundtruth as CSV files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

from dgorl.errors import LogError
from dgorl.logs.log import Log, Start, in_order
from dgorl.logs.team import Team, read_team
from dgorl.logs.terrain import read_altitudes, read_terrain
from dgorl.logs.text import Columns, Forward, Row, csv_rows, held_twist
from dgorl.logs.truth import first_odometry, read_truth, starts_from
from dgorl.measurements import Bearing, Covariance, Displacement, Measurement, Odometry, Range, Rssi

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
    measurements: list[Measurement] = list(_odometry(path / "odometry.csv", team, skipped))
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
            measurements.append(measured(row, team))
    truth = read_truth(path / "groundtruth.csv", team.robots) if (path / "groundtruth.csv").exists() else {}
    first = first_odometry(measurements)
    starts = starts_from(truth, first) if team.start is None else _starts(path, team, first)
    return Log(
        path, team.robots, in_order(measurements), truth, starts, dict(team.configuration), dict(skipped),
        altitudes=read_altitudes(path / "altitude.csv", team.robots) if (path / "altitude.csv").exists() else (),
        terrain=read_terrain(path / "terrain.npz") if (path / "terrain.npz").exists() else None,
    )  # fmt: skip


def _odometry(path: Path, team: Team, skipped: Counter[str]) -> Iterator[Odometry | Displacement]:
    """Odometry in any of its forms, with epochs; what spans a time the robot was carried is left out."""
    form, rows = csv_rows(path, [[HELD], [TWIST], [DISPLACEMENT, COVARIANCE]])
    steps = (_held, _twists, _displacements)[form](rows, team)
    for step in steps:
        if team.carried_within(step.robot, step.start, step.end):
            skipped["odometry while the robot was carried"] += 1
        else:
            yield step


def _held(rows: Iterator[Row], team: Team) -> Iterator[Odometry]:
    """Each twist from its row to the robot's next; the last row only ends the one before."""
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
        yield row.make(Displacement, robot, start, end, dx, dy, dtheta, covariance, team.epoch(robot, start))


def _intervals(rows: Iterator[Row], team: Team) -> Iterator[tuple[Row, str, float, float]]:
    ends: dict[str, float] = {}
    for row in rows:
        start, end, robot = row.number(0), row.number(1), row.robot(2, team.robots)
        if start < ends.get(robot, start):
            raise row.error(
                f"time runs backwards for {robot}: starts at {start!r}, before the last end {ends[robot]!r}"
            )
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
