"""How every picture looks: colours told apart by the colour-blind, legible type, no display needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dgorl.errors import MissingExtraError, pip_install
from dgorl.estimate import Status
from dgorl.se2 import rotation

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.path import Path as Outline

ROBOTS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7A4E2D", "#5A5A5A")
"""Okabe and Ito's palette without its yellow, then brown and grey; larger teams repeat colours, not labels"""
STATUSES = {
    Status.ISOLATED: "#8A8A8A",
    Status.AMBIGUOUS: "#A05CB5",
    Status.UNOBSERVABLE: "#E69F00",
    Status.POSITION: "#56B4E9",
    Status.TRACKED: "#009E73",
}
GREY = "#6B6B6B"
TRUTH = "#B8B8B8"

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#444444",
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def colors_of(robots: Sequence[str]) -> dict[str, str]:
    """A colour for each robot, the same in every picture of a team."""
    return {robot: ROBOTS[k % len(ROBOTS)] for k, robot in enumerate(sorted(robots))}


@contextmanager
def picture(path: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure [inches] to draw on, saved as PNG at the end; no global state, no display.

    Raises MissingExtraError without matplotlib.
    """
    try:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError(f"pictures need matplotlib: {pip_install('matplotlib')}") from error
    with matplotlib.rc_context(cast(Any, _STYLE)):
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)


def arrowhead(heading: float) -> Outline:
    """A marker that points along a heading [rad]."""
    from matplotlib.path import Path as Outline

    shape = np.array([[1.0, 0.0], [-0.7, 0.62], [-0.35, 0.0], [-0.7, -0.62], [1.0, 0.0]])
    return Outline(shape @ rotation(heading).T)
