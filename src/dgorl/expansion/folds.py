"""Starts on the other side: the team's mirror image, and bodies folded over the line of those they hear. METHOD §3, §4.

Ranges to others that stand on one line fit on both sides of it. Whoever is on the wrong one may be so together with
those behind it, and it hears enough others that no small step leads back: each fold is a start of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dgorl import se2
from dgorl.se2 import Array

if TYPE_CHECKING:
    from dgorl.expansion.drafts import Shapes

SMALL = 12
"""Up to so many bodies, three that hear one another are folded together too."""

FOLDS = 16
"""Folds tried at a time: those that the ranges speak least against."""

HEADINGS = 4
"""Headings with which a body is tried on the other side."""

CLIP = 3.0
"""A range that a fold makes wrong counts at most so much [m]: a rigid body that folds does not head exactly right."""


def mirrored(shapes: Shapes) -> Array:
    """The draft (1, m, 3) of a hypothesis' mirror image, as well as bodies that are not mirrored can make it.

    Ranges tell a team from its mirror image by the curves of its paths alone: straight paths by nothing. METHOD §3.
    """
    middle, angle = _axes(shapes)
    return _reflected(middle, angle, middle[0], float(angle[0]))[None]


def anchored(draft: Array) -> Array:
    """The same draft (m, 3) where body 0, the gauge, has not moved."""
    return se2.between(np.broadcast_to(draft[0], draft.shape), draft)


def other_side(shapes: Shapes, j: int) -> Array:
    """Places (W, 3) of body j on the other side of the line of those it hears; shapes in one common frame."""
    ends = _Ranged(shapes)
    line = ends.line(np.isin(np.arange(shapes.size), [j]))
    if line is None:
        return np.zeros((0, 3))
    middle, angle = _axes(shapes)
    there = _reflected(middle, angle, *line)[j]
    turns = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    at = se2.compose(there, np.array([*middle[j], 0.0]))
    spun = se2.compose(at, np.column_stack([np.zeros((HEADINGS, 2)), turns]))
    return se2.compose(spun, np.array([*-middle[j], 0.0]))


def folded(shapes: Shapes) -> Array:
    """Drafts (B, m, 3) of a hypothesis in which few bodies together are folded over the line of those they hear."""
    ends = _Ranged(shapes)
    middle, angle = _axes(shapes)
    found: list[tuple[float, Array]] = []
    for side in ends.sides():
        line = ends.line(side)
        if line is None:
            continue
        draft = np.where(side[:, None], _reflected(middle, angle, *line), 0.0)
        found.append((ends.misfit(draft), anchored(draft)))
    found.sort(key=lambda item: item[0])
    return np.array([draft for _, draft in found[:FOLDS]]).reshape(-1, shapes.size, 3)


class _Ranged:
    """The ranges between bodies: numbers of both (M,), points (M, 2) in the common frame, distance (M,) [m]."""

    def __init__(self, shapes: Shapes) -> None:
        ranged = [s for s in shapes.found if s.kind != "bearing"]
        self._i = np.concatenate([np.zeros(0, np.int64), *(s.i for s in ranged)])
        self._j = np.concatenate([np.zeros(0, np.int64), *(s.j for s in ranged)])
        self._at_i = np.concatenate([np.zeros((0, 3)), *(s.point_i for s in ranged)])
        self._at_j = np.concatenate([np.zeros((0, 3)), *(s.point_j for s in ranged)])
        self._distance = np.concatenate([np.zeros(0), *(s.distance for s in ranged)])
        self._linked = np.zeros((shapes.size, shapes.size), bool)
        self._linked[self._i, self._j] = self._linked[self._j, self._i] = True

    def line(self, side: NDArray[np.bool_]) -> tuple[Array, float] | None:
        """Through where those stand that ``side`` (m,) hears: a point (2,) and a direction [rad]."""
        from_i, from_j = side[self._i] & ~side[self._j], ~side[self._i] & side[self._j]
        heard = np.concatenate([self._at_j[from_i, :2], self._at_i[from_j, :2]])
        if len(heard) < 2:
            return None
        middle = heard.mean(axis=0)
        axis = np.linalg.svd(heard - middle, full_matrices=False)[2][0]
        return middle, float(np.arctan2(axis[1], axis[0]))

    def misfit(self, draft: Array) -> float:
        """Mean error of the ranges in a draft (m, 3), clipped [m]."""
        at_i = se2.compose(draft[self._i], self._at_i)[:, :2]
        at_j = se2.compose(draft[self._j], self._at_j)[:, :2]
        off = np.abs(np.hypot(*(at_i - at_j).T) - self._distance)
        return float(np.minimum(off, CLIP).mean())

    def sides(self) -> Iterator[NDArray[np.bool_]]:
        """Who may be folded together (m,): up to three bodies that hear one another, what two others cut off."""
        size = len(self._linked)
        known: set[tuple[int, ...]] = set()
        for few in range(1, 4 if size <= SMALL else 3):
            parts = [list(part) for part in combinations(range(size), few) if self._one(part)]
            if few == 2:
                parts += [part for cut in combinations(range(size), 2) for part in self._apart(cut)]
            for part in map(tuple, parts):
                if part in known or 2 * len(part) > size:
                    continue
                known.add(part)
                side = np.zeros(size, bool)
                side[list(part)] = True
                yield side

    def _one(self, part: tuple[int, ...]) -> bool:
        """Whether links hold up to three bodies together."""
        return bool(self._linked[np.ix_(part, part)].sum() >= 2 * (len(part) - 1))

    def _apart(self, cut: tuple[int, ...]) -> list[list[int]]:
        """Into which sets of bodies the links fall without some bodies; none if they hold together."""
        left = set(range(len(self._linked))) - set(cut)
        parts = []
        while left:
            part, reach = set(), {min(left)}
            while reach:
                part |= reach
                reach = {int(b) for b in np.flatnonzero(self._linked[sorted(reach)].any(axis=0))} & left - part
            left -= part
            parts.append(sorted(part))
        return parts if len(parts) > 1 else []


def _axes(shapes: Shapes) -> tuple[Array, Array]:
    """Middle (m, 2) of every body and the direction of its longest axis (m,), the way it heads."""
    middle, angle = np.zeros((shapes.size, 2)), np.zeros(shapes.size)
    for b in range(shapes.size):
        path = shapes.poses[shapes.cluster.body == b]
        middle[b] = path[:, :2].mean(axis=0)
        axis = np.linalg.svd(path[:, :2] - middle[b], full_matrices=False)[2][0]
        heading = np.array([np.cos(path[:, 2]).mean(), np.sin(path[:, 2]).mean()])
        angle[b] = np.arctan2(axis[1], axis[0]) + (np.pi if axis @ heading < 0 else 0.0)
    return middle, angle


def _reflected(middle: Array, angle: Array, origin: Array, direction: float) -> Array:
    """Where bodies (m, 3) go whose middles and axes are reflected in the line through ``origin``."""
    turn = se2.rotation(np.array(direction))
    image = (middle - origin) @ turn * np.array([1.0, -1.0]) @ turn.T + origin
    theta = se2.wrap(2 * (direction - angle))
    moved = image - np.einsum("bij,bj->bi", se2.rotation(theta), middle)
    return np.column_stack([moved, theta])
