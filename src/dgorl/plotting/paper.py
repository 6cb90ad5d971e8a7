"""The figures of the paper's experiment, each as PDF and PNG, from its tables alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dgorl.evaluation.claims import Rows
from dgorl.evaluation.statistics import bootstrap, root_ratio
from dgorl.evaluation.trials import Columns, Outcome
from dgorl.plotting.style import GREY, colors_of, picture
from dgorl.se2 import Array
from dgorl.stages import STAGES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ESTIMATORS = {
    "dgorl": ("DGORL", "#0072B2"),
    "gtsam-fixed-lag": ("GTSAM fixed lag", "#E69F00"),
    "trn": ("TRN (knows terrain)", "#7A4E2D"),
    "split-ci": ("split CI", "#D55E00"),
    "naive": ("naive fusion", "#CC79A7"),
    "ci": ("CI", "#009E73"),
    "dead-reckoning": ("dead reckoning", "#8A8A8A"),
}
"""name and colour of each, in the order of legends"""
STARTS = {"known": "known starts", "unknown": "unknown starts"}
BOUND = "#1A1A1A"
STAGE_COLORS = dict(zip((*STAGES, "status and views"), ("#56B4E9", "#E69F00", "#0072B2", "#C9C9C9"), strict=True))


def write_paper_figures(paper: Outcome, folder: Path) -> list[Path]:
    """rmse, comparison and cpu; returns the PNGs drawn. Raises MissingExtraError without matplotlib."""
    drawn = [folder / "rmse.png", folder / "comparison.png", folder / "cpu.png"]
    plot_rmse(paper.errors, drawn[0])
    plot_comparison(paper.errors, drawn[1])
    plot_cpu(paper.timings, drawn[2])
    return drawn


@contextmanager
def published(path: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure [inches] saved as PNG at ``path`` and as PDF beside it, with type that can be edited, without dates."""
    import matplotlib

    with picture(path, width, height) as figure:
        figure.set_layout_engine("constrained")
        yield figure
        with matplotlib.rc_context({"pdf.fonttype": 42}):
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
        figure.set_layout_engine("none")  # what was laid out for one holds for the other


def plot_rmse(errors: Columns, path: Path) -> None:
    """RMSE of every robot's peers over time, with the bound and how the trials spread; a row a kind of start."""
    kinds = [Rows(errors, initial) for initial in STARTS]
    kinds = [rows for rows in kinds if len(rows)]
    robots = sorted(set(kinds[0]["robot"]))
    colors = colors_of(robots)
    with published(path, 1.0 + 1.9 * len(robots), 0.9 + 2.1 * len(kinds)) as figure:
        grid = figure.subplots(len(kinds), len(robots), sharex="row", sharey="row", squeeze=False)
        for axes_row, rows in zip(grid, kinds, strict=True):
            initial = str(rows["initial"][0])
            for axes, robot in zip(axes_row, robots, strict=True):
                _robot_rmse(axes, rows, robot, colors[robot])
                axes.set_title(robot, color=colors[robot])
            axes_row[0].set_ylabel(f"RMSE of its peers [m]\n{STARTS[initial]}")
            _metres(axes_row[0], initial)
        for axes in grid.flat:
            axes.set_xlabel("time [s]")
        _rmse_legend(figure, len(kinds[0].seeds))


def _metres(axes: Axes, initial: str) -> None:
    """From zero; where starts are unknown, the logarithm, as errors fall from the size of the area to its fiftieth."""
    if initial == "known":
        axes.set_ylim(0)
        return
    axes.set_yscale("log")
    axes.set_ylim(1, 60)
    axes.set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    axes.minorticks_off()


