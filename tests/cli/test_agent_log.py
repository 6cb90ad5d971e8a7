"""What an agent's log says, and how little of what comes again and again; all of it JSON."""

from __future__ import annotations

import json
import signal
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from dgorl.measurements import Odometry
from dgorl.team.intake import line_of

from .commandline import Dgorl
from .live_team import live_team

GARBAGE = 3000
STOPPED = 6.0


def records(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def wait(path: Path, well: Callable[[list[dict]], bool]) -> list[dict]:
    deadline = time.monotonic() + 60
    while not well(found := records(path)) and time.monotonic() < deadline:
        time.sleep(0.3)
    return found


def test_the_first_of_a_kind_then_counts(tmp_path: Path) -> None:
    """Garbage, a neighbour with another team.yaml, a stop, odometry from a clock that was set back."""
    log = tmp_path / "r1.log"
    with live_team(tmp_path) as team:
        team.start("r1")
        team.start("r3", team.write("other.yaml", {"history": 90.0}))
        wait(log, lambda found: any(record["event"] == "a message was not taken" for record in found))
        agent = team.robots["r1"]
        agent.stdin.write(b"".join(b"nonsense %d \x1b[2J\n" % k for k in range(GARBAGE)))
        agent.stdin.flush()
        wait(log, lambda found: any(record["event"] == "bad line" for record in found))
        agent.send_signal(signal.SIGSTOP)
        time.sleep(STOPPED)
        agent.send_signal(signal.SIGCONT)
        now = time.time() - 2.0
        for k in range(5):
            agent.stdin.write(line_of(Odometry("r1", now + 0.1 * k, now + 0.1 * k + 0.1, 1.0, 0.0)) + b"\n")
        agent.stdin.flush()
        wait(log, lambda found: any(record["event"].startswith("odometry overlaps") for record in found))
        agent.terminate()
        agent.wait(20)
    found = records(log)
    assert {"time", "level", "robot", "event"} <= set.intersection(*(set(record) for record in found))
    assert len(found) < 40
    events = Counter(record["event"] for record in found if "times" not in record)
    assert events["bad line"] == 1
    told = sum(record.get("times", 1) for record in found if record["event"] == "bad line")
    assert told == GARBAGE, "the rest is counted when the agent leaves at the latest"
    (stop,) = (record for record in found if record["event"].startswith("no time"))
    assert STOPPED - 0.5 <= stop["for_s"] < STOPPED + 20
    (first, *_) = (record for record in found if record["event"].startswith("odometry overlaps"))
    assert 1.0 < first["by_s"] < 3.5
    (neighbour,) = (r for r in found if r["event"] == "a message was not taken" and r.get("from") == "r3")
    assert "other configuration" in neighbour["what"]


@pytest.mark.parametrize(
    ("arguments", "code", "what"),
    [
        ((), 2, "the following arguments are required"),
        (("--robot", "r1", "--team", "none.yaml"), 1, "none.yaml: cannot be read"),
        (("--robot", "r1", "--team", "none.yaml", "--rat"), 2, "--rat"),
    ],
)
def test_errors_are_json_too(dgorl: Dgorl, tmp_path: Path, arguments: tuple[str, ...], code: int, what: str) -> None:
    done = dgorl("agent", *arguments, cwd=tmp_path)
    assert done.returncode == code
    assert done.stdout == ""
    (record,) = (json.loads(line) for line in done.stderr.splitlines())
    assert record["level"] == "critical"
    assert what in record["event"]


def test_interrupted_it_says_so_in_json(tmp_path: Path) -> None:
    with live_team(tmp_path) as team:
        team.start("r1")
        wait(tmp_path / "r1.log", lambda found: any(record["event"] == "joined" for record in found))
        team.robots["r1"].send_signal(signal.SIGINT)
        assert team.robots["r1"].wait(20) == 130
    assert records(tmp_path / "r1.log")[-1]["event"] == "left"
