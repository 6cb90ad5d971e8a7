"""The table at the end of a run says who is not located, why, and what would help."""

from __future__ import annotations

from io import StringIO
from typing import Any

from rich.console import Console

from dgorl.cli.table import ROWS, show

FIGURES = dict.fromkeys(("position_rmse_m", "heading_rmse_deg", "tracked_fraction", "coverage_95"), 0.5)


def printed(peers: dict[str, dict[str, dict[str, str]]], **changes: Any) -> str:
    egos = {ego: {**FIGURES, "tick_ms": {"median": 1.0}, "truth_fraction": 1.0, "peers": p} for ego, p in peers.items()}
    summary = {"robots": ["r1", "r2"], "ticks": 3, "initial": "unknown", "measurements": ["rssi"], "team": FIGURES}
    out = StringIO()
    show({**summary, "egos": egos, **changes}, Console(file=out, width=120))
    return out.getvalue()


def seen(status: str, reason: str = "", resolve_by: str = "") -> dict[str, str]:
    return {"status": status, "reason": reason, "resolve_by": resolve_by}


def test_located_peers_need_no_words() -> None:
    assert "Not located" not in printed({"r1": {"r2": seen("tracked"), "r3": seen("position", "heading 30°")}})


def test_reasons_are_said_once_for_peers_alike() -> None:
    two = seen("ambiguous", "two places [left, right]", "turn")
    text = printed(
        {"r1": {"r2": two, "r3": two, "r4": seen("isolated", "silent", "come closer"), "r5": seen("tracked")}}
    )
    (row,) = [line for line in text.splitlines() if "ambiguous" in line]
    assert " ".join(row.split()) == "r1 r2, r3 ambiguous two places [left, right] turn"
    (row,) = [line for line in text.splitlines() if "isolated" in line]
    assert " ".join(row.split()) == "r1 r4 isolated silent come closer"
    assert "r5" not in text


def test_long_lists_are_counted() -> None:
    many = {f"r{k}": seen("ambiguous", f"reason {k}") for k in range(2, ROWS + 5)}
    text = printed({"r1": many})
    assert text.count("ambiguous") == ROWS
    assert "and 3 more" in text


def test_no_truth_and_no_measurements_are_said() -> None:
    text = printed({}, measurements=[])
    assert "nobody can be located" in text
    blind = {"r1": {**FIGURES, "tick_ms": {"median": 1.0}, "truth_fraction": 0.0, "peers": {}}}
    assert "No ground truth" in printed({}, egos=blind)
