"""Tables fit terminals of 60 and 80 columns: no name is cut, and no line is longer."""

from __future__ import annotations

from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from dgorl.cli import paper, table, watch_table
from dgorl.evaluation.claims import Claim

NAMES = "turtlebot-alpha-1", "turtlebot-bravo-2"
REASON = "position 1σ 1.71 m exceeds 1.00 m: its bearing from turtlebot-alpha-1 with its heading not known well enough"


def shown(width: int, what: Any) -> str:
    file = StringIO()
    what(Console(width=width, file=file))
    return file.getvalue()


def whole(name: str, text: str) -> bool:
    """Whether a name stands there, on one line or folded."""
    return name in text or all(part in text for part in (name[:6], name[-2:]))


def figures(peer: str) -> dict[str, Any]:
    peers = {peer: {"status": "unobservable", "reason": REASON, "resolve_by": "turtlebot-alpha-1: turn left"}}
    return {
        "position_rmse_m": 112.25, "heading_rmse_deg": 103.4, "tracked_fraction": 1.0, "coverage_95": 1.0,
        "tick_ms": {"median": 12.2}, "truth_fraction": 1.0, "peers": peers,
    }  # fmt: skip


@pytest.mark.parametrize("width", [60, 80, 120])
def test_run(width: int) -> None:
    egos = {NAMES[0]: figures(NAMES[1]), NAMES[1]: figures(NAMES[0])}
    summary = {
        "robots": NAMES, "ticks": 30, "egos": egos, "team": figures(NAMES[0]), "measurements": ["range"],
        "initial": "unknown", "skipped": {"odometry stamped before the row it follows (Robot3_Odometry.dat:7)": 1},
    }  # fmt: skip
    text = shown(width, lambda console: table.show(summary, console))
    said = text.partition("Left out of the log:")[0]
    assert max(map(len, said.splitlines())) <= width
    assert "…" not in text
    assert all(whole(name, said) for name in NAMES)
    assert all(part in said for part in ("112.25", "in 95 %", "would help"))
    assert "Left out of the log: 1 × odometry stamped before the row it follows (Robot3_Odometry.dat:7)." in text


@pytest.mark.parametrize("width", [60, 80, 120])
def test_monitor(width: int) -> None:
    seen = {"pose": (12.25, -30.5, 3.0), "status": "unobservable", "position_sigma_m": 1.25, "heading_sigma_deg": 12.0,
            "age_s": 0.5, "reason": "", "resolve_by": ""}  # fmt: skip
    robots = {
        name: {
            "says": {"s_ago": 0.5, "sent_bytes_per_s": 1234.0, "peers": {peer: seen}, "loss": {peer: 0.25}},
            "clock": {"ahead_s": 0.001, "sigma_s": 0.001}, "same_team_file": True, "present": True, "heard_s_ago": 0.5,
            "rejected_here": {}, "lives_twice": [],
        }
        for name, peer in (NAMES, NAMES[::-1])
    }  # fmt: skip
    state = {"team": "lab", "robots": robots, "strangers": [], "nameless": 0}
    text = shown(width, lambda console: console.print(watch_table.tables(state, None)))
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert all(whole(name, text) for name in NAMES)
    assert all(part in text for part in ("unobservable", "12.2"))
    assert ("sent" in text) == (width >= 100)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_paper(width: int) -> None:
    claim = Claim("mean error of DGORL is smaller than that of covariance intersection", "0.36 m", 0.41, "m")
    text = shown(width, lambda console: paper._show([claim, claim], console))
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    for word in claim.claim.split():
        assert word in text
