"""figures/error_EGO.png: over time each peer's error, the bound the ego claims and the status it gives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dgorl.estimate import Status
from dgorl.evaluation.metrics import bound_95, heading_error, position_error, time_to_track
from dgorl.evaluation.records import PairRecord
from dgorl.plotting.hypotheses import opacity
from dgorl.plotting.notes import height_of, write_notes
from dgorl.plotting.style import GREY, STATUSES, colors_of, picture
from dgorl.se2 import Array, wrap

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
BAND = 0.05
"""of the status, as a share of the panel's height"""
ERROR = "#1A1A1A"
BOUND = "#0072B2"


def plot_errors(ego: str, peers: Mapping[str, PairRecord], path: Path, lines: Sequence[str] = ()) -> None:
    """Status, position error and bound above, heading error and bound below; a column a peer; words at the foot."""
    shown = sorted(peers)[:PEERS]
    if not shown:
        return
    since = {peer: replace(peers[peer], t=peers[peer].t - peers[peer].t[0]) for peer in shown}
    colors = colors_of([ego, *peers])
    columns = min(COLUMNS, len(shown))
    blocks = -(-len(shown) // columns)
    wide = max(WIDE, 2 * WIDE / columns)
    width = LEFT + columns * wide + RIGHT
    foot = height_of(lines)
    height = TOP + blocks * (2 * HIGH + SPACE) + BOTTOM - SPACE + foot
    with picture(path, width, height) as figure:
        write_notes(figure, lines)
        for k, peer in enumerate(shown):
            block, column = divmod(k, columns)
            left = LEFT + column * wide + 0.4
            top = height - TOP - block * (2 * HIGH + SPACE)
            upper, lower = (_panel(figure, left, top - (row + 1) * HIGH, wide) for row in (0, 1))
            _draw_position(upper, since[peer])
            _draw_heading(lower, since[peer])
            for axes in (upper, lower):
                axes.set_xlim(0, since[peer].t[-1] or 1.0)
            _draw_statuses(upper, since[peer])
            upper.set_title(peer, color=colors[peer], pad=9)
            upper.annotate(
                _found(since[peer]), (1, 1), (0, 9), "axes fraction", "offset points",
                fontsize=8, color=GREY, ha="right",
            )  # fmt: skip
            upper.tick_params(labelbottom=False)
            lower.set_xlabel("time since start [s]")
            if column == 0:
                upper.set_ylabel("position error [m]")
                lower.set_ylabel("heading error [°]")
                figure.align_ylabels([upper, lower])
        rest = f" (first {PEERS} of {len(peers)} peers)" if len(peers) > len(shown) else ""
        title = f"What {ego} knows of its peers{rest}"
        figure.text(0.1 / width, 1 - 0.1 / height, title, va="top", fontsize=11, fontweight="bold")
        _legend(figure, list(since.values()), foot)


def _panel(figure: Figure, left: float, bottom: float, wide: float) -> Axes:
    """Axes with their lower left corner there [inches]."""
    width, height = figure.get_size_inches()
    return figure.add_axes((left / width, bottom / height, (wide - 0.5) / width, (HIGH - 0.15) / height))


def _draw_statuses(axes: Axes, record: PairRecord) -> None:
    """A band of status over time along the panel's upper edge."""
    from matplotlib.collections import PolyCollection

    bars = [[(start, 1.0), (end, 1.0), (end, 1.0 + BAND), (start, 1.0 + BAND)] for start, end, _ in _periods(record)]
    colors = [STATUSES[status] for _, _, status in _periods(record)]
    across = axes.get_xaxis_transform()
    axes.add_collection(PolyCollection(bars, facecolors=colors, lw=0, clip_on=False, transform=across), autolim=False)


def _found(record: PairRecord) -> str:
    """When the peer was first located."""
    seconds = time_to_track(record)
    return "never located" if seconds is None else f"located after {seconds:.1f} s"


def _guesses(record: PairRecord) -> tuple[Array, Array, Array]:
    """While ambiguous, of every hypothesis: stamp (N,), error (N, 3) as in the records, probability (N,)."""
    rows = [(k, h) for k, alive in record.hypotheses.items() for h in alive]
    at = np.array([k for k, _ in rows], dtype=np.int64)
    error = np.array([h.pose for _, h in rows]).reshape(-1, 3) - record.truth[at]
    error[:, 2] = wrap(error[:, 2])
    return record.t[at], error, np.array([h.probability for _, h in rows])


def _draw_guesses(axes: Axes, t: Array, error: Array, probability: Array) -> None:
    """A dot for each hypothesis, faded by probability."""
    from matplotlib.colors import to_rgba

    if len(t):
        color = STATUSES[Status.AMBIGUOUS]
        axes.scatter(t, error, s=4, c=[to_rgba(color, opacity(p)) for p in probability.tolist()], lw=0, zorder=2.5)


def _draw_position(axes: Axes, record: PairRecord) -> None:
    unsure = record.having(Status.AMBIGUOUS)
    error = np.where(unsure, np.nan, np.hypot(*position_error(record).T))
    bound = np.where(unsure, np.nan, bound_95(record))
    t, off, probability = _guesses(record)
    distance = np.hypot(off[:, 0], off[:, 1])
    _shade(axes, record)
    _draw_guesses(axes, t, distance, probability)
    axes.plot(record.t, bound, color=BOUND, lw=1.0)
    axes.plot(record.t, error, color=ERROR, lw=1.2)
    axes.set_ylim(0, _top(record.located, error, bound, distance))


def _draw_heading(axes: Axes, record: PairRecord) -> None:
    unsure = record.having(Status.AMBIGUOUS)
    error = np.where(unsure, np.nan, np.degrees(heading_error(record)))
    bound = np.where(unsure, np.nan, np.degrees(1.96 * np.sqrt(record.covariance[:, 2, 2])))
    t, off, probability = _guesses(record)
    turn = np.degrees(off[:, 2])
    _shade(axes, record)
    _draw_guesses(axes, t, turn, probability)
    axes.plot(record.t, np.column_stack([-bound, bound]), color=BOUND, lw=1.0)
    wraps = np.abs(np.diff(error, prepend=error[:1])) > 180
    axes.plot(record.t, np.where(wraps, np.nan, error), color=ERROR, lw=1.2)
    top = min(_top(record.having(Status.TRACKED), np.abs(error), bound, np.abs(turn)), 180.0)
    axes.set_ylim(-top, top)


def _top(counts: NDArray[np.bool_], error: Array, bound: Array, guesses: Array) -> float:
    """Where the axis ends: all fits that happens while the peer is located, else joined, else ambiguous."""
    for values in ([error[counts], bound[counts]], [error, bound], [guesses]):
        finite = np.concatenate(values)
        finite = finite[np.isfinite(finite)]
        if len(finite):
            return 1.15 * float(finite.max()) or 1.0
    return 1.0


def _periods(record: PairRecord) -> Iterator[tuple[float, float, Status]]:
    """Start, end and status of every stretch of equal status."""
    changes = [0, *(k for k in range(1, len(record.status)) if record.status[k] != record.status[k - 1])]
    ends = [*(record.t[k] for k in changes[1:]), record.t[-1]]
    for k, end in zip(changes, ends, strict=True):
        yield float(record.t[k]), float(end), record.status[k]


def _shade(axes: Axes, record: PairRecord) -> None:
    """Colour the background by status, pale."""
    for start, end, status in _periods(record):
        if status is not Status.TRACKED:
            axes.axvspan(start, end, color=STATUSES[status], alpha=0.18, lw=0, zorder=0)


def _legend(figure: Figure, records: Sequence[PairRecord], foot: float) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    measured = any(np.isfinite(r.truth).any() for r in records)
    joined = not all(r.having(Status.ISOLATED, Status.AMBIGUOUS).all() for r in records)
    handles: list[Line2D | Patch] = []
    if measured and joined:
        handles.append(Line2D([], [], color=ERROR, lw=1.2, label="error"))
    if joined:
        handles.append(Line2D([], [], color=BOUND, lw=1.0, label="95 % bound claimed"))
    if measured and any(r.hypotheses for r in records):
        color = STATUSES[Status.AMBIGUOUS]
        handles.append(Line2D([], [], color=color, marker="o", ms=3, mew=0, ls="", label="error of each hypothesis"))
    seen = {status for record in records for status in record.status}
    handles += [Patch(facecolor=color, label=str(status)) for status, color in STATUSES.items() if status in seen]
    title = None if measured else "no ground truth: errors are not known"
    figure.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, foot / figure.get_size_inches()[1]),
        ncols=4 if len(records) < 3 else len(handles),
        title=title,
        columnspacing=1.3,
    )
