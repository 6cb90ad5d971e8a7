"""Names beside robots, where they hide least."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from dgorl.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AWAY = 13.0
"""from the robot to the middle of its name [points]"""
_SHARE = 0.06
"""about the same as a share of the picture's side"""

_SHORT = 6
"""letters; longer words begin or end beside the robot"""


def write_names(
    axes: Axes,
    places: Mapping[str, Array],
    colors: Mapping[str, str],
    obstacles: Array,
    words: Mapping[str, str] | None = None,
) -> None:
    """Write each robot's name beside its place (2,), in the emptiest of eight directions.

    obstacles: (N, 2) points of what is drawn; robots and names written before count as well. words: in place of
    the name.
    """
    from matplotlib.patheffects import withStroke

    if not places:
        return
    angles = np.arange(8) * np.pi / 4 + np.pi / 8
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    taken = np.vstack([obstacles[np.isfinite(obstacles).all(axis=1)], *places.values()])
    reach = _SHARE * (float(np.ptp(taken, axis=0).max()) or 1.0)
    for robot, place in sorted(places.items()):
        middles = place + reach * directions
        gaps = np.linalg.norm(middles[:, None] - taken[None], axis=-1).min(axis=1)
        best = int(np.argmax(gaps))
        taken = np.vstack([taken, middles[best]])
        dx, dy = _AWAY * directions[best]
        axes.annotate(
            word := (words or {}).get(robot, robot),
            (place[0], place[1]),
            (dx, dy),
            textcoords="offset points",
            ha="center" if len(word) <= _SHORT else "left" if dx > 0 else "right",
            va="center",
            color=colors[robot],
            fontweight="bold",
            zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )
