"""Rows of ``live.py``: what the network loses, delays and parts, and whether estimates come again."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from multiprocessing import get_context
from pathlib import Path
from random import Random

import numpy as np
from live_fleet import ROOT, Left, Place, Row, apart, beginning, located, ran, replayed, simulated

from dgorl.evaluation.metrics import figures
from dgorl.evaluation.records import LOCATED
from dgorl.replay import start_priors
from dgorl.team.fleet import Fleet
from dgorl.team.journal_data import recompute
from dgorl.team.journal_read import Contents, contents
from dgorl.team.report import Peer, peers_of

SAME = 1e-6
"""Poses that differ by less [m, rad] are the same."""
BAD = ("--loss", 0.5, "--delay", "0-0.5", "--duplicate", 0.1, "--reorder", 0.1)
GROUPS = (("r1", "r2"), ("r3", "r4", "r5"))


def lossless(place: Place) -> Iterator[Row]:
    """A good network gives what a replay gives."""
    folder = place.folder("lossless")
    recording = beginning(folder / "log", place.data / "mrclam6", 20.0 if place.short else 80.0)
    known = ("--initial", "known", "--config", ROOT / "configs" / "mrclam.yaml")
    asked = f"all equal; last poses those of `dgorl run` to {SAME:g}"
    yield _as_replayed(folder / "known", asked, "MRCLAM 6, 80 s, known starts", recording, 20, known)
    log = simulated(folder / "simulated", 50.0)
    yield _as_replayed(folder / "unknown", asked, "simulator, 50 s, unknown starts", log, 5, ())


def _as_replayed(out: Path, asked: str, what: str, log: Path, rate: float, words: tuple[object, ...]) -> Row:
    left = ran(out / "fleet", log, *words, "--rate", rate)
    off = apart(left, replayed(out / "run", log, *words))
    measured = f"{what}: {left.told()}, {off:.1e} apart; {left.skipped:.0%} of the ticks skipped at {rate} ×"
    return Row(asked, measured, left.said, left.equal() and off < SAME)


def loss50(place: Place) -> Iterator[Row]:
    """Half the messages lost, the rest late, twice, out of order; then 10 s of quiet."""
    left = _fifty(place)
    lacking = [robot for robot, journal in left.journals.items() if len(journal) < left.numbering()[0]]
    all_held = f"all hold all {left.numbering()[0]} bundles" if not lacking else f"{', '.join(lacking)} lack some"
    yield Row(
        "after 10 s of quiet all hold all bundles; made anew at one time, all estimates are equal",
        f"{all_held}; {left.told()}; located {left.team['tracked_fraction']:.1%}",
        left.said,
        not lacking and left.equal(),
    )


def _fifty(place: Place) -> Left:
    """Rate 3: at faster ones a fleet is quiet for longer than 10 s."""
    folder = place.folder("loss50")
    log = simulated(folder / "log", 20.0 if place.short else 60.0)
    return ran(folder / "fleet", log, *BAD, "--rate", 3, "--settle", 10)


def loss90(place: Place) -> Iterator[Row]:
    """Nine of ten messages lost: real robots, and simulated ones that turn anew each step, nobody can guess how."""
    folder = place.folder("loss90")
    seconds = 40.0 if place.short else 120.0
    recording = beginning(folder / "log", place.data / "mrclam6", seconds)
    config = ("--config", ROOT / "configs" / "mrclam.yaml")
    yield _ninety(folder / "recording", "MRCLAM 6", recording, *config)
    yield _ninety(folder / "walk", "simulator", simulated(folder / "simulated", seconds))


def _ninety(folder: Path, what: str, log: Path, *words: object) -> Row:
    words = (log, "--initial", "known", *words, "--rate", 1)
    good, left = ran(folder / "good", *words), ran(folder / "lossy", *words, "--loss", 0.9)
    ratio = left.team["tracked_fraction"] / good.team["tracked_fraction"]
    cover = left.team["coverage_95"]
    ages = (f"{np.median(age):.1f} / {np.quantile(age, 0.95):.1f} s" for age in (_ages(good), _ages(left)))
    return Row(
        "located at least 0.8 × as often as without loss; 90 % in the 95 % ellipse; `age` shows it",
        f"{what}, known starts: located {ratio:.2f} × {good.team['tracked_fraction']:.1%}; "
        f"{cover:.1%} in the ellipse (without loss {good.team['coverage_95']:.1%}); age, median / 95 %: "
        f"{' → '.join(ages)}; RMSE {good.team['position_rmse_m']:.2f} → {left.team['position_rmse_m']:.2f} m",
        left.said,
        ratio >= 0.8 and cover >= 0.9,
    )


def _ages(left: Left) -> np.ndarray:
    ages = np.concatenate([record.age[record.located] for record in left.records.between_robots()])
    return ages[np.isfinite(ages)]


def line(place: Place) -> Iterator[Row]:
    """The ends hear only each other's relays."""
    folder = place.folder("line")
    log = simulated(folder / "log", 30.0 if place.short else 80.0)
    full, left = (ran(folder / name, log, "--rate", 4, "--topology", name) for name in ("full", "line"))
    ends, before = ([run.records.pairs[pair] for pair in (("r1", "r5"), ("r5", "r1"))] for run in (left, full))
    share, whole = figures(ends), figures(before)
    age = np.median(np.concatenate([r.age[r.located] for r in ends]))
    yield Row(
        "the ends know each other through relays",
        f"r1 and r5: located {share['tracked_fraction']:.1%}, {share['position_rmse_m']:.2f} m, age {age:.1f} s "
        f"(all hear all: {whole['tracked_fraction']:.1%}, {whole['position_rmse_m']:.2f} m); {left.told()}",
        left.said,
        left.equal() and share["tracked_fraction"] >= 0.8 * whole["tracked_fraction"],
    )


