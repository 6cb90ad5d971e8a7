"""What a live robot saw is what ``dgorl run JOURNAL`` shows, bit for bit, and what its journals' bundles give again."""

from __future__ import annotations

import dataclasses
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from random import Random

import numpy as np
import pytest

from dgorl import Estimate, Localizer, logs
from dgorl.configuration import Configuration, as_dict, merge
from dgorl.errors import DgorlError, LogError
from dgorl.evaluation import output
from dgorl.evaluation.records import collect
from dgorl.localizer import RETAINED
from dgorl.logs.log import Log
from dgorl.measurements import ClockReading, Rssi, robots_of
from dgorl.replay import Tick, known_starts, replay
from dgorl.team.bundler import Bundler
from dgorl.team.bundles import Bundle, Sealed
from dgorl.team.journal import Journal
from dgorl.team.journal_admission import Admission
from dgorl.team.journal_data import parse, recompute
from dgorl.team.journal_mark import Mark, State
from dgorl.team.journal_schema import JournalError, create
from dgorl.team.keys import UNSIGNED, Roster
from dgorl.team.wire import open_sealed, seal
from dgorl.team_time import team_on
from tests.cli.commandline import fails_well
from tests.cli.conftest import dgorl
from tests.integration.teams import settings, simulated

__all__ = ["dgorl"]

EPOCHS = {"r1": 2**64 - 1, "r2": 17, "r3": 18}
ROSTER = Roster("lab", dict.fromkeys(EPOCHS), insecure=True)


@pytest.fixture(scope="module")
def log() -> Log:
    return simulated(steps=96, sensors=("rssi", "range"), seed=4)


@pytest.fixture(scope="module")
def configuration(log) -> Configuration:
    return settings(log, window=10.0, history=10.0)


def keep(configuration: Configuration) -> float:
    return configuration.history + float(configuration.window) + RETAINED


def bundles_of(log: Log, robot: str, epoch: int, stamps: np.ndarray) -> Iterator[Sealed]:
    """One robot's measurements, cut at every tick."""
    bundler = Bundler("lab", robot, epoch)
    own = iter([*(m for m in log.measurements if robots_of(m)[0] == robot), None])
    measurement = next(own)
    for now in stamps:
        while measurement is not None and logs.log._order(measurement)[0] <= now:
            bundler.add(measurement)
            measurement = next(own)
        for bundle in bundler.cut(float(now)):
            yield seal(bundle, UNSIGNED)


class Lived:
    """r1's life: bundles of r2 and r3 come late, out of order, twice; at 21 s its program dies and is begun again."""

    def __init__(self, folder: Path, log: Log, configuration: Configuration, known: bool) -> None:
        self.path = folder / "r1.journal"
        self.log, self.configuration = log, configuration
        self.starts = known_starts(log) if known else []
        self.ticks: list[tuple[Tick, str]] = []
        self.others = {
            robot: list(bundles_of(log, robot, EPOCHS[robot], np.arange(1, 97) * 0.5)) for robot in ("r2", "r3")
        }
        chance = Random(6)
        self._arrivals = sorted(
            (sealed.bundle.cut + self._delay(chance), name, k)
            for name, all_ in self.others.items()
            for k, sealed in enumerate(all_)
            for _ in range(chance.choice((1, 1, 2)))
        )
        self._run(range(1, 43))
        self._run(range(47, 97))

    @staticmethod
    def _delay(chance: Random) -> float:
        return chance.choice((0.0, 0.0, 0.1, 0.7, 3.0, chance.uniform(4.0, 14.0)))

    def _run(self, ticks: range) -> None:
        """Until killed: the journal is not closed, only let go of."""
        journal = Journal.open(
            self.path,
            "r1",
            ROSTER,
            settings=as_dict(self.configuration),
            keep=keep(self.configuration),
            starts=self.starts,
        )
        localizer, admission = Localizer("r1", self.configuration), Admission(self.configuration)
        for start in self.starts:
            localizer.add(start)
        for data in journal.known:
            admission.offer(open_sealed(data, ROSTER))
        stamps = np.array(ticks) * 0.5
        seen = (
            self.log.measurements if ticks[0] == 1 else [m for m in self.log.measurements if _end(m) > stamps[0] - 0.5]
        )
        own = list(bundles_of(dataclasses.replace(self.log, measurements=tuple(seen)), "r1", journal.epoch, stamps))
        for now in map(float, stamps):
            while self._arrivals and self._arrivals[0][0] <= now:
                _, name, k = self._arrivals.pop(0)
                journal.receive(self.others[name][k])
                admission.offer(self.others[name][k])
            while own and own[0].bundle.cut <= now:
                sealed = own.pop(0)
                bundle = dataclasses.replace(sealed.bundle, sequence=journal.next_sequence)
                sealed = seal(bundle, UNSIGNED)
                journal.commit_own(sealed)
                admission.offer(sealed)
            admitted = admission.due(now, takes_late=localizer.team.takes_late(now))
            for sealed in admitted:
                for measurement in sealed.bundle.measurements:
                    localizer.add(measurement)
            estimate = localizer.update(now)
            journal.tick(now, admitted)
            journal.flush()
            self.ticks.append((Tick(now, {"r1": estimate}, {"r1": 0.0}), admission.data))
        journal._database.close()
        journal._mark.close()


