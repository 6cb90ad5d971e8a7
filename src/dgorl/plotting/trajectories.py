"""figures/trajectories.png: the team's paths, and beside them the optimised graph of the last tick."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dgorl.evaluation.records import Records
from dgorl.plotting.frames import LONGEST, TeamView, decorate, team_view
from dgorl.plotting.graph import draw_graph
from dgorl.plotting.labels import write_names
from dgorl.plotting.style import GREY, TRUTH, arrowhead, colors_of, picture
from dgorl.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELLED = 12
"""larger teams get no names along the paths, only in the graph"""


def plot_trajectories(records: Records, path: Path) -> None:
    """Draw the first ego's view of the team; nothing is drawn for a replay without ticks."""
    if not records.egos:
        return
    view = team_view(records, records.egos[0])
    colors = colors_of(sorted({*view.estimates, *view.truth}))
    with picture(path, 11.0, 5.4) as figure:
        figure.set_layout_engine("constrained")
        paths, graph = figure.subplots(1, 2)
        draw_paths(paths, view, colors)
        draw_graph(figure, graph, records.last[view.ego], view, colors)


def draw_paths(axes: Axes, view: TeamView, colors: dict[str, str]) -> None:
    """Truth grey and wide beneath, estimates in colour; a dot at the start, an arrow at the end."""
    from matplotlib.lines import Line2D

    for poses in view.truth.values():
        axes.plot(poses[:, 0], poses[:, 1], color=TRUTH, lw=3.0, zorder=1)
    for robot, poses in view.estimates.items():
        axes.plot(poses[:, 0], poses[:, 1], color=colors[robot], lw=1.3, zorder=3)
    ends: dict[str, Array] = {}
    for robot in sorted({*view.estimates, *view.truth}):
        known = _known(view.estimates.get(robot), view.truth.get(robot))
        if not len(known):
            continue
        axes.plot(*known[0, :2], "o", ms=5, mfc="white", mec=colors[robot], mew=1.3, zorder=4)
        axes.plot(*known[-1, :2], marker=arrowhead(known[-1, 2]), ms=11, color=colors[robot], mec="white", zorder=5)
        ends[robot] = known[-1, :2]
    if len(ends) <= LABELLED:
        drawn = [*view.estimates.values(), *view.truth.values()]
        write_names(axes, ends, colors, np.vstack(drawn)[:, :2])
    handles = [
        Line2D([], [], color=GREY, lw=1.3, label="estimate (robot's colour)"),
        Line2D([], [], color=GREY, marker="o", mfc="white", ls="", ms=5, label="start"),
        Line2D([], [], color=GREY, marker=arrowhead(np.pi / 2), ls="", ms=9, label="end"),
    ]
    if view.truth:
        handles.insert(1, Line2D([], [], color=TRUTH, lw=3.0, label="truth"))
    decorate(axes, view, "Trajectories" + (f", last {LONGEST:.0f} s" if view.t[0] > view.start else ""))
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4, columnspacing=1.4)


def _known(*candidates: Array | None) -> Array:
    """The finite rows of the first candidate that has any."""
    for poses in candidates:
        if poses is not None and np.isfinite(poses).all(axis=1).any():
            return np.asarray(poses[np.isfinite(poses).all(axis=1)])
    return np.empty((0, 3))