def partition(place: Place) -> Iterator[Row]:
    """Two groups on their own for 30 s, healed at two moments between nodes. Rate 1: to catch up takes CPU."""
    folder = place.folder("partition")
    log = simulated(folder / "log", 65.0)
    shares, held, admitted, ages, equal, left = [], [], [], [], True, None
    for heal in (50.0,) if place.short else (50.0, 53.1):
        parted = f"{'|'.join(map(','.join, GROUPS))}:{heal - 30:g}-{heal:g}"
        left = ran(folder / f"{heal}", log, "--rate", 1, "--partition", parted)
        pairs = left.records.pairs
        shares += [located([pairs[a, b] for a in g for b in g if a != b], heal - 30, heal) for g in GROUPS]
        across = [pairs[a, b] for a in GROUPS[0] for b in GROUPS[1]]
        ages += [record.age[(record.t >= heal - 30) & (record.t <= heal)].max() for record in across]
        held.append(left.held_after(heal))
        admitted.append(left.admitted_after(heal))
        equal = equal and left.equal()
    assert left is not None
    yield Row(
        "30 s apart: both sides keep locating their own; equal again within 5 s",
        f"located {min(shares):.1%} of their own, data of the others up to {max(ages):.0f} s old; healed, all held all "
        f"after {_list(held)} s, and all estimates were made of it after {_list(admitted)} s; at the end {left.told()}",
        f"{left.said}, and healed earlier",
        equal and min(shares) > 0.9 and max(held) <= 5.0,
    )


def _list(values: list[float]) -> str:
    return ", ".join(f"{value:.1f}" for value in values)


def recomputed(place: Place) -> Iterator[Row]:
    """Any row again, from its `data` and the journals."""
    left = _fifty(place)
    fleet, rng = left.fleet, Random(10)
    said = [report for reports in left.reports.values() for report in reports]
    chosen = rng.sample(said, min(20 if place.short else 200, len(said)))
    journals = [contents(fleet.journal(robot)) for robot in fleet.log.robots]
    with get_context("fork").Pool(2, _give, (journals, fleet)) as pool:
        made = pool.starmap(_again, [(report.data, report.stamp, report.robot) for report in chosen], chunksize=1)
    rows = [(r.peers.get(p), m.get(p)) for r, m in zip(chosen, made, strict=True) for p in {*r.peers, *m}]
    seen = [(a, b) for a, b in rows if a is not None and a.status in LOCATED]
    off = max(np.abs(np.subtract(a.pose, b.pose)).max() if b and b.pose else inf for a, b in seen)
    yield Row(
        f"any estimate again from its `data` and the journals, to {SAME:g}, 200 of them by chance",
        f"{len(chosen)} estimates, {len(rows)} poses of peers: {sum(a == b for a, b in rows)} the same to the bit, "
        f"statuses and covariances included; the {len(seen)} located ones at most {off:.1e} apart",
        left.said,
        off < SAME,
    )


_given: list[tuple[list[Contents], Fleet]] = []
"""What a process that recomputes was born with: journals do not travel well."""


def _give(journals: list[Contents], fleet: Fleet) -> None:
    _given.append((journals, fleet))


def _again(data: str, stamp: float, robot: str) -> dict[str, Peer]:
    journals, fleet = _given[-1]
    return peers_of(recompute(journals, data, stamp, robot, fleet.configuration, start_priors(fleet.starts)))
