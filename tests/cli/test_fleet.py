"""`dgorl fleet`: agents on this machine estimate what a replay of the log does, and survive what is done to them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from dgorl import logs
from dgorl.measurements import known_at
from dgorl.team.journal_data import held, parse
from dgorl.team.journal_read import contents
from tests.recordings import ROOT, recording

from .commandline import Dgorl, fails_well

PARTED = (("r1", "r2"), ("r4", "r3"), ("r1", "r4"), ("r3", "r2"))
"""Two pairs of robots of one side, two of robots of both."""


def table(folder: Path, ego: str, peer: str) -> list[dict[str, str]]:
    with (folder / "relative" / ego / f"{peer}.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def log(dgorl: Dgorl, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots, 10 s."""
    log = tmp_path_factory.mktemp("logs") / "three"
    done = dgorl("simulate", "--robots", 3, "--steps", 20, "--area", 20, "--sensors", "rssi,range", "--out", log)
    assert done.returncode == 0, done.stderr
    return log


def run(dgorl: Dgorl, *words: object) -> tuple[dict[str, Any], str]:
    done = dgorl("fleet", *words, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


def assert_same_end(fleet: Path, alone: Path, members: set[str]) -> None:
    """The fleet's last estimates are those of a run, to the bit."""
    final = json.loads((fleet / "final.json").read_text())
    assert final["egos"].keys() | {"world"} == members
    for ego, peers in final["egos"].items():
        assert set(peers) == members - {ego}
        for peer, said in peers.items():
            row = table(alone, ego, peer)[-1]
            assert float(row["t"]) == final["stamp"]
            assert [float(row[name]) for name in ("x", "y", "theta")] == said["pose"]
            assert row["status"] == said["status"]


def test_a_good_network_gives_what_a_replay_gives(dgorl: Dgorl, log: Path, tmp_path: Path) -> None:
    fleet, alone = tmp_path / "fleet", tmp_path / "run"
    summary, words = run(dgorl, log, "--rate", 5, "--initial", "known", "--out", fleet)
    assert summary["checks"] == {"robots": ["r1", "r2", "r3"], "equal_data": True, "equal_estimates": True}
    assert "Data: equal (r1, r2, r3)" in words
    assert dgorl("run", log, "--initial", "known", "--out", alone).returncode == 0
    assert_same_end(fleet, alone, {"r1", "r2", "r3", "world"})
    rows = table(fleet, "r1", "r2")
    assert [float(row["t"]) for row in rows] == sorted({float(row["t"]) for row in rows})
    assert parse(rows[-1]["data"]).keys() >= {("r1", key[1]) for key in parse(rows[0]["data"]) if key[0] == "r1"}
    for traffic in summary["traffic"].values():
        assert 0 < traffic["payload_bytes_per_s"] < 4000
        assert traffic["wire_bytes_per_s"] is None or traffic["wire_bytes_per_s"] > traffic["payload_bytes_per_s"] / 2
        assert traffic["bundles"] > 0
    assert (fleet / "figures" / "trajectories.png").is_file()


def test_on_a_bad_network_with_a_power_cut_and_a_latecomer(dgorl: Dgorl, tmp_path: Path) -> None:
    # Long enough for robots whose programs take seconds to start, on a busy machine.
    size = ("--simulation.robots", 3, "--simulation.steps", 48, "--simulation.area", 20)
    team = ("--simulate", *size, "--simulation.sensors", "rssi,range")
    faults = ("--loss", 0.3, "--delay", "0-0.3", "--duplicate", 0.2, "--reorder", 0.2, "--topology", "line")
    events = ("--kill", "r2@3", "--join", "r2@5", "--join", "r3@2", "--partition", "r1|r2,r3:6-8")
    summary, _ = run(dgorl, *team, "--rate", 3, "--settle", 20, *faults, *events, "--out", tmp_path)
    assert summary["checks"]["robots"] == ["r1", "r2", "r3"]
    assert summary["checks"]["equal_data"]
    assert summary["checks"]["equal_estimates"]
    assert float(table(tmp_path, "r3", "r1")[0]["t"]) >= 2.0
    held = parse(table(tmp_path, "r2", "r1")[-1]["data"])
    assert [robot for robot, _ in held].count("r2") == 1  # the epoch went on


def test_both_sides_of_a_partition_go_on_and_meet_again(dgorl: Dgorl, tmp_path: Path) -> None:
    size = ("--simulation.robots", 4, "--simulation.steps", 50, "--simulation.area", 20)
    team = ("--simulate", *size, "--simulation.odometry-noise", 0.2)
    words = (*team, "--simulation.sensors", "range", "--initial", "known", "--partition", "r1,r2|r3,r4:5-15")
    summary, _ = run(dgorl, *words, "--rate", 4, "--out", tmp_path)
    assert summary["checks"] == {"robots": ["r1", "r2", "r3", "r4"], "equal_data": True, "equal_estimates": True}
    apart = {pair: [row for row in table(tmp_path, *pair) if 7.0 <= float(row["t"]) < 15.0] for pair in PARTED}
    for (ego, peer), rows in apart.items():
        ages = [float(row["age"]) for row in rows]
        if (ego, peer) in PARTED[:2]:
            # Rows stamped at a tick come after it now and then; how a random walk went on is not known then.
            assert sum(row["status"] in ("position", "tracked") for row in rows) > len(rows) / 2
            assert median(ages) < 2.0
        else:
            assert max(ages) > 7.0
    assert float(table(tmp_path, "r1", "r4")[-1]["age"]) < 2.0


def test_no_bundle_is_lost_or_renamed_when_every_agent_is_killed(dgorl: Dgorl, log: Path, tmp_path: Path) -> None:
    lives = [(f"r{k % 3 + 1}", 1.13 + 1.31 * k) for k in range(6)]
    events = [word for robot, t in lives for word in ("--kill", f"{robot}@{t:.2f}", "--join", f"{robot}@{t + 0.7:.2f}")]
    summary, _ = run(dgorl, log, "--rate", 2, *events, "--out", tmp_path)
    assert summary["checks"] == {"robots": ["r1", "r2", "r3"], "equal_data": True, "equal_estimates": True}
    journals = [contents(tmp_path / "live" / f"{robot}.journal") for robot in ("r1", "r2", "r3")]
    assert all(journal.bundles == journals[0].bundles for journal in journals)  # contents, too
    assert [len(journal.stories) for journal in journals] == [3, 3, 3]
    numbers = held(journals[0].bundles)
    assert [robot for robot, _ in sorted(numbers)] == ["r1", "r2", "r3"]  # every epoch went on
    assert all(len(sequence) == 1 and sequence.low == 0 for sequence in numbers.values())


@pytest.mark.slow
def test_real_robots_twenty_times_as_fast(dgorl: Dgorl, tmp_path: Path) -> None:
    whole = logs.read(recording("mrclam6"), ("range", "bearing"))
    end = min(map(known_at, whole.measurements)) + 80.0
    path = tmp_path / "log"
    logs.write(replace(whole, measurements=tuple(m for m in whole.measurements if known_at(m) <= end)), path)
    words = (path, "--initial", "known", "--config", ROOT / "configs" / "mrclam.yaml", "--out")
    summary, _ = run(dgorl, *words, tmp_path / "fleet", "--rate", 20)
    assert summary["checks"]["equal_estimates"]
    assert dgorl("run", *words, tmp_path / "run").returncode == 0
    assert_same_end(tmp_path / "fleet", tmp_path / "run", {"r1", "r2", "r3", "r4", "r5", "world"})


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ((), "give a log or --simulate"),
        (("--simulate", "--kill", "r9@3"), "unknown robot `r9`; the robots are r1, r2"),
        (("--simulate", "--kill", "r1@soon"), "must end in a number"),
        (("--simulate", "--clock-offset", "r1=nan"), "must end in a number"),
        (("--simulate", "--partition", "r1,r2"), "must be like A,B|C,D:10-20"),
        (("--simulate", "--loss", "1.5"), "loss must be from 0 to 1"),
        (("--simulate", "--delay", "slow"), "delay needs seconds like 0.1-0.5"),
        (("--simulate", "--delay", "0.1.2"), "delay needs seconds like 0.1-0.5"),
        (("--simulate", "--delay", "0.5-0.1"), "the smaller first, got '0.5-0.1'"),
        (("--simulate", "--partition", "r1|r2:9-3"), "the smaller first, got '9-3'"),
        (("--simulate", "--rate", "0"), "rate must be at least"),
        (("--simulate", "--join", "r1@1", "--join", "r1@2"), "r1 must be killed before it can join again"),
    ],
)
def test_what_is_wrong_is_said(dgorl: Dgorl, tmp_path: Path, words: tuple[str, ...], what: str) -> None:
    assert what in fails_well(dgorl("fleet", *words, "--out", tmp_path / "out"))
