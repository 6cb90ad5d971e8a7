"""figures/error_EGO.png: over time each peer's error, the bound the ego claims and the status it gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dgorl.estimate import Status
from dgorl.evaluation.metrics import bound_95, heading_error, position_error
from dgorl.evaluation.records import PairRecord
from dgorl.plotting.style import STATUSES, colors_of, picture
from dgorl.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 4
PEERS = 12
"""more do not fit a page"""
HIGH, WIDE = 1.6, 3.0
"""one panel with its margins; fewer than three columns share the page's width [inches]"""
LEFT, RIGHT, TOP, BOTTOM = 0.35, 0.15, 0.6, 1.0
"""margins of the page [inches]"""
SPACE = 0.6
"""between two rows of peers [inches]"""
ERROR = "#1A1A1A"
BOUND = "#0072B2"


def plot_errors(ego: str, peers: Mapping[str, PairRecord], path: Path) -> None:
    """Position error and bound above, heading error and bound below; a column a peer."""
    shown = sorted(peers)[:PEERS]
    if not shown:
        return
    since = {peer: replace(peers[peer], t=peers[peer].t - peers[peer].t[0]) for peer in shown}
    colors = colors_of([ego, *peers])
    columns = min(COLUMNS, len(shown))
    blocks = -(-len(shown) // columns)
    wide = max(WIDE, 2 * WIDE / columns)
    width = LEFT + columns * wide + RIGHT
    height = TOP + blocks * (2 * HIGH + SPACE) + BOTTOM - SPACE
    with picture(path, width, height) as figure:
        for k, peer in enumerate(shown):
            block, column = divmod(k, columns)
            left = LEFT + column * wide + 0.4
            top = height - TOP - block * (2 * HIGH + SPACE)
            upper, lower = (_panel(figure, left, top - (row + 1) * HIGH, wide) for row in (0, 1))
            _draw_position(upper, since[peer])
            _draw_heading(lower, since[peer])
            for axes in (upper, lower):
                axes.set_xlim(0, since[peer].t[-1] or 1.0)
            upper.set_title(peer, color=colors[peer])
            upper.tick_params(labelbottom=False)
            lower.set_xlabel("time since start [s]")
            if column == 0:
                upper.set_ylabel("position error [m]")
                lower.set_ylabel("heading error [°]")
                figure.align_ylabels([upper, lower])
        rest = f" (first {PEERS} of {len(peers)} peers)" if len(peers) > len(shown) else ""
        title = f"What {ego} knows of its peers{rest}"
        figure.text(0.1 / width, 1 - 0.1 / height, title, va="top", fontsize=11, fontweight="bold")
        _legend(figure, list(since.values()))


def _panel(figure: Figure, left: float, bottom: float, wide: float) -> Axes:
    """Axes with their lower left corner there [inches]."""
    width, height = figure.get_size_inches()
    return figure.add_axes((left / width, bottom / height, (wide - 0.5) / width, (HIGH - 0.15) / height))


def _draw_position(axes: Axes, record: PairRecord) -> None:
    error, bound = np.hypot(*position_error(record).T), bound_95(record)
    _shade(axes, record)
    axes.plot(record.t, bound, color=BOUND, lw=1.0)
    axes.plot(record.t, error, color=ERROR, lw=1.2)
    axes.set_ylim(0, _top(record.located, error, bound))


def _draw_heading(axes: Axes, record: PairRecord) -> None:
    error = np.degrees(heading_error(record))
    bound = np.degrees(1.96 * np.sqrt(record.covariance[:, 2, 2]))
    _shade(axes, record)
    axes.plot(record.t, np.column_stack([-bound, bound]), color=BOUND, lw=1.0)
    wraps = np.abs(np.diff(error, prepend=error[:1])) > 180
    axes.plot(record.t, np.where(wraps, np.nan, error), color=ERROR, lw=1.2)
    top = min(_top(record.having(Status.TRACKED), np.abs(error), bound), 180.0)
    axes.set_ylim(-top, top)


def _top(counts: NDArray[np.bool_], error: Array, bound: Array) -> float:
    """Where the axis ends: all fits that happens while the peer is located."""
    rows = counts if counts.any() else np.ones(len(counts), dtype=bool)
    values = np.concatenate([error[rows], bound[rows]])
    values = values[np.isfinite(values)]
    return 1.15 * float(values.max()) if len(values) and values.max() > 0 else 1.0


def _shade(axes: Axes, record: PairRecord) -> None:
    """Colour the background by status."""
    changes = [0, *(k for k in range(1, len(record.status)) if record.status[k] != record.status[k - 1])]
    ends = [*(record.t[k] for k in changes[1:]), record.t[-1]]
    for k, end in zip(changes, ends, strict=True):
        if record.status[k] is not Status.TRACKED:
            axes.axvspan(record.t[k], end, color=STATUSES[record.status[k]], lw=0, zorder=0)


def _legend(figure: Figure, records: Sequence[PairRecord]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    measured = any(np.isfinite(r.truth).any() for r in records)
    handles: list[Line2D | Patch] = []
    if measured:
        handles.append(Line2D([], [], color=ERROR, lw=1.2, label="error"))
    handles.append(Line2D([], [], color=BOUND, lw=1.0, label="95 % bound claimed"))
    seen = {status for record in records for status in record.status}
    handles += [
        Patch(facecolor=color, edgecolor="#CCCCCC", lw=0.6, label=str(status))
        for status, color in STATUSES.items()
        if status in seen
    ]
    title = None if measured else "no ground truth: bounds alone"
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=4 if len(records) < 3 else len(handles),
        title=title,
        columnspacing=1.3,
    )
