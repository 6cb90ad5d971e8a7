"""The optimised graph of one tick, G_o = (V_o, E_o, A_o): who measured whom, and how well it fits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dgorl.estimate import Edge, Estimate
from dgorl.measurements import WORLD
from dgorl.plotting.frames import TeamView, decorate
from dgorl.plotting.hypotheses import draw_ellipse, draw_hypotheses, named
from dgorl.plotting.labels import write_names
from dgorl.plotting.style import GREY
from dgorl.se2 import Array, compose, rotation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = {"rssi": "-", "range": (0, (5, 1.5)), "bearing": (0, (1, 1.3)), "pose": (0, (5, 1, 1, 1))}
"""line style of each kind of measurement"""
WORST = 3.0
"""residuals from here on have the last colour [σ]"""
CROWD = 6
"""more ambiguous peers are written without their probabilities"""
SPACING = 0.04
"""between the edges of one pair [inches]"""


def draw_graph(figure: Figure, axes: Axes, estimate: Estimate, view: TeamView, colors: dict[str, str]) -> None:
    """Robots with heading and 95 % ellipse; edges styled by kind, coloured by residual; hypotheses hollow."""
    decorate(axes, view, f"Optimised graph after {estimate.stamp - view.start:.1f} s")
    T_view_ego = view.ego_pose[-1]
    if not np.isfinite(T_view_ego).all():
        what = f"{estimate.robot} has no place here at the last tick"
        axes.text(0.5, 0.5, what, transform=axes.transAxes, ha="center")
        return
    graph = estimate.graph
    unsure = {peer for peer, seen in estimate.items() if seen.hypotheses}
    poses = {robot: compose(T_view_ego, pose) for robot, pose in graph.poses.items() if robot not in (WORLD, *unsure)}
    edges = [edge for edge in graph.edges if edge.a in poses and edge.b in poses]
    guesses = [compose(T_view_ego, h.pose)[:2] for peer in sorted(unsure) for h in estimate[peer].hypotheses]
    places = {robot: pose[:2] for robot, pose in poses.items()}
    size = 0.05 * float(np.ptp([*places.values(), *guesses], axis=0).max()) or 1.0
    _draw_edges(figure, axes, edges, poses)
    _legend(axes, edges, len(poses) > 1, len(guesses) > 0)
    _draw_robots(axes, estimate, T_view_ego, poses, size, colors)
    words = {robot: robot for robot in places}
    for peer, place in draw_hypotheses(axes, estimate, T_view_ego, size, colors).items():
        places[peer], words[peer] = place, named(peer, estimate[peer].hypotheses, brief=len(unsure) > CROWD)
    share = np.linspace(0, 1, 15)[:, None]
    drawn = [(1 - share) * poses[edge.a][:2] + share * poses[edge.b][:2] for edge in edges]
    drawn += [pose[:2] + size * rotation(pose[2])[:, 0] for pose in poses.values()]
    write_names(axes, places, colors, np.vstack([*drawn, *guesses]), words)
    axes.annotate(
        f"ellipses: 95 %, relative to {estimate.robot}", (1, 1), (0, 5), "axes fraction", "offset points",
        fontsize=8, color=GREY, ha="right",
    )  # fmt: skip


def _draw_robots(
    axes: Axes, estimate: Estimate, T_view_ego: Array, poses: dict[str, Array], size: float, colors: dict[str, str]
) -> None:
    for robot, pose in poses.items():
        color = colors[robot]
        tip = pose[:2] + size * rotation(pose[2])[:, 0]
        axes.plot(*zip(pose[:2], tip, strict=True), color=color, lw=2.0, zorder=5)
        axes.plot(pose[0], pose[1], "o", ms=8, color=color, mec="white", mew=1.0, zorder=5)
        seen = estimate.peers.get(robot)
        if seen is not None and seen.covariance is not None:
            draw_ellipse(axes, pose, rotation(T_view_ego[2]), seen.covariance[:2, :2], color)


def _draw_edges(figure: Figure, axes: Axes, edges: list[Edge], poses: dict[str, Array]) -> None:
    """Edges of one pair run side by side, one for each kind."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.transforms import ScaledTranslation

    ramp = LinearSegmentedColormap.from_list("residual", ["#A9BCC9", "#E69F00", "#8C1C13"])
    scale = ScalarMappable(Normalize(0.0, WORST), ramp)
    kinds = [kind for kind in KINDS if any(edge.kind == kind for edge in edges)]
    for edge in edges:
        a, b = poses[edge.a][:2], poses[edge.b][:2]
        side = kinds.index(edge.kind) - (len(kinds) - 1) / 2
        across = np.array([a[1] - b[1], b[0] - a[0]]) / (float(np.hypot(*(b - a))) or 1.0)
        dx, dy = SPACING * side * (across if edge.a < edge.b else -across)
        aside = axes.transData + ScaledTranslation(dx, dy, figure.dpi_scale_trans)
        color = ramp(abs(edge.residual) / WORST)
        axes.plot(*zip(a, b, strict=True), ls=KINDS[edge.kind], lw=1.6, color=color, zorder=2, transform=aside)
    if edges:
        bar = figure.colorbar(scale, ax=axes, extend="max", shrink=0.75, pad=0.02)
        bar.set_label("residual of the edge [σ]")
        bar.outline.set_linewidth(0.0)


def _legend(axes: Axes, edges: list[Edge], joined: bool, guessed: bool) -> None:
    from matplotlib.lines import Line2D

    kinds = [kind for kind in KINDS if any(edge.kind == kind for edge in edges)]
    handles = [Line2D([], [], color=GREY, lw=1.6, ls=KINDS[kind], label=kind) for kind in kinds]
    if guessed:
        label = "place a peer may be at" + ("" if joined else "; no peer is joined yet")
        handles.append(Line2D([], [], color=GREY, marker="o", ms=7, mfc="white", mew=1.6, ls="", label=label))
    if handles:
        axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=5, handlelength=2.6)
    else:
        what = "no measurement between robots in the last 5 s" if joined else "no peer has a place in the graph"
        axes.annotate(what, (0.5, -0.16), xycoords="axes fraction", ha="center", color=GREY)
