"""PyFG files: letters are robots (A100 is a pose of robot "A"), a landmark is a robot that never moves.

VERTEX_* poses are ground truth. EDGE_SE2 between consecutive vertices is odometry, its covariance in the
tangent at the end pose; EDGE_RANGE holds a variance. In files made from recordings a vertex carries the
stamp of the motion capture, the edge that ends at it that of the odometry; they differ by up to 0.25 s, and
vertices may share a stamp. So odometry is timed by its own stamps.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, cos, sin, sqrt
from pathlib import Path

import numpy as np

from dgorl.configuration import nearest
from dgorl.errors import LogError, brief, quoted
from dgorl.logs.log import Log, in_order
from dgorl.logs.stamps import Stamps
from dgorl.logs.text import Columns, Forward, Row, text_of
from dgorl.logs.truth import first_odometry, rising, starts_from
from dgorl.measurements import LONGEST, Covariance, Displacement, Measurement, Range
from dgorl.se2 import Array

STANDING_PERIOD = 0.5
"""A landmark reports this often that it has not moved [s]."""
STANDING_SIGMA = 2e-4
"""... give or take this much a report [m, m, rad]: 7 mm over ten minutes."""

_RECORDS: Mapping[str, Columns] = {
    "VERTEX_SE2": ("type", "t", "pose", "x", "y", "theta"),
    "VERTEX_XY": ("type", "landmark", "x", "y"),
    "EDGE_SE2": ("type", "t", "from", "to", "dx", "dy", "dtheta", "xx", "xy", "xt", "yy", "yt", "tt"),
    "EDGE_SE2_XY": ("type", "t", "from", "landmark", "dx", "dy", "xx", "xy", "yy"),
    "EDGE_RANGE": ("type", "t", "from", "to", "range", "variance"),
}


@dataclass(frozen=True)
class _Vertex:
    stamp: float
    pose: tuple[float, float, float]


@dataclass
class _Robot:
    """One robot's vertices by name, in the order of time, and the odometry edges that end at them."""

    vertices: dict[str, _Vertex]
    edges: dict[str, Row]


def read_pyfg(path: Path) -> Log:
    """A planar factor graph in PyFG's text format. Raises LogError."""
    rows = list(_rows(path))
    _check_stamps(rows)
    robots, landmarks = _members(rows)
    stamps = [row.number(1) for row in rows if row.fields[0] != "VERTEX_XY"]
    skipped: Counter[str] = Counter()
    measurements: list[Measurement] = []
    truth: dict[str, Array] = {}
    for robot, chain in robots.items():
        measurements += _odometry(robot, chain, skipped)
        truth[robot] = rising([(vertex.stamp, *vertex.pose) for vertex in chain.vertices.values()])
        skipped["ground truth of a repeated stamp"] += len(chain.vertices) - len(truth[robot])
    if not measurements:
        raise LogError(path, None, "holds no odometry: EDGE_SE2 between consecutive vertices of a robot")
    skipped["EDGE_SE2_XY: where a landmark was seen"] = sum(row.fields[0] == "EDGE_SE2_XY" for row in rows)
    ranged = {symbol for row in rows if row.fields[0] == "EDGE_RANGE" for symbol in row.fields[2:4]}
    seen = {row.fields[3] for row in rows if row.fields[0] == "EDGE_SE2_XY"}
    names = _landmark_names(path, robots, {k: place for k, place in landmarks.items() if k in ranged or k not in seen})
    for symbol, name in names.items():
        standing = _standing(min(stamps), max(stamps))
        measurements += [Displacement(name, a, b, 0.0, 0.0, 0.0, _STILL) for a, b in standing]
        x, y = landmarks[symbol]
        truth[name] = np.array([[t, x, y, 0.0] for t in [standing[0][0], *(b for _, b in standing)]])
    measurements += _ranges(rows, robots, names)
    team = tuple(sorted([*robots, *names.values()]))
    starts = starts_from(truth, first_odometry(measurements))
    return Log(path, team, in_order(measurements), truth, starts, {}, dict(+skipped))


_STILL: Covariance = (STANDING_SIGMA**2, 0.0, 0.0, STANDING_SIGMA**2, 0.0, STANDING_SIGMA**2)


def _check_stamps(rows: Sequence[Row]) -> None:
    """Raises LogError for what is stamped on another clock than the rest."""
    stamps = Stamps()
    for kind in ("EDGE_SE2", "EDGE_RANGE", "VERTEX_SE2"):
        for row in rows:
            if row.fields[0] == kind:
                stamps.take(row, row.number(1), "odometry")
    stamps.check()


