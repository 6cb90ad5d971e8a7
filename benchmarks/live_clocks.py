"""Estimated clocks of a fleet beside the true ones, and its estimates beside those on perfect clocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import inf
from random import Random

import numpy as np
from live_fleet import ROOT, Left, Place, Row, beginning, ran

from dgorl.evaluation.metrics import position_error
from dgorl.evaluation.records import Records, collect
from dgorl.logs.journal import read_journal
from dgorl.logs.log import Live, Log, Part, Step
from dgorl.measurements import Displacement, Measurement, Odometry
from dgorl.replay import replay
from dgorl.team.fleet import Fleet, author


def clock_errors(left: Left, since: float = -inf, until: float = inf) -> tuple[np.ndarray, np.ndarray]:
    """Errors of what each robot takes the others' clocks to show at its ticks, and the σ it claims [s]."""
    errors, sigmas = [], []
    for ego, said in left.reports.items():
        own = left.fleet.pace(ego)
        for report in said:
            true = own.to_recording(report.stamp)
            if not since <= true <= until or ego not in report.clocks:
                continue
            for robot, clock in report.clocks.items():
                if robot != ego:
                    shows = report.stamp + report.clocks[ego].offset - clock.offset
                    errors.append(shows - left.fleet.pace(robot).to_robot(true))
                    sigmas.append(clock.sigma)
    return np.array(errors), np.array(sigmas)


def perfect_ratio(left: Left) -> tuple[float, float, int]:
    """RMSE of positions [m], with the same bundles at the same ticks on perfect clocks [m], and of how many ticks.

    A tick of a pair counts where both locate it. Nothing differs but the stamps: what each robot knew, and when, is
    read off its journal.
    """
    squares: tuple[list[float], list[float]] = [], []
    for ego in left.fleet.log.robots:
        perfect = _on_perfect_clocks(left.fleet, ego)
        for pair, record in left.records.pairs.items():
            if pair[0] != ego or pair not in perfect.pairs:
                continue
            other = perfect.pairs[pair]
            mine, theirs = _common(record.t, other.t)
            both = record.located[mine] & other.located[theirs]
            squares[0].extend(np.sum(position_error(record)[mine][both] ** 2, axis=1))
            squares[1].extend(np.sum(position_error(other)[theirs][both] ** 2, axis=1))
    own, true = (float(np.sqrt(np.nanmean(values))) for values in squares)
    return own, true, len(squares[0])


def _common(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of stamps that are in both, to a microsecond."""
    _, mine, theirs = np.intersect1d(np.round(a, 6), np.round(b, 6), return_indices=True)
    return mine, theirs


def _on_perfect_clocks(fleet: Fleet, ego: str) -> Records:
    log = read_journal(fleet.journal(ego))
    assert log.live is not None
    steps = tuple(_true_step(step, fleet, ego) for step in log.live.steps)
    measurements = tuple(_true(m, fleet) for m in log.measurements)
    told = Log(log.path, log.robots, measurements, fleet.log.truth, live=Live(ego, steps))
    configuration = replace(fleet.configuration, clock="shared")
    return collect(replay(told, configuration, initial="unknown"), fleet.log.truth)


def _true_step(step: Step, fleet: Fleet, ego: str) -> Step:
    parts = tuple(Part(tuple(_true(m, fleet) for m in part.measurements)) for part in step.admitted)
    return replace(step, now=fleet.pace(ego).to_recording(step.now), admitted=parts)


def _true(measurement: Measurement, fleet: Fleet) -> Measurement:
    """A measurement with its stamps on the log's time."""
    pace = fleet.pace(author(measurement))
    names = ("start", "end") if isinstance(measurement, Odometry | Displacement) else ("stamp",)
    return replace(measurement, **{name: pace.to_recording(getattr(measurement, name)) for name in names})


def clocks(place: Place) -> Iterator[Row]:
    """Every robot its own clock, on a recording: simulated wheels tell nothing between steps, where ticks then are."""
    folder, rng = place.folder("clocks"), Random(8)
    log = beginning(folder / "log", place.data / "mrclam6", 50.0 if place.short else 100.0)
    words = ["--config", str(ROOT / "configs" / "mrclam.yaml")]
    for robot in ("r1", "r2", "r3", "r4", "r5"):
        words += ["--clock-offset", f"{robot}={rng.uniform(-5, 5):.3f}"]
        words += ["--clock-drift", f"{robot}={rng.choice((-50, 50))}"]
    left = ran(folder / "fleet", log, "--rate", 1, *words)
    errors, sigmas = clock_errors(left, since=left.fleet.first + 20.0)
    early, _ = clock_errors(left, until=left.fleet.first + 20.0)
    own, perfect, ticks = perfect_ratio(left)
    yield Row(
        "offsets of ± 5 s, 50 ppm: known to 5 ms; RMSE within 2 % of perfect clocks",
        f"after 20 s off by {_ms(np.sqrt(np.mean(errors**2)))} RMS, {_ms(np.abs(errors).max())} at most (before "
        f"{_ms(np.abs(early).max())}), σ at most {_ms(sigmas.max())}; RMSE {own:.4f} m; of the same bundles at "
        f"the same ticks on perfect clocks {perfect:.4f} m, ratio {own / perfect:.4f} ({ticks} located pairs' ticks); "
        f"{left.told()}",
        left.said,
        np.abs(errors).max() <= 5e-3 and own / perfect <= 1.02,
    )


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f} ms"
