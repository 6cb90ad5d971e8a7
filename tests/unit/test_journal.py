"""The journal: what was sent is there, its numbers are never used again, whatever happens to process and files."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import pytest

from dgorl.measurements import WORLD, RelativePose
from dgorl.team import journal_mark
from dgorl.team.journal import Journal
from dgorl.team.journal_read import contents
from dgorl.team.journal_schema import JournalError
from dgorl.team.keys import Roster
from dgorl.team.wire import open_sealed, seal
from tests.unit import committer
from tests.unit.committer import ROSTER, begun, made

PARTS = ("", "-wal", "-shm", "-mark")
START = RelativePose(WORLD, "r1", 0.0, 1.0, 2.0, 0.5, (0.01, 0.0, 0.0, 0.01, 0.0, 0.001), prior=True)


MEMORY = Path("/dev/shm")
"""A folder in memory, if there is one: what is forced onto the disk costs these tests nothing there."""


@pytest.fixture
def tmp_path():
    with TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None, prefix="dgorl-journal-") as folder:
        yield Path(folder)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r1.journal"


def lived(journal: Journal, ticks: int, begin: float = 0.0) -> list[bytes]:
    """Ticks of an agent that hears two others; the signed bytes of all bundles in the order they came."""
    came = []
    for k in range(ticks):
        now = begin + 0.5 * k
        own = made("r1", journal.epoch, journal.next_sequence, now)
        journal.commit_own(own)
        others = [made(name, 2**64 - 1, round(2 * now), now) for name in ("r2", "r3")]
        for sealed in others:
            journal.receive(sealed)
        journal.tick(now, [own, *others])
        journal.flush()
        came += [own.data, *(sealed.data for sealed in others)]
    return came


def copied(path: Path, folder: Path) -> Path:
    """The files of a journal as they are now, its agent killed."""
    folder.mkdir()
    for part in PARTS:
        source = path.with_name(path.name + part)
        if source.exists():
            shutil.copyfile(source, folder / source.name)
    return folder / path.name


def own_numbers(path: Path, epoch: int) -> set[int]:
    return {name.sequence for name in contents(path).bundles if (name.robot, name.epoch) == ("r1", epoch)}


def test_a_new_journal_begins_an_epoch_of_its_own(tmp_path):
    epochs = set()
    for k in range(3):
        journal = begun(tmp_path / f"{k}.journal")
        assert (journal.next_sequence, journal.known, journal.admitted, journal.last) == (0, (), frozenset(), None)
        assert f"a new epoch begins, {journal.epoch:016x}" in journal.notices[0]
        epochs.add(journal.epoch)
        journal.close()
    assert len(epochs) == 3
    assert max(epochs) > 2**48  # chance of failure 2^-48


def test_a_journal_is_continued(path):
    journal = begun(path)
    came = lived(journal, 10)
    epoch = journal.epoch
    journal.receive(made("r2", 5, 0, 4.5))  # heard, not admitted
    journal.close()
    journal = begun(path)
    assert (journal.epoch, journal.next_sequence, journal.notices, journal.last) == (epoch, 10, (), 4.5)
    assert journal.known == (*came, made("r2", 5, 0, 4.5).data)
    assert journal.admitted == {("r1", epoch), ("r2", 2**64 - 1), ("r3", 2**64 - 1)}
    assert [open_sealed(data, ROSTER).bundle.sequence for data in journal.known[:3]] == [0, 0, 0]
    journal.close()


def test_only_what_is_still_needed_is_known(path):
    journal = begun(path)
    came = lived(journal, 100)  # 50 s, of which 20 s are kept
    journal.close()
    journal = begun(path)
    assert journal.known == tuple(came[-3 * 40 :])
    journal.close()


def test_numbers_only_rise(path):
    journal = begun(path)
    lived(journal, 3)
    for wrong in (
        made("r1", journal.epoch, 2, 5.0),
        made("r1", journal.epoch + 1, 3, 5.0),
        made("r2", journal.epoch, 3, 5.0),
    ):
        with pytest.raises(JournalError, match="expected r1's bundle 3"):
            journal.commit_own(wrong)
    both = made("r1", journal.epoch, 7, 5.0), made("r1", journal.epoch, 8, 5.0)
    with pytest.raises(JournalError):
        journal.commit_own(*reversed(both))
    assert journal.next_sequence == 3
    journal.commit_own(*both)
    assert journal.next_sequence == 9
    journal.close()
    assert own_numbers(path, journal.epoch) == {0, 1, 2, 7, 8}


def test_the_first_contents_of_a_name_are_kept(path):
    journal = begun(path)
    first, second = made("r2", 1, 0, 1.0, v=0.1), made("r2", 1, 0, 1.0, v=0.2)
    journal.receive(first)
    journal.tick(1.0, [second])
    journal.close()
    assert list(contents(path).bundles.values()) == [first.bundle]


def test_two_agents_cannot_have_one_journal(path):
    journal = begun(path)
    with pytest.raises(JournalError, match="in use by another agent"):
        begun(path)
    code = f"from tests.unit.committer import begun; begun({str(path)!r})"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert "in use by another agent" in other.stderr
    lived(journal, 1)
    journal.close()
    begun(path).close()


def test_another_robots_or_teams_journal_is_refused(path):
    journal = begun(path)
    lived(journal, 1)
    journal.close()
    with pytest.raises(JournalError, match="the journal of robot `r1`, not `r2`"):
        Journal.open(path, "r2", ROSTER, settings={}, keep=1.0)
    with pytest.raises(JournalError, match="the journal of team `lab`, not `field`"):
        Journal.open(path, "r1", Roster("field", {"r1": None}, insecure=True), settings={}, keep=1.0)
    journal = begun(path)
    assert journal.next_sequence == 1
    journal.close()


def test_files_of_others_are_refused_and_left_alone(path):
    path.write_text("team: lab\n" * 100)
    with pytest.raises(JournalError, match="not a journal"):
        begun(path)
    assert path.read_text() == "team: lab\n" * 100
    path.unlink()
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE photos (name TEXT)")
    database.close()
    before = path.read_bytes()
    with pytest.raises(JournalError, match="not a journal"):
        begun(path)
    assert path.read_bytes() == before


def test_a_folder_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(JournalError, match="cannot be opened: No such file"):
        begun(tmp_path / "nowhere" / "r1.journal")


def test_a_newer_journal_is_refused(path):
    begun(path).close()
    database = sqlite3.connect(path)
    database.execute("PRAGMA user_version = 99")
    database.close()
    with pytest.raises(JournalError, match="newer dgorl"):
        begun(path)


@pytest.mark.parametrize("damage", ["lost", "empty", "garbled", "another epoch"])
def test_without_its_mark_a_new_epoch_begins_and_nothing_else_is_lost(path, damage):
    journal = begun(path)
    came = lived(journal, 4)
    journal.close()
    mark = path.with_name(path.name + "-mark")
    match damage:
        case "lost":
            mark.unlink()
        case "empty":
            os.truncate(mark, 0)
        case "garbled":
            mark.write_bytes(mark.read_bytes().replace(b" 4 ", b" 3 "))
        case "another epoch":
            other = begun(path.with_name("other"))
            other.close()
            shutil.copyfile(path.with_name("other-mark"), mark)
    again = begun(path)
    assert again.epoch != journal.epoch
    assert again.next_sequence == 0
    assert again.known == tuple(came)
    assert "its mark" in again.notices[0]
    again.close()


def test_a_database_that_lost_its_end_does_not_use_numbers_again(path, tmp_path):
    journal = begun(path)
    lived(journal, 4)
    older = copied(path, tmp_path / "older")
    lived(journal, 5, begin=2.0)
    journal.close()
    shutil.copyfile(path.with_name(path.name + "-mark"), older.with_name(older.name + "-mark"))
    again = begun(older)
    assert (again.epoch, again.next_sequence) == (journal.epoch, 9)
    assert "has lost its end; own bundles up to 8 were sent, up to 3 are here" in again.notices[0]
    again.close()


@pytest.mark.parametrize("what", ["database", "everything but the mark"])
def test_what_cannot_be_read_is_set_aside_never_deleted(path, what):
    for round_ in (1, 2):
        journal = begun(path)
        lived(journal, 4)
        journal.close()
        lost = path.read_bytes()
        if what == "database":
            lost = lost[:200] + b"\xff" * 5000 + lost[5200:]
            path.write_bytes(lost)
        else:
            path.write_bytes(lost := b"")
            path.with_name(path.name + "-wal").write_bytes(b"not a log")
        again = begun(path)
        assert again.epoch != journal.epoch
        assert (again.next_sequence, again.known) == (0, ())
        aside = path.with_name(f"{path.name}.unreadable-{round_}")
        assert aside.name in again.notices[0]
        assert aside.read_bytes() == lost
        lived(again, 1)
        again.close()


def test_normal_synchronous_goes_on_after_a_kill_not_after_a_power_cut(path, tmp_path, monkeypatch):
    journal = begun(path, synchronous="normal")
    lived(journal, 3)
    killed, cut = copied(path, tmp_path / "killed"), copied(path, tmp_path / "cut")
    journal.close()
    again = begun(killed, synchronous="normal")
    assert (again.epoch, again.next_sequence) == (journal.epoch, 3)
    again.close()
    boot = tmp_path / "boot_id"
    boot.write_text("4c1d2a5e-0000-4000-8000-000000000001\n")
    monkeypatch.setattr(journal_mark, "BOOT", boot)
    again = begun(cut, synchronous="normal")
    assert again.epoch != journal.epoch
    assert "switched off" in again.notices[0]
    again.close()
    again = begun(path)  # this one was closed: all is on the disk
    assert (again.epoch, again.next_sequence) == (journal.epoch, 3)
    again.close()


@pytest.mark.parametrize("part", ["", "-wal", "-mark"])
def test_files_cut_anywhere(path, tmp_path, part):
    """A journal as after a power cut, one of its files cut short: it opens, and no number that was sent is used again.

    Of the write-ahead log more can be promised: what was committed before the place of the cut is there.
    """
    journal = begun(path, keep=1e9)
    log = path.with_name(path.name + "-wal")
    ends = []
    for k in range(60):
        if k == 30:
            journal._database.execute("PRAGMA wal_checkpoint(PASSIVE)")  # half of it is in the database
        lived(journal, 1, begin=k / 2)
        ends.append(log.stat().st_size)
    whole = {name: path.with_name(path.name + name).read_bytes() for name in PARTS}
    journal.close()
    chance = Random(3)
    size = len(whole[part])
    for k, cut in enumerate([0, size - 1, *(chance.randrange(size) for _ in range(68))]):
        broken = tmp_path / f"{k}" / path.name
        broken.parent.mkdir()
        for name, content in whole.items():
            if name != "-shm" or k % 2:
                broken.with_name(broken.name + name).write_bytes(content[:cut] if name == part else content)
        again = begun(broken, keep=1e9)
        if again.epoch == journal.epoch:
            assert again.next_sequence == 60
        else:
            assert again.next_sequence == 0
            assert part != "-wal"
        if part == "-wal":
            sure = {number for number, end in enumerate(ends) if end <= cut or number < 30}
            found = {b.sequence for b in (open_sealed(d, ROSTER).bundle for d in again.known) if b.robot == "r1"}
            assert found >= sure
            assert found == set(range(len(found)))
        lived(again, 2, begin=30.0)
        again.close()
        shutil.rmtree(broken.parent)


def test_flipped_bytes_are_found_or_harmless(path, tmp_path):
    journal = begun(path)
    lived(journal, 60)
    journal.close()
    whole, chance = path.read_bytes(), Random(5)
    for k in range(40):
        broken = copied(path, tmp_path / f"{k}")
        content = bytearray(whole)
        at = chance.randrange(100, len(content) - 64)
        content[at : at + 64] = chance.randbytes(64)
        broken.write_bytes(content)
        again = begun(broken)
        assert (again.epoch, again.next_sequence) == (journal.epoch, 60) or again.epoch != journal.epoch
        lived(again, 2, begin=30.0)
        again.close()


def test_rotation_keeps_what_is_needed_and_the_size(path):
    limit = 200_000
    journal = begun(path, limit=limit, starts=[START])
    sizes, came = [], []
    for k in range(600):
        came += lived(journal, 1, begin=k / 2)
        sizes.append(journal._entries.size())
    assert max(sizes) <= limit + 8 * 4096
    epoch = journal.epoch
    journal.close()
    assert path.stat().st_size <= limit + 8 * 4096
    found = contents(path)
    assert found.dropped >= 1000
    (story,) = found.stories
    assert story.run.starts == (START,)
    assert story.ticks[-1].now == 299.5
    assert story.ticks[0].now < 299.5 - 20.0
    assert all(len(tick.bundles) == 3 for tick in story.ticks[1:])
    again = begun(path, limit=limit)
    assert (again.epoch, again.next_sequence) == (epoch, 600)
    assert again.known == tuple(came[-3 * 40 :])
    again.close()


def test_a_limit_too_small_for_what_is_needed_gives_way(path):
    journal = begun(path, limit=1, keep=20.0)
    came = lived(journal, 300)
    journal.close()
    again = begun(path)
    assert again.known == tuple(came[-3 * 40 :])
    again.close()
    assert len(contents(path).bundles) < 3 * 40 + 10


def test_a_full_disk_is_an_error_and_nothing_is_lost(path):
    journal = begun(path)
    lived(journal, 2)
    (pages,) = journal._database.execute("PRAGMA page_count").fetchone()
    journal._database.execute(f"PRAGMA max_page_count = {pages}")
    journal.receive(big := seal(made("r2", 3, 0, 1.0).bundle, _Padded()))
    own = made("r1", journal.epoch, 2, 1.0)
    for _ in range(2):
        with pytest.raises(JournalError, match="cannot be written: database or disk is full"):
            journal.commit_own(own)
    assert journal.next_sequence == 2
    journal._database.execute("PRAGMA max_page_count = 100000")
    journal.commit_own(own)
    assert journal.next_sequence == 3
    journal.close()
    bundles = contents(path).bundles
    assert own.bundle.name in bundles
    assert big.bundle.name in bundles


class _Padded:
    """Signs at length."""

    public = None

    def sign(self, data: bytes) -> bytes:
        return bytes(200_000)


def test_own_bundles_may_be_committed_again_when_the_mark_could_not_be_written(path, monkeypatch):
    journal = begun(path)
    refuse = True

    def write(*arguments, **options):
        if refuse:
            raise JournalError("the card is gone")
        return original(*arguments, **options)

    original = journal._mark.write
    monkeypatch.setattr(journal._mark, "write", write)
    with pytest.raises(JournalError, match="the card is gone"):
        journal.commit_own(made("r1", journal.epoch, 0, 0.5, v=0.1))
    assert journal.next_sequence == 0
    refuse = False
    last = made("r1", journal.epoch, 0, 0.5, v=0.2)
    journal.commit_own(last)
    journal.close()
    assert list(contents(path).bundles.values()) == [last.bundle]


def killed_again_and_again(path: Path, times: int, seed: int) -> None:
    """What a killed agent told of is there, under its epoch, and no number was ever used for two contents."""
    chance = Random(seed)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["tests.unit.committer"])
    sent: dict[tuple[int, int], bytes] = {}
    ticks: list[float] = []
    for _ in range(times):
        said, told = processes.Pipe(duplex=False)
        agent = processes.Process(target=committer.main, args=(str(path), told))
        agent.start()
        told.close()
        lines = [said.recv()]
        time.sleep(chance.uniform(0.0, 0.1))
        os.kill(agent.pid, signal.SIGKILL)
        with contextlib.suppress(EOFError, OSError):  # what it told until then; the last may be cut off
            while True:
                lines.append(said.recv())
        agent.join()
        assert agent.exitcode == -signal.SIGKILL
        for kind, *values in lines:
            if kind == "tick":
                ticks += values
            else:
                epoch, sequence, data = values
                assert (epoch, sequence) not in sent
                sent[epoch, sequence] = data
        journal = begun(path, keep=1e9)
        assert journal.notices == ()
        assert {epoch for epoch, _ in sent} == {journal.epoch}
        assert journal.next_sequence > max(sequence for _, sequence in sent)
        names = (open_sealed(data, ROSTER).bundle.name for data in journal.known)
        own = {(n.epoch, n.sequence): data for n, data in zip(names, journal.known, strict=True) if n.robot == "r1"}
        assert {name: own[name] for name in sent} == sent
        journal.close()
    recorded = [tick.now for story in contents(path).stories for tick in story.ticks]
    assert set(ticks) <= set(recorded)
    assert recorded == sorted(recorded)


def test_kill_9(tmp_path_factory):
    killed_again_and_again(tmp_path_factory.mktemp("on disk") / "r1.journal", 20, seed=1)


@pytest.mark.slow
def test_kill_9_a_hundred_times(tmp_path_factory):
    killed_again_and_again(tmp_path_factory.mktemp("on disk") / "r1.journal", 100, seed=2)
