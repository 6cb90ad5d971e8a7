"""The process round an agent: its clocks, what it reads and writes, and journals that do not fit its clock."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dgorl.configuration import Configuration
from dgorl.errors import ConfigurationError
from dgorl.team.intake import LONGEST_LINE
from dgorl.team.json_logs import JsonLines
from dgorl.team.lines import WAITING, LinesIn, LinesOut
from dgorl.team.network import Network
from dgorl.team.pace import Pace, Wall, begin
from dgorl.team.process import Setup, run
from dgorl.team.report import Report, read_report
from dgorl.team.team_file import TeamFile
from dgorl.team.wire_bytes import WireBytes
from dgorl.team.zenoh_transport import ZenohTransport

from .test_zenoh import free_port

ALONE = TeamFile("lab", {"r1": None}, insecure=True, transport=Network(multicast=False))


def run_alone(folder: Path, monkeypatch: pytest.MonkeyPatch, origin: float, until: float) -> list[Report]:
    """What a robot without peers says from ``origin`` to ``until`` [s], at a high rate."""
    with (folder / "said.jsonl").open("wb") as out:
        monkeypatch.setattr(sys, "stdout", out)
        pace = Pace(origin, time.monotonic(), rate=20.0)
        run(Setup("r1", ALONE, folder / "r1.journal", synchronous="normal", pace=pace, until=until, settle=5.0))
        monkeypatch.undo()
    return [read_report(line) for line in (folder / "said.jsonl").read_bytes().splitlines()]


def test_it_ends_when_its_time_has_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = run_alone(tmp_path, monkeypatch, 100.0, 140.0)
    assert [report.final for report in said] == [False] * (len(said) - 1) + [True]
    assert said[-2].stamp == said[-1].stamp == 140.0
    stamps = [report.stamp for report in said[:-1]]
    assert stamps == sorted(set(stamps))
    assert all(stamp % Configuration().period == 0.0 for stamp in stamps)


def test_a_journal_from_the_clocks_future_is_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "dgorl.agent")

    def epoch() -> str:
        (joined,) = [record for record in caplog.records if record.getMessage() == "joined"]
        caplog.clear()
        return joined.fields["epoch"]

    run_alone(tmp_path, monkeypatch, 1000.0, 1004.0)
    first = epoch()
    run_alone(tmp_path, monkeypatch, 1005.0, 1008.0)
    assert epoch() == first
    run_alone(tmp_path, monkeypatch, 10.0, 14.0)
    assert "ahead of the clock" in caplog.text
    assert epoch() != first
    assert (tmp_path / "r1.journal.ahead-1008").is_file()


def test_the_wall_clock_may_jump(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    wall = Wall()
    before = wall.now()
    assert before == pytest.approx(time.time(), abs=0.1)
    assert wall.ahead() == 0.0
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + 3600.0)
    assert wall.ahead() == pytest.approx(3600.0, abs=0.1)
    assert "wall clock jumped" in caplog.text
    assert before <= wall.now() < before + 60.0


class TestLinesIn:
    @pytest.fixture
    def pipe(self) -> Iterator[tuple[LinesIn, int]]:
        reading, writing = os.pipe()
        yield LinesIn(reading), writing
        os.close(reading)

    def test_lines(self, pipe: tuple[LinesIn, int]) -> None:
        lines, end = pipe
        os.write(end, b"one\n\n  \ntwo\nthr")
        reading = iter(lines)
        assert [next(reading), next(reading)] == [b"one", b"two"]
        os.write(end, b"ee\nlast")
        os.close(end)
        assert list(reading) == [b"three", b"last"]

    def test_who_reads_next_misses_nothing(self, pipe: tuple[LinesIn, int]) -> None:
        lines, end = pipe
        os.write(end, b"first\nsecond\n")
        os.close(end)
        assert next(iter(lines)) == b"first"
        assert list(lines) == [b"second"]

    def test_endless_lines_fill_no_memory(self, pipe: tuple[LinesIn, int]) -> None:
        lines, end = pipe
        os.write(end, b"x" * 60_000)
        os.write(end, b"\nnext\n")
        os.close(end)
        long, following = list(lines)
        assert len(long) > LONGEST_LINE  # too long to be taken for a measurement
        assert following == b"next"

    def test_the_first_line_says_when_to_begin(self, pipe: tuple[LinesIn, int]) -> None:
        lines, end = pipe
        os.write(end, b"12.5\nnow\n")
        os.close(end)
        assert begin(lines) == 12.5
        with pytest.raises(ConfigurationError, match="first line"):
            begin(lines)


def test_a_reader_that_does_not_read_stops_nobody(caplog: pytest.LogCaptureFixture) -> None:
    reading, writing = os.pipe()
    out = LinesOut(writing)
    began = time.monotonic()
    for _ in range(WAITING + 200):
        out.write(bytes(1000))
    assert "a line is lost" in caplog.text
    os.close(reading)  # ... and has left now
    out.close()
    os.close(writing)
    assert time.monotonic() - began < 10.0


def test_logs_are_json() -> None:
    try:
        raise RuntimeError("why")
    except RuntimeError:
        record = logging.makeLogRecord(
            {
                "msg": "bad line",
                "levelname": "WARNING",
                "created": 5.0004,
                "fields": {"n": 1},
                "exc_info": sys.exc_info(),
            }
        )
    said = json.loads(JsonLines("r1").format(record))
    assert said.pop("exception").endswith("RuntimeError: why")
    assert said == {"time": 5.0, "level": "warning", "robot": "r1", "event": "bad line", "n": 1}


def test_paces_there_and_back() -> None:
    plain = Pace(10.0, 5.0, rate=20.0)
    assert plain.to_robot(12.3) == plain.to_recording(12.3) == 12.3
    off = Pace(10.0, 5.0, offset=3.0, drift=100.0)
    assert off.to_robot(10.0) == 13.0
    assert off.to_robot(10_010.0) == pytest.approx(10_014.0)
    assert off.to_recording(off.to_robot(512.5)) == pytest.approx(512.5, abs=1e-9)


@pytest.mark.skipif(sys.platform != "linux", reason="counts as the Linux kernel does")
def test_bytes_on_the_wire_are_the_kernels(tmp_path: Path) -> None:
    network = Network({"r1": f"tcp/127.0.0.1:{free_port()}"}, multicast=False)
    listening = ZenohTransport("lab", "r1", network, time.monotonic, tmp_path, ("r1", "r2"))
    try:
        other = ZenohTransport("lab", "r2", network, time.monotonic, tmp_path, ("r1", "r2"))
        count = WireBytes()
        deadline = time.monotonic() + 60.0
        while not (listening.present() and other.present()):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        descriptors = len(list(Path("/proc/self/fd").iterdir()))
        before = count()
        for number in range(10):  # what a busy machine drops under congestion never reaches the wire: once more
            while listening.traffic.received_messages == number:
                assert time.monotonic() < deadline
                other.send("bundles", bytes(10_000))
                again = time.monotonic() + 2.0
                while listening.traffic.received_messages == number and time.monotonic() < again:
                    time.sleep(0.01)
        after = count()
        assert before is not None
        assert after is not None
        assert 100_000 < after - before < 130_000
        assert len(list(Path("/proc/self/fd").iterdir())) == descriptors
        other.close()
    finally:
        listening.close()