def _end(measurement) -> float:
    return logs.log._order(measurement)[0]


def bits(estimate: Estimate) -> dict[str, tuple[object, ...]]:
    return {
        peer: (
            seen.status,
            None if seen.pose is None else seen.pose.tobytes(),
            None if seen.covariance is None else seen.covariance.tobytes(),
            seen.probability,
            seen.age,
            seen.reason,
            seen.resolve_by,
            tuple((h.probability, h.pose.tobytes(), h.covariance.tobytes()) for h in seen.hypotheses),
        )
        for peer, seen in estimate.items()
    }


@pytest.fixture(scope="module", params=[False, True], ids=["unknown starts", "known starts"])
def lived(request, tmp_path_factory, log, configuration) -> Lived:
    return Lived(tmp_path_factory.mktemp("lived"), log, configuration, request.param)


def test_a_replayed_journal_gives_the_same_estimates(lived):
    journal = logs.read(lived.path)
    configuration = merge(Configuration(), journal.configuration, "journal")
    assert configuration == lived.configuration
    assert journal.robots == ("r1", "r2", "r3")
    ticks = list(replay(journal, configuration, initial="unknown"))
    assert [tick.stamp for tick in ticks] == [tick.stamp for tick, _ in lived.ticks]
    for found, (expected, _) in zip(ticks, lived.ticks, strict=True):
        assert list(found.estimates) == ["r1"]
        assert bits(found.estimates["r1"]) == bits(expected.estimates["r1"])
        assert found.estimates["r1"].rejected == expected.estimates["r1"].rejected
    poses = [tick.estimates["r1"]["r2"].pose for tick in ticks[20:42]]
    assert all(pose is not None for pose in poses)  # it has something to say, and comes from more than one solution
    assert len({pose.tobytes() for pose in poses}) == 22


def test_the_steps_of_the_journal_are_needed_for_it(lived):
    """Replayed by stamps, as if all had come in time and nobody had died, the estimates are others."""
    journal = dataclasses.replace(logs.read(lived.path), live=None)
    ticks = {t.stamp: t for t in replay(journal, lived.configuration, initial="unknown", egos=["r1"])}
    same = [bits(ticks[t.stamp].estimates["r1"]) == bits(t.estimates["r1"]) for t, _ in lived.ticks]
    assert not all(same)


@pytest.mark.parametrize("lived", [False], indirect=True, ids=["unknown starts"])
def test_dgorl_run_writes_what_the_robot_saw(lived, dgorl, tmp_path):
    done = dgorl("run", lived.path, "--out", tmp_path / "replayed")
    assert done.returncode == 0, done.stderr
    output.prepare(tmp_path / "lived")
    records = collect((tick for tick, _ in lived.ticks), {})
    output.write(records, lived.configuration, {"log": "r1.journal"}, tmp_path / "lived")
    files = sorted((tmp_path / "lived").glob("*/r1/*"))
    assert len(files) >= 2
    for file in files:
        found = tmp_path / "replayed" / file.relative_to(tmp_path / "lived")
        assert found.read_text() == file.read_text()


def test_kinds_can_be_selected(lived):
    journal = logs.read(lived.path, ["range"])
    assert journal.live is not None
    parts = [part for step in journal.live.steps for part in step.admitted]
    assert not any(isinstance(m, Rssi) for part in parts for m in part.measurements)
    full = logs.read(lived.path)
    assert any(isinstance(m, Rssi) for m in full.measurements)
    assert len(journal.live.steps) == len(lived.ticks)


def test_any_estimate_can_be_recomputed_from_all_journals(lived, tmp_path):
    """r1's bundles stand in its journal, the others' in theirs, in order; that r1 had them late does not matter."""
    paths = []
    for robot, made in lived.others.items():
        path = tmp_path / f"{robot}.journal"
        mark = Mark(path)
        mark.write(State(EPOCHS[robot], 0))
        mark.close()
        create(path, {"team": "lab", "robot": robot, "epoch": f"{EPOCHS[robot]:016x}"})
        journal = Journal.open(path, robot, ROSTER, settings={}, keep=1e9)
        journal.commit_own(*made)
        journal.close()
        paths.append(path)
    alone = tmp_path / "r1.journal"
    shutil.copyfile(lived.path, alone)
    with closing(sqlite3.connect(alone)) as database, database:
        database.execute("DELETE FROM entries WHERE kind != 0 AND robot IS NOT 'r1'")
    for k in (3, 22, 41, 42, 60, 91):
        tick, data = lived.ticks[k]
        starts = lived.starts if k < 42 else []  # begun again, it found them too old
        found = recompute([alone, *paths], data, tick.stamp, "r1", lived.configuration, starts)
        assert bits(found) == bits(tick.estimates["r1"])
    with pytest.raises(JournalError, match=r"lack bundles: r1:"):
        recompute(paths, lived.ticks[5][1], 3.0, "r1", lived.configuration)


