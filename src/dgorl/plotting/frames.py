"""Where a picture puts the robots: everything an ego knows, in one frame for the whole team."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dgorl.evaluation.records import Records, truth_at
from dgorl.measurements import WORLD
from dgorl.plotting.style import GREY
from dgorl.se2 import Array, compose, inverse

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class TeamView:
    """One ego's estimates in one frame at ``t`` (T,), and the truth there.

    ego_pose: T_frame_ego (T, 3). estimates, truth: robot → (T, 3), NaN where unknown. note: the frame, in
    words.
    """

    ego: str
    t: Array
    ego_pose: Array
    estimates: Mapping[str, Array]
    truth: Mapping[str, Array]
    note: str
    x_label: str = "x [m]"
    y_label: str = "y [m]"


def team_view(records: Records, ego: str) -> TeamView:
    """What ``ego`` knows: in the world if it knows that, else from its own true pose, else as it sees it."""
    t = records.stamps
    world = records.pairs.get((ego, WORLD))
    true_ego = truth_at(records.truth, ego, t)
    peers = records.of(ego)
    seen = {peer: _spread(record.t, record.pose, t) for peer, record in peers.items()}
    robots = [robot for robot in sorted({ego, *peers}) if robot in records.truth]
    truth = {robot: truth_at(records.truth, robot, t) for robot in robots}
    if world is not None and np.isfinite(world.pose).any():
        ego_pose = inverse(_spread(world.t, world.pose, t))
        estimates = {ego: ego_pose} | {peer: compose(ego_pose, pose) for peer, pose in seen.items()}
        return TeamView(ego, t, ego_pose, estimates, truth, f"estimated by {ego} in the start frame")
    if np.isfinite(true_ego).any():
        estimates = {peer: compose(true_ego, pose) for peer, pose in seen.items()}
        return TeamView(ego, t, true_ego, estimates, truth, f"peers of {ego}, placed at its true pose")
    here = np.zeros((len(t), 3))
    note = f"peers in the moving frame of {ego}"
    return TeamView(
        ego, t, here, {ego: here, **seen}, {}, note, f"forward of {ego} [m]", f"left of {ego} [m]"
    )


def decorate(axes: Axes, view: TeamView, title: str) -> None:
    """Equal scales, units, the title and which frame this is."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set(xlabel=view.x_label, ylabel=view.y_label)
    axes.set_title(title, pad=18)
    axes.annotate(view.note, (0, 1), (0, 5), "axes fraction", "offset points", fontsize=8, color=GREY)


def _spread(at: Array, pose: Array, t: Array) -> Array:
    """Rows of a record on all ticks, NaN where it has none."""
    out = np.full((len(t), 3), np.nan)
    out[np.searchsorted(t, at)] = pose
    return out
