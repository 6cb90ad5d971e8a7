"""The table of ``dgorl monitor``, from a snapshot's numbers alone."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from typing import Any, Literal

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from dgorl.cli.table import LOCATED
from dgorl.cli.terminal import words

COLORS = {"tracked": "green", "position": "cyan", "unobservable": "yellow", "ambiguous": "magenta", "isolated": "red"}
STALE = 3.0
"""What was said, or measured of a peer, longer ago than this [s] is shown grey."""
GREY = "bright_black"
COLUMNS = (
    "clock\n[s]", "sent\n[B/s]", "peer", "status", "x\n[m]", "y\n[m]", "θ\n[°]", "1σ\n[m]", "1σ\n[°]", "age\n[s]",
    "loss\n[%]",
)  # fmt: skip
WORDS = ("peer", "status")
LEFT_OUT: Sequence[Collection[int]] = ((), (0, 1), (0, 1, 10), (0, 1, 8, 9, 10), (0, 1, 6, 8, 9, 10))
"""Columns that narrower and narrower terminals do without: clock and traffic, loss, age and heading's σ, heading."""
WIDTH = 100
"""Columns a plain table needs."""


def tables(state: Mapping[str, Any], ego: str | None) -> RenderableType:
    """One row an ego and peer: where the ego sees it, how surely, and what gets lost on the way from it.

    ego: the one robot wanted, with the reasons why its peers are not located; all when None.
    """
    robots = state["robots"]
    told = {name: r for name, r in robots.items() if r["says"] is not None and ego in (None, name)}
    parts: list[RenderableType] = [words(f"Team {state['team']}: {_heard(robots)}", style="bold")]
    if told:
        parts.append(_Fitted(told))
    if ego is not None and told:
        parts.extend(_reasons(told[ego]["says"]["peers"]))
    parts.extend(words(line, style="yellow") for line in remarks(state) if ego is None or line.startswith(f"{ego}:"))
    return Group(*parts)


@dataclass(frozen=True)
class _Fitted:
    """The table of the robots that told how they fare, without the columns that a narrow terminal has no room for."""

    told: Mapping[str, Any]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for left_out in LEFT_OUT:
            table = self._table(left_out)
            if Measurement.get(console, options.update(max_width=1000), table).maximum <= options.max_width:
                break
        yield table

    def _table(self, left_out: Collection[int]) -> Table:
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
        table.add_column("robot", overflow="fold")
        kept = [k for k in range(len(COLUMNS)) if k not in left_out]
        for name in (COLUMNS[k] for k in kept):
            wraps = name == "peer"
            justify: Literal["left", "right"] = "left" if name in WORDS else "right"
            table.add_column(Text(name), justify=justify, no_wrap=not wraps, overflow="fold" if wraps else "ellipsis")
        for name, robot in self.told.items():
            for first, cells, style in _rows(name, robot):
                table.add_row(first, *(cells[k] for k in kept if k < len(cells)), style=style)
            table.add_section()
        return table


def remarks(state: Mapping[str, Any]) -> list[str]:
    """Who is missing from the table and why, as far as one sees; what was not believed."""
    lines = []
    for name, robot in state["robots"].items():
        what = []
        if robot["same_team_file"] is False:
            what.append("has another team.yaml")
        if robot["says"] is None and robot["heard_s_ago"] is None:
            what.append("on the network, nothing heard yet" if robot["present"] else "not on the network")
        elif not robot["present"]:
            what.append(f"left the network, heard {robot['heard_s_ago']:.0f} s ago")
        elif not _speaks(robot):
            what.append(f"says nothing, heard {robot['heard_s_ago']:.0f} s ago")
        rejected = ", ".join(f"{count} × {reason}" for reason, count in robot["rejected_here"].items())
        if rejected:
            what.append(f"not believed: {rejected}")
        what.extend(robot["lives_twice"])
        if what:
            lines.append(f"{name}: {'; '.join(what)}")
    if state["strangers"]:
        lines.append(f"not in the team file, on the network: {', '.join(state['strangers'])}")
    if state["nameless"]:
        lines.append(f"on the network under names that no robot can have: {state['nameless']}")
    return lines


def _heard(robots: Mapping[str, Any]) -> str:
    heard = sum(robot["present"] and _speaks(robot) for robot in robots.values())
    if not heard:
        return "nobody is heard; `dgorl doctor --team FILE` looks for the reason"
    return f"{heard} of {len(robots)} robots are heard"


def _speaks(robot: Mapping[str, Any]) -> bool:
    """Whether it told how it fares, lately."""
    return robot["says"] is not None and robot["says"]["s_ago"] < STALE


def _rows(name: str, robot: Mapping[str, Any]) -> Iterator[tuple[str, list[RenderableType], str]]:
    """A robot's rows: its name, in the first alone, the cells of ``COLUMNS`` and a style."""
    says = robot["says"]
    silent = says["s_ago"] >= STALE
    head: list[RenderableType] = [_clock(robot["clock"]), _number(says["sent_bytes_per_s"], 0)]
    if not says["peers"]:
        yield name, [*head, "nobody"], GREY if silent else ""
    for peer, seen in says["peers"].items():
        x, y, theta = seen["pose"] or (None, None, None)
        stale = silent or (seen["age_s"] or 0.0) >= STALE
        cells: list[RenderableType] = [
            words(peer),
            words(seen["status"], style="" if stale else COLORS.get(seen["status"], "")),
            _number(x, 1),
            _number(y, 1),
            _number(None if theta is None else degrees(theta), 0),
            _number(seen["position_sigma_m"], 2),
            _number(seen["heading_sigma_deg"], 0),
            _number(seen["age_s"], 1),
            _number(100 * says["loss"][peer] if peer in says["loss"] else None, 0),
        ]
        yield name, [*head, *cells], GREY if stale else ""
        name, head = "", ["", ""]


def _reasons(peers: Mapping[str, Any]) -> list[RenderableType]:
    lines: list[RenderableType] = []
    for name, seen in peers.items():
        if seen["status"] not in LOCATED or seen["reason"]:
            said = [seen["reason"], f"would help: {seen['resolve_by']}" if seen["resolve_by"] else ""]
            lines.append(words(f"{name} {seen['status']}: {'; '.join(word for word in said if word)}"))
    return lines


def _clock(clock: Mapping[str, Any]) -> str:
    if clock["ahead_s"] is None:
        return "–"
    sigma = "" if clock["sigma_s"] is None else f"±{clock['sigma_s']:.3f}"
    return f"{round(clock['ahead_s'], 3) + 0.0:+.3f}{sigma}"  # no -0.000


def _number(value: float | None, decimals: int) -> str:
    if value is None:
        return "–"
    return f"{value:.{decimals}f}" if abs(value) < 1e5 else f"{value:.0e}"
