"""Where ambiguous peers may be: every hypothesis with its probability and 95 % ellipse."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from dgorl.estimate import Estimate, PeerHypothesis
from dgorl.evaluation.metrics import CHI2_95_2DOF
from dgorl.se2 import Array, compose, rotation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FAINTEST = 0.2
"""how much of its colour the least probable keeps"""
LARGEST = 12.0
"""ellipses with a longer half-axis are drawn as rings alone, and do not widen the picture [m]"""


def opacity(probability: float) -> float:
    """From faint to full with the probability."""
    return FAINTEST + (1 - FAINTEST) * min(max(probability, 0.0), 1.0)


def draw_hypotheses(
    axes: Axes, estimate: Estimate, T_view_ego: Array, size: float, colors: Mapping[str, str]
) -> dict[str, Array]:
    """Hollow robots, faded by probability, with ellipses; ``size`` is the length of the heading mark [m].

    Returns peer → where its most probable one is (2,).
    """
    best = {}
    for peer, seen in sorted(estimate.items()):
        if peer not in colors:
            continue
        for rank, hypothesis in enumerate(seen.hypotheses):
            pose = compose(T_view_ego, hypothesis.pose)
            _draw(axes, pose, size, hypothesis.probability, colors[peer])
            draw_ellipse(
                axes, pose, rotation(T_view_ego[2]), hypothesis.covariance[:2, :2], colors[peer],
                opacity(hypothesis.probability), dashed=True,
            )  # fmt: skip
            if rank == 0:
                best[peer] = pose[:2]
    return best


def named(peer: str, hypotheses: tuple[PeerHypothesis, ...], *, brief: bool) -> str:
    """The words beside the most probable hypothesis; ``brief``: without its probability."""
    return f"{peer}?" if brief else f"{peer}? {100 * hypotheses[0].probability:.0f} %"


def draw_ellipse(
    axes: Axes, pose: Array, turn: Array, covariance: Array, color: str, alpha: float = 1.0, *, dashed: bool = False
) -> None:
    """The 95 % ellipse of a covariance (2, 2) in the ego's frame; ``turn`` maps that into the picture's."""
    angle = np.linspace(0, 2 * np.pi, 73)
    values, vectors = np.linalg.eigh(turn @ covariance @ turn.T)
    half = np.sqrt(CHI2_95_2DOF * np.clip(values, 0, None))
    if not np.isfinite(half).all():
        return
    x, y = pose[:2, None] + vectors @ (half[:, None] * np.array([np.cos(angle), np.sin(angle)]))
    limits = axes.dataLim.frozen()
    if half.max() < LARGEST:
        axes.fill(x, y, facecolor=color, alpha=0.15 * alpha, zorder=3)
    axes.plot(x, y, color=color, lw=0.9, alpha=0.8 * alpha, zorder=3, ls=(0, (4, 2)) if dashed else "-")
    if half.max() >= LARGEST:
        axes.dataLim.set(limits)


def _draw(axes: Axes, pose: Array, size: float, probability: float, color: str) -> None:
    alpha = opacity(probability)
    tip = pose[:2] + size * np.array([np.cos(pose[2]), np.sin(pose[2])])
    axes.plot(*zip(pose[:2], tip, strict=True), color=color, lw=1.5, alpha=alpha, zorder=4)
    axes.plot(pose[0], pose[1], "o", ms=7, mfc="white", mec=color, mew=1.6, alpha=alpha, zorder=4)