def _rows(path: Path) -> Iterator[Row]:
    for number, line in enumerate(text_of(path).split("\n"), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        kind = fields[0]
        if kind not in _RECORDS:
            known = ", ".join(_RECORDS)
            raise LogError(path, number, f"cannot use {brief(kind)}{nearest(kind, _RECORDS)}; known are {known}")
        columns = _RECORDS[kind]
        if len(fields) != len(columns):
            missing = f" ({columns[len(fields)]} missing)" if len(fields) < len(columns) else ""
            raise LogError(path, number, f"{kind} needs {len(columns)} columns, got {len(fields)}{missing}")
        yield Row(path, number, columns, fields)


def _letters(row: Row, index: int) -> str:
    match = re.fullmatch(r"([A-Za-z]+)\d+", row.fields[index])
    if match is None:
        raise row.error(
            f"`{row.columns[index]}` must be letters and a number like A12, got {quoted(row.fields[index])}"
        )
    return match[1]


def _members(rows: Sequence[Row]) -> tuple[dict[str, _Robot], dict[str, tuple[float, float]]]:
    """Robots with their chains, and landmarks with their positions [m]."""
    robots: dict[str, _Robot] = {}
    landmarks: dict[str, tuple[float, float]] = {}
    forward = Forward()
    for row in rows:
        if row.fields[0] == "VERTEX_SE2":
            robot, symbol, stamp = _letters(row, 2), row.fields[2], row.number(1)
            forward.check(row, stamp, robot)
            chain = robots.setdefault(robot, _Robot({}, {}))
            if symbol in chain.vertices:
                raise row.error(f"vertex {brief(symbol)} stands here twice")
            chain.vertices[symbol] = _Vertex(stamp, (row.number(3), row.number(4), row.number(5)))
        elif row.fields[0] == "VERTEX_XY":
            _letters(row, 1)
            if row.fields[1] in landmarks:
                raise row.error(f"landmark {brief(row.fields[1])} stands here twice")
            landmarks[row.fields[1]] = (row.number(2), row.number(3))
    follows = {b: a for chain in robots.values() for a, b in pairwise(chain.vertices)}
    for row in rows:
        if row.fields[0] == "EDGE_SE2":
            a, b = row.fields[2:4]
            robot = _letters(row, 3)
            if follows.get(b) != a:
                raise row.error(
                    f"{brief(a)} to {brief(b)}: an edge must join a vertex to the robot's next one (odometry)"
                )
            if b in robots[robot].edges:
                raise row.error(f"odometry from {brief(a)} to {brief(b)} stands here twice")
            robots[robot].edges[b] = row
    return robots, landmarks


def _odometry(robot: str, chain: _Robot, skipped: Counter[str]) -> Iterator[Displacement]:
    """The edges between a robot's vertices; one over more time than odometry may tell of at once is a gap."""
    times = _times(chain)
    last = -float("inf")
    for before, symbol in pairwise(chain.vertices):
        if (row := chain.edges.get(symbol)) is not None:
            start, end = max(times[before], last), times[symbol]
            dx, dy, dtheta = row.numbers(4, 7)
            if end - start > LONGEST:
                skipped[f"odometry over more than {LONGEST:g} s at once: a gap"] += 1
                last = end
                continue
            covariance = _at_start(dtheta, row.numbers(7, 13))
            yield row.make(Displacement, robot, start, end, dx, dy, dtheta, covariance)
            last = end


def _times(chain: _Robot) -> dict[str, float]:
    """When the robot was at each vertex by its own odometry [s].

    That is the stamp of the edge that ends there, where edges are stamped so; else the vertex's own.
    """
    own = {symbol: vertex.stamp for symbol, vertex in chain.vertices.items()}
    before = {b: a for a, b in pairwise(own)}
    stamps = {symbol: row.number(1) for symbol, row in chain.edges.items()}
    nearer = [abs(stamp - own[b]) <= abs(stamp - own[before[b]]) for b, stamp in stamps.items()]
    if sum(nearer) >= len(nearer) / 2:
        own |= stamps
    return own


def _at_start(dtheta: float, upper: Sequence[float]) -> Covariance:
    """A covariance in the tangent at the end pose, turned into the frame at the start: R Σ Rᵀ."""
    xx, xy, xt, yy, yt, tt = upper
    c, s = cos(dtheta), sin(dtheta)
    return (
        c * c * xx - 2 * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        c * xt - s * yt,
        s * s * xx + 2 * c * s * xy + c * c * yy,
        s * xt + c * yt,
        tt,
    )


def _landmark_names(path: Path, robots: Mapping[str, _Robot], landmarks: Mapping[str, object]) -> dict[str, str]:
    """Landmark → robot's name: its letters, or all of its symbol where several share the letters."""
    letters = {symbol: symbol.rstrip("0123456789") for symbol in landmarks}
    count = Counter(letters.values())
    names = {symbol: short if count[short] == 1 else symbol for symbol, short in letters.items()}
    for symbol, name in names.items():
        if name in robots:
            raise LogError(
                path, None, f"landmark {brief(symbol)} and robot {brief(name)} share a letter; rename one of them"
            )
    return names


def _standing(first: float, last: float) -> list[tuple[float, float]]:
    """Intervals of STANDING_PERIOD that cover [first, last]."""
    steps = max(ceil((last - first) / STANDING_PERIOD), 1)
    grid = [first + STANDING_PERIOD * k for k in range(steps + 1)]
    return list(pairwise(grid))


def _ranges(rows: Sequence[Row], robots: Mapping[str, _Robot], names: Mapping[str, str]) -> Iterator[Range]:
    members = {symbol: robot for robot, chain in robots.items() for symbol in chain.vertices} | dict(names)
    forward = Forward()
    for row in rows:
        if row.fields[0] != "EDGE_RANGE":
            continue
        for symbol in row.fields[2:4]:
            if symbol not in members:
                raise row.error(f"no vertex is called {brief(symbol)}; add it or leave the range out")
        a, b = (members[symbol] for symbol in row.fields[2:4])
        stamp, distance, variance = row.number(1), row.number(4), row.number(5)
        forward.check(row, stamp, f"{a} and {b}")
        if variance <= 0:
            raise row.error(f"`variance` must be positive, got {variance}")
        yield row.make(Range, a, b, stamp, distance, sqrt(variance))
