"""The live picture of ``dgorl monitor --viewer``: a window, or a file that is replaced again and again."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dgorl.errors import DgorlError, MissingExtraError, pip_install
from dgorl.plotting.live import draw_live
from dgorl.plotting.style import picture
from dgorl.printable import printable
from dgorl.team.bulletin import Bulletin
from dgorl.team.report import estimates_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from dgorl.cli.watcher import Watcher

SIZE = 7.0, 6.5
"""[inches]"""
WINDOWLESS = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")


def view(watcher: Watcher, robot: str | None, every: float, out: Path | None, *, once: bool, patience: float) -> None:
    """Draw what ``robot``, or the first one heard, sees, every so many seconds until interrupted or closed.

    once: draw one picture after ``patience`` seconds at most. Raises DgorlError without a display and ``out``.
    """
    if out is None:
        _window(watcher, robot, every)
        return
    if once:
        watcher.meet(patience)
        _file(watcher, robot, out)
        return
    print(printable(f"{out} is drawn anew every {every:g} s; Ctrl-C ends it"), file=sys.stderr)
    while True:
        for _ in watcher.listen(every):
            pass
        _file(watcher, robot, out)


def _file(watcher: Watcher, robot: str | None, out: Path) -> None:
    """Replace the file at once, so that nobody reads half a picture."""
    part = out.with_name(f".{out.stem}.part.png")
    with picture(part, *SIZE) as figure:
        _draw(figure.add_subplot(), watcher, robot)
    part.replace(out)


def _window(watcher: Watcher, robot: str | None, every: float) -> None:
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise MissingExtraError(f"pictures need matplotlib: {pip_install('matplotlib')}") from error
    if pyplot.get_backend().lower() in WINDOWLESS:
        raise DgorlError("no display to open a window on; name a file with --out FILE.png, it is drawn again and again")
    figure, axes = pyplot.subplots(figsize=SIZE, num=f"dgorl: {watcher.team.team}")
    while pyplot.fignum_exists(figure.number):
        for _ in watcher.listen(every):
            figure.canvas.flush_events()
        _draw(axes, watcher, robot)
        figure.canvas.draw_idle()


def _draw(axes: Axes, watcher: Watcher, robot: str | None) -> None:
    told = {name: seen.bulletin for name, seen in watcher.watch.robots.items() if seen.bulletin is not None}
    ego = robot if robot is not None else next(iter(told), None)
    bulletin: Bulletin | None = told.get(ego) if ego is not None else None
    if ego is None or bulletin is None:
        axes.clear()
        axes.set_axis_off()
        axes.text(0.5, 0.5, "nobody is heard yet" if ego is None else f"{ego} is not heard yet", ha="center")
        return
    axes.set_axis_on()
    state = watcher.state()["robots"][ego]
    late = state["says"]["s_ago"]
    note = f"team {watcher.team.team}; at {bulletin.stamp:.1f} s of {ego}'s clock, told {late:.1f} s ago"
    draw_live(axes, ego, estimates_of(bulletin.peers), watcher.team.roster.robots, note)
