"""What a doctor says of logs, journals and installations: every finding has a log that causes it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dgorl import installation, logs
from dgorl.findings import Finding, Level
from dgorl.logs.checkup import checkup
from dgorl.logs.log import Log, Start
from dgorl.measurements import Odometry, Range, Rssi
from dgorl.team.bundler import Bundler
from dgorl.team.journal import Journal
from dgorl.team.journal_checkup import journal_checkup
from dgorl.team.keys import UNSIGNED, Roster
from dgorl.team.wire import seal

ROBOTS = "r1", "r2", "r3"


def driven(robot: str, first: float = 0.0, last: float = 20.0) -> list[Odometry]:
    return [Odometry(robot, first + k, first + k + 1.0, 0.2, 0.0) for k in range(int(last - first))]


def heard(a: str, b: str, first: float = 0.0, last: float = 20.0) -> list[Rssi]:
    """b hears a."""
    return [Rssi(a, b, first + k, -60.0) for k in range(int(last - first))]


PAIRS = [(a, b) for a in ROBOTS for b in ROBOTS if a != b]
MOVES = [row for robot in ROBOTS for row in driven(robot)]
READINGS = [row for a, b in PAIRS for row in heard(a, b)]


def log(*measurements: object, robots: tuple[str, ...] = ROBOTS, **changes: object) -> Log:
    starts = {robot: Start(0.0, (0.0, 0.0, 0.0)) for robot in robots}
    return Log(Path("lab"), robots, tuple(measurements), **{"starts": starts, **changes})


def said(findings: tuple[Finding, ...], level: Level) -> list[str]:
    return [f.what for f in findings if f.level == level]


def test_a_good_log_is_well_and_described() -> None:
    findings = checkup(log(*MOVES, *READINGS, truth={"r1": None}))
    assert said(findings, Level.PROBLEM) == said(findings, Level.NOTE) == []
    told = said(findings, Level.OK)
    assert told[0] == "lab: 3 robots (r1, r2, r3), 20.0 s from 0 s on"
    assert "r2: 20 rows of odometry, 1.0 a second" in told
    assert "rssi: 120 readings in 6 directions, median 1 a second each" in told


@pytest.mark.parametrize(
    ("odd", "level", "what"),
    [
        (log(), Level.PROBLEM, "lab: has no measurements"),
        (
            log(*MOVES, *READINGS, *(Rssi("r1", "r2", 3.0 + k / 80, -60.0 - k) for k in range(1, 80))),
            Level.NOTE,
            "rssi: r2 measured r1 up to 80 times in a second, of which 50 count",
        ),
        (log(*driven("r1"), robots=("r1",)), Level.PROBLEM, "one robot alone"),
        (log(*MOVES), Level.PROBLEM, "no measurement between robots"),
        (log(*MOVES, *heard("r1", "r2")), Level.PROBLEM, "no reading links r3 to the others"),
        (log(*MOVES, *heard("r1", "r2"), *heard("r2", "r3")), Level.NOTE, "r1 and r3 never hear each other"),
        (log(*MOVES, *heard("r1", "r2"), *heard("r2", "r3")), Level.NOTE, "r1 never hears r2, who hear it"),
        (log(*driven("r1"), *driven("r2"), *READINGS), Level.NOTE, "r3: no odometry, so nobody can locate it"),
        (
            log(*MOVES, *driven("r1", 25.5, 40.0), *READINGS),
            Level.NOTE,
            "r1: odometry is missing 1 times for over 1 s, longest for 5.5 s from 20 s on",
        ),
        (log(*MOVES, *READINGS, starts={"r1": Start(0.0, (0.0, 0.0, 0.0))}), Level.NOTE, "no start pose of r2, r3"),
        (log(*MOVES, *READINGS), Level.NOTE, "no ground truth"),
        (log(*MOVES, *READINGS, skipped={"landmarks": 7}), Level.NOTE, "7 left out: landmarks"),
        (
            log(*driven("r1"), *driven("r2"), *driven("r3", 1000.0, 1020.0), *heard("r1", "r3", 1000.0, 1010.0)),
            Level.PROBLEM,
            "r3: stamped 1000 to 1020 s, at no time with the others (1 to 20 s): the clocks differ by 999 s",
        ),
        (log(*MOVES, *READINGS, *driven("r2", 1e6, 1e6 + 2)), Level.PROBLEM, "r2: its clock jumps by 999981 s at 20 s"),
        (
            log(*MOVES, *READINGS, *driven("r2", 21.0, 50.0)),
            Level.NOTE,
            "r2: there from 0 to 50 s, most from 0 to 20 s",
        ),
    ],
)
def test_what_is_odd_is_said(odd: Log, level: Level, what: str) -> None:
    assert any(line.startswith(what) for line in said(checkup(odd), level)), checkup(odd)


def test_a_range_links_both() -> None:
    ranges = [Range("r1", "r2", 1.0, 3.0, 0.1), Range("r2", "r3", 1.0, 3.0, 0.1), Range("r3", "r1", 2.0, 3.0, 0.1)]
    assert not any("never" in line for line in said(checkup(log(*MOVES, *ranges)), Level.NOTE))


def test_own_clocks_need_not_agree() -> None:
    odd = log(*driven("r1"), *driven("r2", 1000.0, 1020.0), *heard("r1", "r2"), configuration={"clock": "estimated"})
    assert not any("stamped" in line for line in said(checkup(odd), Level.PROBLEM))


@pytest.mark.parametrize("by", [-4000.0, 95.0, 7205.0])
def test_odometry_on_another_clock_than_the_readings(by: float) -> None:
    odd = log(*driven("r1"), *driven("r2", by, by + 20), *driven("r3"), *READINGS)
    (line,) = (line for line in said(checkup(odd), Level.PROBLEM) if line.startswith("odometry of r2"))
    assert line.endswith(f"share no time: the clocks differ by {abs(by):.0f} s")


@pytest.mark.parametrize("by", [-900.0, 3600.0])
def test_all_odometry_on_another_clock_than_the_readings(by: float) -> None:
    odd = log(*driven("r1", by, by + 20), *driven("r2", by, by + 20), *READINGS)
    lines = [line for line in said(checkup(odd), Level.PROBLEM) if line.startswith("odometry of r")]
    assert lines
    for line in lines:
        told = float(line.rsplit("the clocks differ by ", 1)[1].removesuffix(" s"))
        assert abs(told - abs(by)) <= 2.0, line


def test_held_twists_are_counted_as_rows(tmp_path: Path) -> None:
    rows = [(t, robot) for t in (0, 1, 2, 3, 9, 10) for robot in ROBOTS if robot != "r2" or t not in (2, 3)]
    text = "t,robot,v,omega\n" + "".join(f"{t},{robot},0.2,0\n" for t, robot in rows)
    ranges = "t,from,to,range,sigma\n1,r1,r2,3,\n1,r2,r3,3,\n"
    for name, what in (("team.yaml", "robots: [r1, r2, r3]\n"), ("odometry.csv", text), ("ranges.csv", ranges)):
        (tmp_path / name).write_text(what)
    findings = checkup(logs.read(tmp_path))
    assert [line for line in said(findings, Level.OK) if "rows" in line] == [
        "r1: 6 rows of odometry, 0.6 a second",
        "r2: 4 rows of odometry, 0.4 a second",
        "r3: 6 rows of odometry, 0.6 a second",
    ]
    assert "r2: odometry is missing 1 times for over 1 s, longest for 7.0 s from 2 s on" in said(findings, Level.NOTE)
    assert "r1: odometry is missing 1 times for over 1 s, longest for 5.0 s from 4 s on" in said(findings, Level.NOTE)


class TestInstallation:
    def test_this_one_is_well(self) -> None:
        assert said(installation.installation(), Level.PROBLEM) == []

    def test_a_core_that_fails_or_errs_is_a_problem(self) -> None:
        def fails() -> float:
            raise ImportError("no _core")

        assert installation._core(fails).what == "the compiled core does not work: ImportError: no _core"
        assert "off by 0.5 m" in installation._core(lambda: 0.5).what
        assert installation._core(lambda: float("nan")).level == Level.PROBLEM

    def test_what_is_missing_is_named_with_its_pip_line(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(installation, "OPTIONAL", {"no_such_module": "pictures"})
        monkeypatch.setattr(installation, "REQUIRED", ("numpy", "no-such-package"))
        monkeypatch.setattr(installation, "DESCRIPTORS", 10**9)
        found = installation.installation()
        assert [f.advice for f in found if f.level == Level.NOTE] == [f"{sys.executable} -m pip install no_such_module"]
        problems = said(found, Level.PROBLEM)
        assert problems[0] == "not installed: no-such-package"
        assert problems[1].startswith("a program may open")


class TestJournal:
    ROSTER = Roster("lab", {"r1": None, "r2": None}, insecure=True)

    def written(self, path: Path, *, ticks: tuple[float, ...] = (0.5, 1.0)) -> Journal:
        journal = Journal.open(path, "r1", self.ROSTER, settings={}, keep=100.0, synchronous="normal")
        bundler = Bundler("lab", "r1", journal.epoch)
        for now in ticks:
            bundler.add(Odometry("r1", now - 0.5, now, 0.1, 0.0))
            own = [seal(bundle, UNSIGNED) for bundle in bundler.cut(now)]
            journal.commit_own(*own)
            journal.tick(now, own)
        journal.flush()
        return journal

    def test_a_sound_one_is_described_while_in_use_and_after(self, tmp_path: Path) -> None:
        journal = self.written(tmp_path / "r1.journal")
        during = journal_checkup(journal.path)
        journal.close()
        after = journal_checkup(journal.path)
        assert said(during, Level.PROBLEM) == said(during, Level.NOTE) == []
        assert during[0].what.endswith("in use by an agent")
        assert after[0].what.endswith("no agent has it open")
        assert after[0].what.startswith(f"{journal.path}: of r1 in team lab")
        assert after[1].what == "2 estimates in 1 runs, from 0.5 to 1.0 s of its clock"
        assert after[2].what == f"r1:{journal.epoch:016x}: 2 bundles, 0 to 1"

    def test_a_damaged_one_is_a_problem_and_stays(self, tmp_path: Path) -> None:
        journal = self.written(tmp_path / "r1.journal")
        journal.close()
        data = bytearray(journal.path.read_bytes())
        data[4096:8192] = b"\x55" * 4096
        journal.path.write_bytes(data)
        (finding,) = journal_checkup(journal.path)
        assert finding.level == Level.PROBLEM
        assert "damaged" in finding.what
        assert journal.path.read_bytes() == data

    def test_none_and_another_file(self, tmp_path: Path) -> None:
        other = tmp_path / "notes.txt"
        other.write_text("hello")
        assert said(journal_checkup(tmp_path / "gone"), Level.PROBLEM) == [f"{tmp_path / 'gone'}: no such file"]
        assert said(journal_checkup(other), Level.PROBLEM) == [f"{other}: not a journal"]

    def test_a_mark_that_is_missing_and_a_clock_that_went_back(self, tmp_path: Path) -> None:
        journal = self.written(tmp_path / "r1.journal", ticks=(5.0, 5.5))
        journal.tick(2.0, [])
        journal.close()
        (tmp_path / "r1.journal-mark").unlink()
        notes = said(journal_checkup(journal.path), Level.NOTE)
        assert notes[0] == "its clock went back 1 times, first at 5.5 s"
        assert notes[1].endswith("-mark is missing: its agent will begin a new epoch")

    def test_a_full_disk(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.written(tmp_path / "r1.journal").close()
        monkeypatch.setattr("dgorl.team.journal_checkup.ROOM", 2**80)
        assert "MiB are left on its disk" in said(journal_checkup(tmp_path / "r1.journal"), Level.PROBLEM)[0]