def _robot_rmse(axes: Axes, rows: Rows, robot: str, color: str) -> None:
    t, each = _times(rows), _trial_rmse(rows, robot)
    low, high = _spread(each)
    axes.fill_between(t, low, high, color=color, alpha=0.2, lw=0)
    axes.plot(t, _middle(each, rows), color=color, lw=1.6)
    mine = rows["robot"] == robot
    bound = np.sqrt(rows["bound_square"][mine].reshape(len(rows.seeds), -1))
    axes.plot(t, _middle(bound, rows), color=BOUND, lw=1.0, ls=(0, (4, 2)))
    axes.set_xlim(0, t[-1])


def _rmse_legend(figure: Figure, trials: int) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=GREY, lw=1.6, label=f"RMSE over {trials} trials; unknown starts: their median"),
        Patch(facecolor=GREY, alpha=0.25, label="10 to 90 % of the trials"),
        Line2D([], [], color=BOUND, lw=1.0, ls=(0, (4, 2)), label="expected Cramér–Rao bound"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)


def plot_comparison(errors: Columns, path: Path) -> None:
    """RMSE over time of every estimator on the same inputs, and pooled beside it; a row a kind of start."""
    kinds = [initial for initial in STARTS if len(Rows(errors, initial))]
    with published(path, 9.0, 0.5 + 2.8 * len(kinds)) as figure:
        grid = figure.subplots(len(kinds), 2, width_ratios=(3, 2), squeeze=False)
        for (over_time, pooled), initial in zip(grid, kinds, strict=True):
            every = {name: Rows(errors, initial, name) for name in ESTIMATORS}
            shown = {name: rows for name, rows in every.items() if len(rows)}
            _over_time(over_time, shown, initial)
            _pooled(pooled, shown, initial)


def _over_time(axes: Axes, shown: dict[str, Rows], initial: str) -> None:
    for k, (name, rows) in enumerate(shown.items()):
        word, color = ESTIMATORS[name]
        axes.plot(_times(rows), _middle(_trial_rmse(rows, None), rows), color=color, lw=2.0 if name == "dgorl" else 1.2,
                  label=word, zorder=3 - 0.1 * k)  # fmt: skip
    rows = shown["dgorl"]
    bound = np.sqrt(rows["bound_square"].reshape(-1, len(_times(rows))))
    axes.plot(_times(rows), _middle(bound, rows), color=BOUND, lw=1.0, ls=(0, (4, 2)), label="bound")
    axes.set(
        xlabel="time [s]",
        ylabel="relative position RMSE [m]",
        title=STARTS[initial] + ("" if initial == "known" else ", median"),
    )
    axes.set_xlim(0, _times(rows)[-1])
    _metres(axes, initial)
    if initial == "known":
        axes.set_ylim(0, 1.3 * axes.get_ylim()[1])
    axes.legend(loc="upper left" if initial == "known" else "upper right", fontsize=8, ncols=2)


