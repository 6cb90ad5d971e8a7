"""figures/trajectories.png: the team's paths, and beside them the optimised graph of the last tick."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dgorl.evaluation.records import Records
from dgorl.plotting.frames import LONGEST, TeamView, decorate, team_view
from dgorl.plotting.graph import draw_graph
from dgorl.plotting.labels import write_names
from dgorl.plotting.notes import height_of, notes, write_notes
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
    lines = notes(view.ego, records.last[view.ego])
    foot, height = height_of(lines), 5.4 + height_of(lines)
    with picture(path, 11.0, height) as figure:
        figure.set_layout_engine("constrained", rect=(0, foot / height, 1, 1 - foot / height))
        write_notes(figure, lines)
        paths, graph = figure.subplots(1, 2)
        draw_paths(paths, view, colors)
        draw_graph(figure, graph, records.last[view.ego], view, colors)


def draw_paths(axes: Axes, view: TeamView, colors: dict[str, str]) -> None:
    """Truth grey and wide beneath, estimates in colour, faint while not located; a dot at the start, an arrow at the
    end, hollow where the robot is not found by then."""
    from matplotlib.lines import Line2D

    for poses in view.truth.values():
        axes.plot(poses[:, 0], poses[:, 1], color=TRUTH, lw=3.0, zorder=1)
    for robot, poses in view.estimates.items():
        sure = np.where(view.located[robot][:, None], poses, np.nan)
        axes.plot(sure[:, 0], sure[:, 1], color=colors[robot], lw=1.3, zorder=3)
        if not view.located[robot].all():
            axes.plot(poses[:, 0], poses[:, 1], color=colors[robot], lw=0.8, alpha=0.35, zorder=3)
    _draw_guesses(axes, view, colors)
    ends: dict[str, Array] = {}
    for robot in sorted({*view.estimates, *view.truth}):
        estimate, truth = view.estimates.get(robot), view.truth.get(robot)
        starts, stops = _known(truth, estimate), _known(estimate, truth)
        if not len(starts):
            continue
        found = estimate is not None and np.isfinite(estimate[-1]).all()
        end = stops[-1] if found or truth is None else _known(truth, estimate)[-1]
        face, edge = (colors[robot], "white") if found or robot == view.ego else ("white", colors[robot])
        axes.plot(*starts[0, :2], "o", ms=5, mfc="white", mec=colors[robot], mew=1.3, zorder=4)
        axes.plot(*end[:2], marker=arrowhead(end[2]), ms=11, color=face, mec=edge, zorder=5)
        ends[robot] = end[:2]
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
    if any(np.isfinite(poses).any() for poses in view.guesses.values()):
        handles.insert(1, Line2D([], [], color=GREY, marker=".", ms=4, ls="", alpha=0.6, label="best guess"))
    decorate(axes, view, "Trajectories" + (f", last {LONGEST:.0f} s" if view.t[0] > view.start else ""))
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=len(handles), columnspacing=1.2)


def _draw_guesses(axes: Axes, view: TeamView, colors: dict[str, str]) -> None:
    """The best hypothesis of each tick as a dot; they widen the picture only where nothing else is drawn."""
    limits = axes.dataLim.frozen()
    drawn = [*view.truth.values(), *(poses for robot, poses in view.estimates.items() if robot != view.ego)]
    for robot, poses in view.guesses.items():
        axes.plot(poses[:, 0], poses[:, 1], ".", ms=3, mew=0, color=colors[robot], alpha=0.4, zorder=2)
    if any(np.isfinite(poses).any() for poses in drawn):
        axes.dataLim.set(limits)


def _known(*candidates: Array | None) -> Array:
    """The finite rows of the first candidate that has any."""
    for poses in candidates:
        if poses is not None and np.isfinite(poses).all(axis=1).any():
            return np.asarray(poses[np.isfinite(poses).all(axis=1)])
    return np.empty((0, 3))
