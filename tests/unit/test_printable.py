"""Nothing that comes from outside reaches a terminal, a log or a page unescaped, whichever way it takes."""

from __future__ import annotations

import io
import json
import logging
import os
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl.cli import doctor, table, watch_table
from dgorl.cli.main import main
from dgorl.cli.terminal import terminal
from dgorl.findings import problem
from dgorl.printable import MARKS, json_line, printable, printable_line
from dgorl.team.json_logs import JsonLines
from dgorl.team.lines import LinesOut
from dgorl.team.report import Complaint

NASTY = st.sampled_from(
    ["\x1b[2J\x1b[31m", "\r", "\n✓ network all is well", "\x9b31m", "\x7f\b\b", "\u202egnp", "\u2028", "[red]x[/]",
     ":x:", "\x1b]0;title\x07", "\ud800", "\x00", "\x85✗", "\t"]
)  # fmt: skip
TEXT = st.lists(st.one_of(NASTY, st.text(max_size=8)), max_size=6).map("".join)
CLEAN = {"\n"}


def shown(text: str, own_marks: int = 0) -> None:
    """Fails if a terminal would do anything but show it."""
    assert all(c.isprintable() or c in CLEAN for c in text), repr(text)
    assert sum(text.count(mark) for mark in MARKS) == own_marks, repr(text)


def printed(act: Callable[[], object]) -> str:
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(out):
        act()
    return out.getvalue()


@given(TEXT)
def test_escaping_is_done_once_and_keeps_what_can_be_seen(text: str) -> None:
    escaped = printable(text)
    shown(escaped)
    assert printable(escaped) == escaped
    if text.isprintable() and not set(text) & set(MARKS):
        assert escaped == text


@given(TEXT, TEXT)
def test_json_means_the_same(key: str, value: str) -> None:
    line = json_line({key: [value]})
    shown(line)
    assert json.loads(line) == {key: [value]}


@given(TEXT, TEXT)
def test_doctor(what: str, advice: str) -> None:
    def act() -> None:
        console = terminal()
        doctor._show(problem("network", what, advice), console)

    text = printed(act)
    shown(text, own_marks=1)
    assert text.count("\n") == 1
    assert text.startswith("✗ ")


def robot(name: str, text: str) -> dict[str, object]:
    peer = {
        "status": text, "pose": [1.0, 2.0, 0.5], "position_sigma_m": 0.1, "heading_sigma_deg": 1.0, "probability": 1.0,
        "age_s": 0.1, "reason": text, "resolve_by": text,
    }  # fmt: skip
    says = {
        "s_ago": 0.1, "version": text, "present": [text], "loss": {text: 0.1}, "sent_bytes_per_s": 1,
        "rejected": {text: 1}, "tick_ms": 1.0, "peers": {text: peer},
    }  # fmt: skip
    return {
        "present": False, "heard_s_ago": 9.0, "epoch": text, "same_team_file": False, "rejected_here": {text: 2},
        "lives_twice": [text],
        "clock": {"ahead_s": 0.0, "sigma_s": None}, "says": says, "name": name,
    }  # fmt: skip


@settings(deadline=None, max_examples=30)
@given(TEXT)
def test_monitor(text: str) -> None:
    state = {"team": text, "clock": "shared", "strangers": [text], "nameless": 3, "robots": {"r1": robot("r1", text)}}

    def act() -> None:
        for ego in (None, "r1"):
            terminal(width=200).print(watch_table.tables(state, ego))

    shown(printed(act))


@settings(deadline=None, max_examples=30)
@given(TEXT)
def test_the_table_of_a_run(text: str) -> None:
    peer = {"status": "isolated", "reason": text, "resolve_by": text}
    figures = {
        "position_rmse_m": None, "heading_rmse_deg": None, "tracked_fraction": None, "coverage_95": None,
        "truth_fraction": 0.0, "tick_ms": {"median": 1.0}, "peers": {text: peer},
    }  # fmt: skip
    summary = {"robots": [text, "b"], "ticks": 3, "egos": {text: figures, "b": figures}, "team": figures}
    for robots in ([text, "b"], [text]):
        given_summary = {**summary, "robots": robots, "measurements": ["range"], "initial": "known"}
        shown(printed(lambda given=given_summary: table.show(given, terminal(width=200))))


@given(TEXT, TEXT)
def test_logs_and_answers_of_an_agent(event: str, value: str) -> None:
    record = logging.LogRecord("dgorl.agent", logging.WARNING, "", 0, event.replace("%", ""), None, None)
    record.fields = {"what": value}
    line = JsonLines("r1").format(record)
    shown(line)
    assert "\n" not in line
    complaint = Complaint(value, "").text() if "\ud800" not in value else b"{}"
    shown(printable_line(complaint).decode())


def test_what_an_agent_answers_leaves_escaped() -> None:
    reading, writing = os.pipe()
    out = LinesOut(writing)
    out.write(Complaint("no", "\x9b31m\x7f ✓ \x1b[2J").text())
    out.close()
    os.close(writing)
    with os.fdopen(reading, "rb") as end:
        said = end.read().decode()
    shown(said)
    assert json.loads(said)["line"] == "\x9b31m\x7f ✓ \x1b[2J"


FILES: dict[str, Callable[[str], str]] = {
    "team.yaml": lambda text: f"robots: [r1, r2]\n{json.dumps(text)}: {json.dumps(text)}\n",
    "names.yaml": lambda text: f"robots: [{json.dumps(text)}, r2]\n",
    "odometry.csv": lambda text: f"start,end,robot,v,omega\n0,0.1,{text},1,0\n",
    "header.csv": lambda text: f"{text}\n0,0.1,r1,1,0\n",
    "log.pyfg": lambda text: f"VERTEX_SE2 0.0 {text} 0 0 0\n{text} 1 2 3\n",
}


@pytest.mark.parametrize("kind", FILES)
@settings(deadline=None, max_examples=20)
@given(text=TEXT, name=TEXT)
def test_errors_that_quote_files_and_their_names(kind: str, text: str, name: str) -> None:
    with TemporaryDirectory() as place:
        folder = Path(place) / (name.replace("/", "").replace("\x00", "").replace("\ud800", "")[:40] or "log")
        folder.mkdir(exist_ok=True)
        content = FILES[kind](text).encode(errors="replace")
        path = folder / ("odometry.csv" if kind == "header.csv" else "team.yaml" if kind == "names.yaml" else kind)
        if kind in ("odometry.csv", "header.csv"):
            (folder / "team.yaml").write_text("robots: [r1, r2]\n")
        path.write_bytes(content)
        log = path if kind == "log.pyfg" else folder
        for command in (["run", str(log), "--out", str(folder / "out")], ["doctor", str(log)], ["run", "x", str(log)]):
            out = io.StringIO()
            with redirect_stdout(out), redirect_stderr(out), suppress(SystemExit):
                main(command)
            said = out.getvalue()
            own = sum(line.startswith(("✓", "✗")) for line in said.splitlines()) if command[0] == "doctor" else 0
            shown(said, own)
