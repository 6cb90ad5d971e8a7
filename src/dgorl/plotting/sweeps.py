"""Around the paper's setting, one thing varied at a time: how close to the bound, how many peers are tracked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dgorl.evaluation.statistics import bootstrap, ratio, root_ratio
from dgorl.evaluation.trials import Columns
from dgorl.plotting.paper import published
from dgorl.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = {
    "shadowing_db": "shadowing σ [dB]",
    "path_loss_exponent": "path-loss exponent η",
    "robots": "robots",
    "area": "side of the area [m]",
    "odometry_noise": "odometry noise ÷ paper's",
    "reciprocity": "reciprocity ρ",
}
COLORS = {"known": "#0072B2", "unknown": "#D55E00"}


def plot_sweeps(errors: Columns, path: Path) -> None:
    """RMSE ÷ bound above, share of tracked peers below; a column a setting, a line a kind of start."""
    names = [str(name) for name in dict.fromkeys(errors["scenario"].tolist())]
    fields = [field for field in LABELS if any(name.startswith(f"{field}=") for name in names)]
    with published(path, 1.0 + 2.1 * len(fields), 4.6) as figure:
        grid = figure.subplots(2, len(fields), sharex="col", sharey="row", squeeze=False)
        for (upper, lower), field in zip(grid.T, fields, strict=True):
            values = [float(name.split("=")[1]) for name in names if name.startswith(f"{field}=")]
            for initial, color in COLORS.items():
                _line(upper, errors, field, values, initial, color, tracked=False)
                _line(lower, errors, field, values, initial, color, tracked=True)
            upper.axhline(1.0, color="#1A1A1A", lw=0.8, ls=(0, (4, 2)))
            lower.set_xlabel(LABELS[field])
            lower.set_ylim(0, 105)
            lower.set_xticks(range(len(values)), [f"{value:g}" for value in values])
        grid[0, 0].set_ylabel("RMSE ÷ bound")
        grid[0, 0].set_ylim(0, 1.05 * grid[0, 0].get_ylim()[1])
        grid[1, 0].set_ylabel("tracked peers [%]")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)


def _line(
    axes: Axes, errors: Columns, field: str, values: list[float], initial: str, color: str, *, tracked: bool
) -> None:
    ends = [_figure(errors, f"{field}={value:g}", initial, tracked) for value in values]
    middle, low, high = np.array(ends).T
    axes.errorbar(range(len(values)), middle, yerr=[middle - low, high - middle], color=color, marker="o", ms=4, lw=1.3,
                  elinewidth=0.9, capsize=2, label=f"{initial} starts")  # fmt: skip


def _figure(errors: Columns, name: str, initial: str, tracked: bool) -> tuple[float, float, float]:
    """Value and interval of one setting: over compared peers; located ones alone where starts are unknown."""
    chosen = (errors["scenario"] == name) & (errors["initial"] == initial)
    seeds, trial = np.unique(errors["seed"][chosen], return_inverse=True)
    kind = "compared" if initial == "known" else "located_compared"
    top, bottom = ("tracked", "peers") if tracked else (f"{kind}_square", f"{kind}_bound")
    columns = {**errors, "peers": errors["robots"] - 1}
    sums: Array = np.column_stack([np.bincount(trial, columns[column][chosen], len(seeds)) for column in (top, bottom)])
    statistic, scale = (ratio, 100.0) if tracked else (root_ratio, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        value = scale * float(statistic(sums.sum(axis=0)))
    low, high = (scale * end for end in bootstrap(sums, statistic))
    return value, min(low, value), max(high, value)
