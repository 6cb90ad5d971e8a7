"""One robot's live view of its team: where it sees the others now, how surely, where ambiguous ones may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from dgorl.estimate import Estimate, OptimizedGraph, PeerEstimate, Status
from dgorl.measurements import WORLD
from dgorl.plotting.hypotheses import draw_ellipse, draw_hypotheses, named
from dgorl.plotting.labels import write_names
from dgorl.plotting.style import GREY, colors_of
from dgorl.se2 import Array, compose, inverse, rotation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST = 4.0
"""The picture is at least this wide [m]."""


def draw_live(axes: Axes, ego: str, peers: Mapping[str, PeerEstimate], team: Sequence[str], note: str) -> None:
    """Draw ``ego``'s peers anew: in the start frame if it knows that, else in its own, forward to the right.

    Names of peers that are not tracked carry their status. note: written below the picture.
    """
    axes.clear()
    colors = colors_of(team)
    world = peers.get(WORLD)
    known = world is not None and world.pose is not None
    T_view_ego = inverse(world.pose) if world is not None and world.pose is not None else np.zeros(3)
    shown = {ego: T_view_ego}
    for name, peer in peers.items():
        if peer.pose is not None and not peer.hypotheses and name != WORLD:
            shown[name] = compose(T_view_ego, peer.pose)
    guesses = [compose(T_view_ego, h.pose)[:2] for p in peers.values() for h in p.hypotheses]
    spots = np.array([*(pose[:2] for pose in shown.values()), *guesses])
    size = 0.05 * max(float(np.ptp(spots, axis=0).max()), LEAST)
    for name, pose in shown.items():
        _draw(axes, pose, size, colors.get(name, GREY), peers.get(name), T_view_ego)
    estimate = Estimate(ego, 0.0, peers, {}, lambda: OptimizedGraph({}, (), np.zeros((0, 0))))
    words = {name: _words(name, peers.get(name)) for name in shown}
    places = {name: pose[:2] for name, pose in shown.items()}
    for name, place in draw_hypotheses(axes, estimate, T_view_ego, size, colors).items():
        places[name], words[name] = place, named(name, peers[name].hypotheses, brief=False)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.12)
    if np.ptp(spots, axis=0).max() < LEAST:
        middle = spots.mean(axis=0)
        axes.update_datalim([middle - LEAST / 2, middle + LEAST / 2])
    axes.autoscale_view()
    labels = ("x [m]", "y [m]") if known else (f"forward of {ego} [m]", f"left of {ego} [m]")
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.set_title(f"{ego} and its team", pad=18)
    axes.annotate(note, (0, 1), (0, 5), "axes fraction", "offset points", fontsize=8, color=GREY)
    write_names(axes, places, MappingProxyType({**dict.fromkeys(places, GREY), **colors}), spots, words)


def _draw(axes: Axes, pose: Array, size: float, color: str, seen: PeerEstimate | None, T_view_ego: Array) -> None:
    sure = seen is None or seen.status in (Status.POSITION, Status.TRACKED)
    tip = pose[:2] + size * rotation(pose[2])[:, 0]
    if seen is None or seen.status != Status.POSITION:
        axes.plot(*zip(pose[:2], tip, strict=True), color=color, lw=2.0, zorder=5)
    axes.plot(pose[0], pose[1], "o", ms=8, color=color, mfc=color if sure else "white", mec=color, zorder=5)
    if seen is not None and seen.covariance is not None:
        draw_ellipse(axes, pose, rotation(T_view_ego[2]), seen.covariance[:2, :2], color)


def _words(name: str, seen: PeerEstimate | None) -> str:
    return name if seen is None or seen.status == Status.TRACKED else f"{name}: {seen.status}"
