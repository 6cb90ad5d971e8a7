"""The table of ``dgorl monitor``, from a snapshot's numbers alone."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees
from typing import Any

from rich import box
from rich.console import Group, RenderableType
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
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
        table.add_column("robot", no_wrap=True)
        for name in COLUMNS:
            table.add_column(Text(name), justify="left" if name in WORDS else "right", no_wrap=True)
        for name, robot in told.items():
            _add(table, name, robot)
            table.add_section()
        parts.append(table)
    if ego is not None and told:
        parts.extend(_reasons(told[ego]["says"]["peers"]))
    parts.extend(words(line, style="yellow") for line in remarks(state) if ego is None or line.startswith(f"{ego}:"))
    return Group(*parts)


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


def _add(table: Table, name: str, robot: Mapping[str, Any]) -> None:
    says = robot["says"]
    silent = says["s_ago"] >= STALE
    head = name, _clock(robot["clock"]), _number(says["sent_bytes_per_s"], 0)
    if not says["peers"]:
        table.add_row(*head, "nobody", style=GREY if silent else "")
    for peer, seen in says["peers"].items():
        x, y, theta = seen["pose"] or (None, None, None)
        stale = silent or (seen["age_s"] or 0.0) >= STALE
        table.add_row(
            *head,
            words(peer),
            words(seen["status"], style="" if stale else COLORS.get(seen["status"], "")),
            _number(x, 1),
            _number(y, 1),
            _number(None if theta is None else degrees(theta), 0),
            _number(seen["position_sigma_m"], 2),
            _number(seen["heading_sigma_deg"], 0),
            _number(seen["age_s"], 1),
            _number(100 * says["loss"][peer] if peer in says["loss"] else None, 0),
            style=GREY if stale else "",
        )
        head = "", "", ""


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