def _pooled(axes: Axes, shown: dict[str, Rows], initial: str) -> None:
    """One bar an estimator with its bootstrap interval; at the rows all of them have."""
    common = np.logical_and.reduce([rows["posed"] == rows["robots"] - 1 for rows in shown.values()])
    names = list(shown)
    for k, name in enumerate(names):
        rows = shown[name]
        sums = rows.sums(rows["posed_square"], rows["posed"], where=rows.late & common)
        value = float(root_ratio(sums.sum(axis=0))) if sums[:, 1].any() else np.nan
        low, high = bootstrap(sums, root_ratio)
        axes.barh(k, value, color=ESTIMATORS[name][1], height=0.7)
        axes.errorbar(value, k, xerr=[[value - low], [high - value]], color="#333333", lw=1.0, capsize=2.5)
        axes.annotate(f"{value:.2f}", (high, k), (4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(range(len(names)), [ESTIMATORS[name][0] for name in names])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.margins(x=0.15)
    words = "steps from 10 on" if initial == "known" else "where all have every peer"
    axes.set(xlabel="RMSE [m], 95 % interval", title=f"pooled, {words}")


def plot_cpu(timings: Columns, path: Path) -> None:
    """CPU of a tick over time beside the baselines, and how DGORL's splits into stages."""
    from matplotlib.ticker import LogLocator

    with published(path, 9.5, 3.4) as figure:
        over_time, stages = figure.subplots(1, 2, width_ratios=(3, 2))
        for name, (word, color) in ESTIMATORS.items():
            rows = Rows(timings, "known", name)
            if len(rows):
                t = _times(rows)
                each = rows["cpu_ms"].reshape(-1, len(t))
                over_time.plot(t, np.median(each, axis=0), color=color, lw=1.6 if name == "dgorl" else 1.1, label=word)
        over_time.set_yscale("log")
        over_time.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        over_time.yaxis.set_major_formatter("{x:g}")
        over_time.minorticks_off()
        over_time.margins(x=0)
        over_time.set(xlabel="time [s]", ylabel="CPU of a tick [ms]", title="one tick, known starts, median")
        over_time.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=4)
        _stages(stages, timings)


def _stages(axes: Axes, timings: Columns) -> None:
    """Stacked bars of the mean tick: ordinary ones and those that make a node, known and unknown starts."""
    bars = []
    for initial, words in STARTS.items():
        rows = Rows(timings, initial)
        if len(rows):
            seconds = rows["t"] - 1.0  # a node is made at the first tick a second after it
            node = (np.floor(seconds / 5) > np.floor((seconds - rows["t"][0]) / 5)) & (seconds >= 5)
            kinds = (("tick", ~node), ("node", node))
            bars += [(f"{words}\n{kind}", rows, where) for kind, where in kinds if where.any()]
    for k, (_, rows, where) in enumerate(bars):
        parts = {name: float(rows[f"{name}_ms"][where].mean()) for name in STAGES}
        total = float(rows["cpu_ms"][where].mean())
        parts["status and views"] = max(total - sum(parts.values()), 0.0)
        left = 0.0
        for name, value in parts.items():
            axes.barh(k, value, left=left, color=STAGE_COLORS[name], height=0.65, label=name if k == 0 else None)
            left += value
        axes.annotate(f"{total:.1f}", (left, k), (4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(range(len(bars)), [label for label, _, _ in bars])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.margins(x=0.12)
    axes.set(xlabel="mean CPU [ms]", title="stages of Alg. 3")
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.35, -0.17), ncols=2, columnspacing=1.0)


def _times(rows: Rows) -> Array:
    return np.unique(rows["t"])


def _trial_rmse(rows: Rows, robot: str | None) -> Array:
    """(trials, T) or, of all robots, (trials · robots, T): RMSE over peers with a pose, NaN without any."""
    mine = np.ones(len(rows), dtype=bool) if robot is None else rows["robot"] == robot
    located = rows["posed"]
    with np.errstate(invalid="ignore", divide="ignore"):
        each = np.sqrt(rows["posed_square"] / np.where(located > 0, located, np.nan))
    return np.asarray(each[mine].reshape(-1, len(_times(rows))))


def _middle(each: Array, rows: Rows) -> Array:
    """Of (N, T) RMSE, NaN where unknown: pooled with known starts, else the median, as few trials found late decide
    the root mean square. Where at most half are known there is nothing to say."""
    known = np.isfinite(each)
    found = np.full(each.shape[1], np.nan)
    enough = known.mean(axis=0) > 0.5
    if rows["initial"][0] == "known":
        found[enough] = np.sqrt(np.nanmean(each[:, enough] ** 2, axis=0))
    else:
        found[enough] = np.nanmedian(each[:, enough], axis=0)
    return found


def _spread(each: Array) -> tuple[Array, Array]:
    enough = np.isfinite(each).mean(axis=0) > 0.5
    found = np.full((2, each.shape[1]), np.nan)
    found[:, enough] = np.nanquantile(each[:, enough], (0.1, 0.9), axis=0)
    return found[0], found[1]
