"""What ``run`` and ``fleet`` share: of a log, what to use, how to localise with it and what to compare with."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from tyro.conf import arg

from dgorl import logs
from dgorl.cli.parsing import File, Seconds, Seed, Window
from dgorl.errors import ConfigurationError
from dgorl.logs.log import Log
from dgorl.logs.stamps import odometry_span

Kind = Literal["range", "bearing", "rssi"]


@dataclass(frozen=True, kw_only=True)
class EstimationOptions:
    """Options of both commands."""

    initial: Literal["known", "unknown"] = "unknown"
    """unknown finds out where everybody is; known takes the log's start poses, good to 0.05 m and 1°"""
    measurements: Annotated[tuple[Kind, ...], arg(help_behavior_hint="")] = ()
    """use these alone; all in the log when not given"""
    window: Window = None
    """length of the window that is optimised, a multiple of 5 s (default: 30)"""
    history: Seconds = None
    """measurements later than this are too late (default: 180)"""
    candidates: Annotated[int | None, arg(metavar="K", help_behavior_hint="")] = None
    """places kept in mind for each robot not yet found (default: 5)"""
    period: Seconds = None
    """time between two ticks (default: 0.5)"""
    truth: File = None
    """a groundtruth.csv (t,robot,x,y,theta) to score against, in place of the log's"""
    config: File = None
    """YAML settings, over the log's own, under the command line's; see `dgorl config`"""
    seed: Seed = None
    """of everything drawn by chance (default: 0)"""
    json: bool = False
    """put the summary on stdout as one JSON object"""

    def settings(self) -> dict[str, Any]:
        """The settings given on the command line. Raises ConfigurationError for a window that is not a number."""
        given = {name: getattr(self, name) for name in ("history", "candidates", "period", "seed")}
        changes = {name: value for name, value in given.items() if value is not None}
        if self.window is not None:
            changes["window"] = _window(self.window)
        return changes

    def of(self, log: Log) -> Log:
        """A log with the wanted measurements and truth. Raises DgorlError."""
        if self.measurements:
            log = logs.select(log, self.measurements)
        if self.truth is not None:
            truth = logs.read_truth(self.truth, log.robots, odometry_span(log.measurements))
            log = dataclasses.replace(log, truth=truth)
        return log


def _window(text: str) -> float | str:
    if text == "all":
        return text
    try:
        return float(text)
    except ValueError:
        raise ConfigurationError(f"command line: window must be seconds or all, got {text!r}") from None
