"""Two clocks and the straight line between them, from messages whose delays are unknown. METHOD §1, "Clocks".

A message sent at x on clock a and received at y on clock b says that b showed at most y when a showed x; one the other
way, sent at y and received at x, that b showed at least y. The line of b over a runs below the former and above the
latter, whatever the delays: symmetric or not, queued or not. All lines that do form a polygon of (offset, drift); its
centroid and second moments are the estimate and its covariance, as for a line anywhere in it with equal chance. Where
the polygon is empty, no one line fits: a clock jumped, and only the readings since then are used.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from itertools import pairwise
from math import inf
from typing import NamedTuple

from dgorl.measurements import ClockKey, ClockReading

DRIFT = 5e-4
"""No two clocks drift apart faster [s/s]: what NTP allows."""

WANDER = 1e-6
"""Drifts change: what was read τ ago binds by this times τ less [s/s]."""

RESOLUTION = 5e-5
"""Stamps are at best this exact [s]."""

Point = tuple[float, float]


class Line(NamedTuple):
    """y = x + offset + drift · x, stamps x and y from the two origins; covariance of (offset, drift): oo, od, dd.

    since: the x from which on it holds, where a clock jumped.
    """

    offset: float
    drift: float
    covariance: tuple[float, float, float]
    since: float = -inf


class Pair:
    """The readings between clocks a < b: ``there`` was sent by a, ``back`` by b; (stamp on a, stamp on b), sorted."""

    def __init__(self) -> None:
        self.there: list[Point] = []
        self.back: list[Point] = []

    def add(self, point: Point, sent_by_a: bool) -> bool:
        """Take a reading; False if it is known."""
        points = self.there if sent_by_a else self.back
        k = bisect.bisect_left(points, point)
        if k < len(points) and points[k] == point:
            return False
        points.insert(k, point)
        return True

    def forget(self, before: float, axis: int) -> None:
        """Drop what is stamped before ``before`` on clock a (axis 0) or b (axis 1) [s]."""
        for points in (self.there, self.back):
            points[:] = [point for point in points if point[axis] >= before]

    def next(self, after: float, axis: int) -> float:
        """The first stamp after ``after`` on clock a (axis 0) or b (axis 1) [s], infinity if there is none."""
        if axis == 0:
            firsts = [points[k : k + 1] for points in (self.there, self.back) for k in [_first(points, after)]]
            return min((p[0] for some in firsts for p in some), default=inf)
        return min((p[1] for points in (self.there, self.back) for p in points if p[1] > after), default=inf)

    def between(self, low: float, high: float, high_b: float) -> tuple[list[Point], list[Point]]:
        """Readings later than ``low`` on a, and not than both ``high`` on a and ``high_b`` on b, there and back.

        Of two clocks one may have jumped ahead, or slept: its stamps then say no more when that was.
        """
        there, back = (
            [p for p in points[_first(points, low) :] if p[0] <= high or p[1] <= high_b]
            for points in (self.there, self.back)
        )
        return there, back


def _first(points: Sequence[Point], after: float) -> int:
    """Index of the first point stamped after ``after`` on clock a."""
    return bisect.bisect_right(points, (after, inf))


def pair_point(reading: ClockReading) -> tuple[ClockKey, ClockKey, Point, bool]:
    """Clocks a < b of a reading, its stamps on them, and whether a sent it."""
    receiver, sender = (reading.robot, reading.epoch), (reading.peer, reading.peer_epoch)
    if sender < receiver:
        return sender, receiver, (reading.sent, reading.received), True
    return receiver, sender, (reading.received, reading.sent), False


def fitted(there: Sequence[Point], back: Sequence[Point], a: float, b: float) -> Line | None:
    """The line of clock b over clock a, from origins ``a`` and ``b`` [s]; None without readings both ways."""
    upper = [(x - a, (y - b) - (x - a)) for x, y in there]
    lower = [(x - a, (y - b) - (x - a)) for x, y in back]
    if not upper or not lower:
        return None
    polygon = _polygon(upper, lower)
    if polygon:
        return _moments(polygon)
    starts = sorted({x for x, _ in upper} | {x for x, _ in lower})
    first, last = 0, len(starts) - 1  # not feasible from the first on; of one reading it is
    while last - first > 1:
        middle = (first + last) // 2
        if _polygon(*_since(starts[middle], upper, lower)):
            last = middle
        else:
            first = middle
    upper, lower = _since(starts[last], upper, lower)
    polygon = _polygon(upper, lower)
    return _moments(polygon)._replace(since=starts[last]) if polygon and upper and lower else None


def _since(start: float, *lists: list[Point]) -> tuple[list[Point], ...]:
    return tuple(points[bisect.bisect_left(points, (start, -inf)) :] for points in lists)


def _polygon(upper: Sequence[Point], lower: Sequence[Point]) -> list[Point]:
    """Corners (offset, drift) of the lines below ``upper`` and above ``lower``; empty if there are none."""
    below = [(t, d + RESOLUTION + WANDER * abs(t)) for t, d in upper]
    above = [(t, -d + RESOLUTION + WANDER * abs(t)) for t, d in lower]
    most = min((d + DRIFT * abs(t) for t, d in below), default=1.0)
    least = -min((d + DRIFT * abs(t) for t, d in above), default=1.0)
    if most <= least:
        return []
    polygon = [(least, -DRIFT), (most, -DRIFT), (most, DRIFT), (least, DRIFT)]
    for sign, points in ((1.0, below), (-1.0, above)):
        for t, d in _hull(points):
            polygon = _cut(polygon, sign, t, d)
    return polygon


def _hull(points: Sequence[Point]) -> list[Point]:
    """The lower convex hull of points sorted by abscissa: no other point bounds a line from above."""
    hull: list[Point] = []
    for t, d in points:
        while len(hull) > 1:
            (t0, d0), (t1, d1) = hull[-2:]
            if (d1 - d0) * (t - t0) < (d - d0) * (t1 - t0):
                break
            hull.pop()
        if hull and hull[-1][0] == t:
            if hull[-1][1] <= d:
                continue
            hull.pop()
        hull.append((t, d))
    return hull


def _cut(polygon: list[Point], sign: float, t: float, d: float) -> list[Point]:
    """The part of a convex polygon where sign · (offset + drift · t) ≤ d."""
    excess = [sign * (offset + drift * t) - d for offset, drift in polygon]
    if all(e <= 0 for e in excess):
        return polygon
    kept: list[Point] = []
    for (e, p), (f, q) in pairwise([*zip(excess, polygon, strict=True), (excess[0], polygon[0])] if polygon else []):
        if e <= 0:
            kept.append(p)
        if (e < 0 < f) or (f < 0 < e):
            s = e / (e - f)
            kept.append((p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1])))
    return kept if len(kept) > 2 else []


def _moments(polygon: list[Point]) -> Line:
    """Centroid and covariance of a convex polygon, never better than stamps and drifts are."""
    o, r = polygon[0]
    area = x = y = xx = xy = yy = 0.0
    for (x1, y1), (x2, y2) in pairwise([(p - o, q - r) for p, q in polygon[1:]]):  # triangles with the first corner
        cross = x1 * y2 - x2 * y1
        area += cross
        x += cross * (x1 + x2) / 3
        y += cross * (y1 + y2) / 3
        xx += cross * (x1 * x1 + x1 * x2 + x2 * x2) / 6
        yy += cross * (y1 * y1 + y1 * y2 + y2 * y2) / 6
        xy += cross * (2 * x1 * y1 + x1 * y2 + x2 * y1 + 2 * x2 * y2) / 12
    if area > 0:
        x, y, xx, xy, yy = x / area, y / area, xx / area, xy / area, yy / area
    else:
        x, y = (sum(values) / len(polygon) for values in zip(*[(p - o, q - r) for p, q in polygon], strict=True))
        xx, xy, yy = x * x, x * y, y * y
    oo, od, dd = max(xx - x * x, 0.0), xy - x * y, max(yy - y * y, 0.0)
    return Line(o + x, r + y, (oo + RESOLUTION**2, od, dd + WANDER**2))