def test_data_names_late_bundles_apart(lived):
    held = [parse(data) for _, data in lived.ticks]
    assert any(len(numbers) > 1 for found in held for numbers in found.values())
    (mine,) = (numbers for (robot, _), numbers in held[-1].items() if robot == "r1")
    assert mine.high == len(lived.ticks) - 1


def test_a_journal_without_a_tick_and_a_damaged_one_are_errors(lived, dgorl, tmp_path):
    path = tmp_path / "r1.journal"
    Journal.open(path, "r1", ROSTER, settings={}, keep=1.0).close()
    with pytest.raises(LogError, match="an empty journal"):
        logs.read(path)
    broken = tmp_path / "broken.journal"
    content = bytearray(path.read_bytes())
    content[100:] = b"\xff" * (len(content) - 100)
    broken.write_bytes(content)
    assert "broken.journal: cannot be read as a journal" in fails_well(dgorl("run", broken))


def test_a_journal_is_read_while_its_agent_writes_and_changes_nothing(tmp_path, log, configuration):
    path = tmp_path / "r1.journal"
    journal = Journal.open(path, "r1", ROSTER, settings=as_dict(configuration), keep=100.0)
    for k, sealed in enumerate(bundles_of(log, "r1", journal.epoch, np.arange(1, 11) * 0.5)):
        journal.commit_own(sealed)
        journal.tick(0.5 * (k + 1), [sealed])
        journal.flush()
        live = logs.read(path).live
        assert live is not None
        assert len(live.steps) == k + 1
    journal.close()


def test_runs_under_other_settings_are_left_out(tmp_path, log, configuration):
    path = tmp_path / "r1.journal"
    for window in (20.0, 10.0, 10.0):
        journal = Journal.open(path, "r1", ROSTER, settings={"window": window}, keep=100.0)
        journal.tick(1.0, [])
        journal.tick(1.5, [])
        journal.close()
    found = logs.read(path)
    assert found.live is not None
    began = "r1", journal.epoch
    assert [(step.now, step.started) for step in found.live.steps] == [(1.0, began), (1.5, None)] * 2
    assert found.configuration == {"window": 10.0}
    assert found.skipped == {"ticks under other settings": 2}


def test_clocks_are_estimated_again(tmp_path, log, configuration):
    """Three clocks minutes apart: the journal tells whose clock a stamp is on, and every clock reading."""
    configuration = dataclasses.replace(configuration, clock="estimated")
    path = tmp_path / "r1.journal"
    journal = Journal.open(path, "r1", ROSTER, settings=as_dict(configuration), keep=1e9)
    clocks = {"r1": (journal.epoch, 0.0), "r2": (EPOCHS["r2"], 250.0), "r3": (EPOCHS["r3"], -90.0)}
    team = team_on(configuration, ("r1", journal.epoch))
    lived, stamps = [], np.arange(1, 61) * 0.5
    made = {robot: list(bundles_of(log, robot, epoch, stamps)) for robot, (epoch, _) in clocks.items()}
    for k, now in enumerate(map(float, stamps)):
        admitted = []
        for robot, (_, offset) in clocks.items():
            bundle = shifted(made[robot][k].bundle, offset)
            heard = tuple(
                ClockReading(robot, clocks[robot][0], peer, epoch, now - 0.01 + ahead, now + offset)
                for peer, (epoch, ahead) in clocks.items()
                if peer != robot and k % 2
            )
            admitted.append(seal(dataclasses.replace(bundle, clocks=heard), UNSIGNED))
        journal.commit_own(admitted[0])
        for sealed in admitted:
            clock = sealed.bundle.robot, sealed.bundle.epoch
            for reading in sealed.bundle.clocks:
                team.add_reading(reading)
            for measurement in sealed.bundle.measurements:
                team.add(measurement, clock)
        at = team.team_now("r1", journal.epoch, now)
        assert at is not None
        lived.append(Tick(at, {"r1": team.view("r1", team.update(at), at)}, {}))
        journal.tick(now, admitted)
    journal.close()
    found = logs.read(path)
    ticks = list(replay(found, merge(Configuration(), found.configuration, "journal"), initial="unknown"))
    assert [(t.stamp, bits(t.estimates["r1"])) for t in ticks] == [(t.stamp, bits(t.estimates["r1"])) for t in lived]
    assert set(lived[-1].estimates["r1"]) == {"r2", "r3"}
    assert lived[-1].estimates["r1"]["r2"].pose is not None
    with pytest.raises(DgorlError, match="only DGORL itself can replay"):
        replay(found, configuration, estimator="naive")


def shifted(bundle: Bundle, offset: float) -> Bundle:
    """A bundle of a robot whose clock is ``offset`` [s] ahead."""
    return dataclasses.replace(
        bundle,
        cut=bundle.cut + offset,
        odometry=tuple(dataclasses.replace(m, start=m.start + offset, end=m.end + offset) for m in bundle.odometry),
        **{
            kind: tuple(dataclasses.replace(m, stamp=m.stamp + offset) for m in getattr(bundle, kind))
            for kind in ("rssi", "ranges", "bearings")
        },
    )
