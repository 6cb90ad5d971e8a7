"""The table at the end of a run: one row an ego, from summary.json's numbers alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dgorl.cli.terminal import words

LOCATED = ("position", "tracked")
ROWS = 12
"""of peers that are not located: more are counted, not listed"""
ROOMY = 80
"""Columns of a terminal that has room for air between those of a table."""
COLUMNS = ("position\nRMSE [m]", "heading\nRMSE [°]", "located\n[%]", "in 95 %\nellipse [%]", "tick\n[ms]")


def show(summary: Mapping[str, Any], console: Console) -> None:
    """Print the figures of each ego and of the team, or say in words why there are none."""
    robots, egos = summary["robots"], summary["egos"]
    if len(robots) < 2:
        console.print(words(f"{robots[0]} is alone in this log: there is no peer to localise."))
        return
    title = f"{len(robots)} robots, {summary['ticks']} ticks"
    padding = (0, 1) if console.width >= ROOMY else (0, 1, 0, 0)
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", padding=padding)
    table.add_column("ego", overflow="fold")
    for name in COLUMNS:
        table.add_column(Text(name), justify="right", no_wrap=True)
    for ego, figures in egos.items():
        table.add_row(words(ego), *_row(figures, figures["tick_ms"]["median"]))
    if len(egos) > 1:
        table.add_section()
        table.add_row("team", *_row(summary["team"], None), style="bold")
    console.print(table)
    _show_unlocated(egos, console)
    blind = [ego for ego, figures in egos.items() if not figures["truth_fraction"]]
    if blind:
        whom = "these ticks" if len(blind) == len(egos) else ", ".join(blind)
        what = f"No ground truth for {whom}: errors are not known. `dgorl run --truth FILE` scores against one."
        console.print(words(what), soft_wrap=True)
    if summary.get("skipped"):
        left_out = ", ".join(f"{count} × {reason}" for reason, count in summary["skipped"].items())
        console.print(words(f"Left out of the log: {left_out}."), soft_wrap=True)
    if not summary["measurements"]:
        what = "this is dead reckoning from the starts" if summary["initial"] == "known" else "nobody can be located"
        console.print(f"The log has no measurements between robots: {what}.")


def _show_unlocated(egos: Mapping[str, Any], console: Console) -> None:
    """Who is not located at the last tick, why, and what would help."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for ego, figures in egos.items():
        for peer, seen in figures["peers"].items():
            if seen.get("status", LOCATED[0]) not in LOCATED:
                rows.setdefault((ego, seen["status"], seen["reason"], seen["resolve_by"]), []).append(peer)
    if not rows:
        return
    listed = [(ego, ", ".join(peers), *said) for (ego, *said), peers in list(rows.items())[:ROWS]]
    names = sum(max(len(row[k]) for row in listed) + 3 for k in range(3))
    if names > console.width / 2:  # no room for the reasons beside them
        console.print("Not located at the end\n")
        for ego, peers, status, reason, help_ in listed:
            console.print(words(f"  {ego} sees {peers}: {status}: {reason}{help_ and f'; would help: {help_}'}"))
        console.print()
    else:
        table = Table(box=box.SIMPLE_HEAD, title="Not located at the end", title_justify="left")
        for name in ("ego", "peers", "status"):
            table.add_column(name, no_wrap=True)
        table.add_column("why", ratio=3)
        table.add_column("would help", ratio=2)
        for row in listed:
            table.add_row(*map(words, row))
        console.print(table)
    if len(rows) > ROWS:
        console.print(f"… and {len(rows) - ROWS} more rows like these; summary.json has all.")


def _row(figures: Mapping[str, Any], tick_ms: float | None) -> list[str]:
    return [
        _text(figures["position_rmse_m"], 2),
        _text(figures["heading_rmse_deg"], 1),
        _text(figures["tracked_fraction"], 1, 100),
        _text(figures["coverage_95"], 1, 100),
        _text(tick_ms, 1),
    ]


def _text(value: float | None, decimals: int, scale: float = 1.0) -> str:
    return "–" if value is None else f"{scale * value:.{decimals}f}"
