"""What a picture says in words: who is not tracked at its end, why, and what would help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import shorten
from typing import TYPE_CHECKING

from dgorl.estimate import PeerEstimate, Status
from dgorl.measurements import WORLD
from dgorl.plotting.style import GREY

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE = 0.17
"""height of a line [inches]"""
LINES = 8
"""more are counted, not written"""
LETTERS = 16.5
"""that fit in an inch"""


def notes(ego: str, peers: Mapping[str, PeerEstimate]) -> list[str]:
    """A line for peers that are not tracked, those alike together."""
    alike: dict[tuple[str, str, str], list[str]] = {}
    for peer, seen in sorted(peers.items()):
        if peer != WORLD and seen.status is not Status.TRACKED:
            alike.setdefault((seen.status, seen.reason, seen.resolve_by), []).append(peer)
    lines = []
    for (status, reason, resolve_by), names in alike.items():
        why = f": {reason}" if reason else ""
        help_ = f" — would help: {resolve_by}" if resolve_by else ""
        lines.append(f"{ego} → {', '.join(names)} {status}{why}{help_}")
    if len(lines) > LINES:
        lines[LINES - 1 :] = [f"… and {len(lines) - LINES + 1} more"]
    return lines


def height_of(lines: Sequence[str]) -> float:
    """What the lines need at the foot of the page [inches]."""
    return LINE * len(lines) + 0.1 if lines else 0.0


def write_notes(figure: Figure, lines: Sequence[str]) -> None:
    """Write the lines at the foot of the page."""
    width, height = figure.get_size_inches()
    for k, line in enumerate(reversed(lines)):
        text = shorten(line, int(LETTERS * width), placeholder=" …")
        figure.text(0.12 / width, (0.09 + k * LINE) / height, text, fontsize=8, color=GREY, va="bottom")
