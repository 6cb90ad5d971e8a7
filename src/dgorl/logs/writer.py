"""Writes a log as a dgorl log folder; reading it back gives the same log, to the last bit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from dgorl.errors import LogError
from dgorl.logs import folder, truth
from dgorl.logs.log import Log
from dgorl.logs.team import SECTIONS, Team, team_text, valid_name
from dgorl.logs.terrain import ALTITUDE, altitude_rows, terrain_bytes
from dgorl.logs.text import Columns
from dgorl.measurements import Bearing, Displacement, Odometry, Range, RelativePose, Rssi

FILES = ("odometry.csv", "rssi.csv", "ranges.csv", "bearings.csv", "altitude.csv", "terrain.npz", "groundtruth.csv")


def write_folder(log: Log, path: str | Path) -> None:
    """Makes the folder, or replaces the log in it.

    Raises LogError, before anything is written, for what such a folder cannot hold: relative poses, twists
    and displacements together, epochs out of order, settings other than the sensors', names with blanks.
    """
    path = Path(path)
    contents = {"team.yaml": team_text(_team(log, path))} | _tables(log, path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            (path / name).unlink(missing_ok=True)
        for name, text in contents.items():
            (path / name).write_text(text, encoding="utf-8")
        if log.terrain is not None:
            (path / "terrain.npz").write_bytes(terrain_bytes(log.terrain))
    except OSError as error:
        raise LogError(path, None, f"cannot be written: {error.strerror}") from error


def _team(log: Log, path: Path) -> Team:
    for name in log.robots:
        if not valid_name(name):
            raise LogError(path, None, f"a dgorl log cannot name a robot `{name}`; use letters, digits, `_`, `-`, dots")
    for key in log.configuration:
        if key not in SECTIONS:
            raise LogError(path, None, f"a dgorl log cannot hold the setting `{key}`; leave it to a YAML file")
    start = {robot: start.pose for robot, start in log.starts.items()}
    stamps = {robot: start.stamp for robot, start in log.starts.items()}
    team = Team(log.robots, _epochs(log), start, stamps, log.configuration)
    for m in log.measurements:
        if isinstance(m, Odometry | Displacement) and (
            team.epoch(m.robot, m.start) != m.epoch or team.carried_within(m.robot, m.start, m.end)
        ):
            raise LogError(path, None, f"epochs of {m.robot} must follow one another in time (see {m.start!r})")
    return team


def _epochs(log: Log) -> Mapping[str, tuple[float, ...]]:
    """Robot → when each of its epochs after the first begins [s]."""
    begins: dict[str, dict[int, float]] = {}
    for m in log.measurements:
        if isinstance(m, Odometry | Displacement):
            epochs = begins.setdefault(m.robot, {})
            epochs[m.epoch] = min(epochs.get(m.epoch, m.start), m.start)
    times = {
        robot: tuple(min(t for epoch, t in epochs.items() if epoch >= k) for k in range(1, max(epochs) + 1))
        for robot, epochs in begins.items()
    }
    return {robot: stamps for robot, stamps in times.items() if stamps}


def _tables(log: Log, path: Path) -> dict[str, str]:
    """File name → text of every table the log needs."""
    twists = [m for m in log.measurements if isinstance(m, Odometry)]
    displacements = [m for m in log.measurements if isinstance(m, Displacement)]
    rssi = [m for m in log.measurements if isinstance(m, Rssi)]
    ranges = [m for m in log.measurements if isinstance(m, Range)]
    bearings = [m for m in log.measurements if isinstance(m, Bearing)]
    if any(isinstance(m, RelativePose) for m in log.measurements):
        raise LogError(path, None, "a dgorl log cannot hold relative poses; leave them out")
    if twists and displacements:
        raise LogError(path, None, "a dgorl log holds either twists or displacements as odometry, not both")
    tables = {
        "odometry.csv": _table(folder.TWIST, ((m.start, m.end, m.robot, m.v, m.omega) for m in twists))
        if twists
        else _displacements(displacements),
        "rssi.csv": _table(folder.RSSI, ((m.stamp, m.transmitter, m.receiver, m.dbm) for m in rssi)),
        "ranges.csv": _ranges(ranges),
        "bearings.csv": _table(folder.BEARING, ((m.stamp, m.observer, m.target, m.bearing, m.sigma) for m in bearings)),
        "altitude.csv": _table(ALTITUDE, altitude_rows(log.altitudes)),
        "groundtruth.csv": _table(
            truth.COLUMNS, ((row[0], robot, *row[1:]) for robot, rows in log.truth.items() for row in rows)
        ),
    }
    wanted = {"odometry.csv", *(name for name, given in _given(rssi, ranges, bearings).items() if given)}
    if log.altitudes:
        wanted.add("altitude.csv")
    if any(len(rows) for rows in log.truth.values()):
        wanted.add("groundtruth.csv")
    return {name: text for name, text in tables.items() if name in wanted}


def _given(rssi: list[Rssi], ranges: list[Range], bearings: list[Bearing]) -> dict[str, bool]:
    """Which tables between robots are written; without any measurement an empty one says so."""
    nothing = not (rssi or ranges or bearings)
    return {"rssi.csv": bool(rssi), "ranges.csv": bool(ranges) or nothing, "bearings.csv": bool(bearings)}


def _displacements(steps: list[Displacement]) -> str:
    bare = all(m.covariance is None for m in steps)
    none = () if bare else (None,) * 6
    rows = ((m.start, m.end, m.robot, m.dx, m.dy, m.dtheta, *(m.covariance or none)) for m in steps)
    return _table(folder.DISPLACEMENT if bare else folder.COVARIANCE, rows)


def _ranges(ranges: list[Range]) -> str:
    bare = all(m.exchange is None for m in ranges)
    rows = ((m.stamp, m.robot, m.peer, m.range, m.sigma, *(() if bare else (m.exchange,))) for m in ranges)
    return _table(folder.RANGE if bare else folder.EXCHANGE, rows)


def _table(columns: Columns, rows: Iterable[tuple[object, ...]]) -> str:
    lines = [",".join(columns), *(",".join(_field(value) for value in row) for row in rows)]
    return "\n".join(lines) + "\n"


def _field(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return repr(float(value))
    return str(value)
