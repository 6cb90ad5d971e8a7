"""Where a picture puts the robots: everything an ego knows, in one frame for the whole team."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dgorl.estimate import Status
from dgorl.evaluation.records import Records, truth_at
from dgorl.measurements import WORLD
from dgorl.plotting.style import GREY
from dgorl.se2 import Array, compose, inverse

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LONGEST = 120.0
"""more of a path than this is a tangle [s]"""


@dataclass(frozen=True)
class TeamView:
    """One ego's estimates in one frame at ``t`` (T,), and the truth there.

    ego_pose: T_frame_ego (T, 3). estimates, truth: robot → (T, 3), NaN where unknown. located: robot → (T,) bool.
    guesses: robot → (T, 3), the best hypothesis while it is ambiguous, which ``estimates`` leave out. note: the
    frame, in words. labels: of the axes. start: stamp of the replay's first tick [s].
    """

    ego: str
    t: Array
    ego_pose: Array
    estimates: Mapping[str, Array]
    located: Mapping[str, NDArray[np.bool_]]
    guesses: Mapping[str, Array]
    truth: Mapping[str, Array]
    note: str
    labels: tuple[str, str]
    start: float


def team_view(records: Records, ego: str) -> TeamView:
    """What ``ego`` knows: in the world if it knows that, else from its own true pose, else as it sees it.

    Of a long replay the last ``LONGEST`` seconds.
    """
    stamps = records.stamps
    late = stamps >= stamps[-1] - LONGEST
    t = stamps[late]
    peers = records.of(ego)
    robots = [robot for robot in sorted({ego, *peers}) if robot in records.truth]
    truth = {robot: truth_at(records.truth, robot, t) for robot in robots}
    unsure = {peer: record.having(Status.AMBIGUOUS)[late] for peer, record in peers.items()}
    seen = {peer: np.where(unsure[peer][:, None], np.nan, record.pose[late]) for peer, record in peers.items()}
    guessed = {peer: np.where(unsure[peer][:, None], record.pose[late], np.nan) for peer, record in peers.items()}
    world = records.pairs.get((ego, WORLD))
    labels = "x [m]", "y [m]"
    if world is not None and np.isfinite(world.pose).any():
        ego_pose = inverse(world.pose[late])
        note, known = f"estimated by {ego} in the start frame", {ego: ego_pose}
    elif np.isfinite(truth_at(records.truth, ego, t)).any():
        ego_pose = truth[ego]
        note, known = f"peers of {ego}, placed at its true pose", {}
    else:
        ego_pose, truth = np.zeros((len(t), 3)), {}
        note, known = f"peers in the moving frame of {ego}", {ego: ego_pose}
        labels = f"forward of {ego} [m]", f"left of {ego} [m]"
    estimates = known | {peer: compose(ego_pose, pose) for peer, pose in seen.items()}
    guesses = {peer: compose(ego_pose, pose) for peer, pose in guessed.items()}
    located = {peer: record.located[late] for peer, record in peers.items()}
    located[ego] = np.ones(len(t), dtype=bool)
    return TeamView(ego, t, ego_pose, estimates, located, guesses, truth, note, labels, float(stamps[0]))


def decorate(axes: Axes, view: TeamView, title: str) -> None:
    """Equal scales, units, the title and which frame this is."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set(xlabel=view.labels[0], ylabel=view.labels[1])
    axes.set_title(title, pad=18)
    axes.annotate(view.note, (0, 1), (0, 5), "axes fraction", "offset points", fontsize=8, color=GREY)
