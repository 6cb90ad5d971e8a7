"""One trial of the experiment: a simulated team, localised by each estimator. METHOD §8, §9.

What a trial gives is a pure function of its definition, but for the CPU times, which are kept apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dgorl.configuration import Configuration, merge
from dgorl.estimate import Status
from dgorl.evaluation.bounds import bound
from dgorl.evaluation.metrics import CHI2_95_2DOF, heading_error, nees, position_error, position_nees, position_sigma
from dgorl.evaluation.records import PairRecord, Records, collect, truth_at
from dgorl.logs.log import Log
from dgorl.measurements import WORLD, Measurement
from dgorl.replay import known_starts, replay
from dgorl.se2 import Array, between, inverse
from dgorl.simulation import Scenario, simulate
from dgorl.stages import STAGES, Stopwatch

Initial = Literal["known", "unknown"]
Columns = dict[str, NDArray[Any]]
"""A table: equally long arrays by name"""


@dataclass(frozen=True)
class Trial:
    """Everything a trial depends on, its seed in the scenario. name: of the scenario, among others."""

    scenario: Scenario
    initial: Initial = "known"
    estimators: tuple[str, ...] = ("dgorl",)
    name: str = "paper"
    bound_every: int = 1
    """steps from one bound to the next; between them there is none"""


@dataclass(frozen=True)
class Outcome:
    """What a trial measured, one row a robot, step and estimator: errors, which repeat exactly, and CPU times."""

    errors: Columns
    timings: Columns


def run(trial: Trial) -> Outcome:
    """Simulate, localise with every estimator, compare with the truth and the bound."""
    log = simulate(trial.scenario)
    configuration = merge(Configuration(), log.configuration, "the simulated log")
    least = _bound(trial, log, configuration)
    errors, timings = [], []
    for estimator in trial.estimators:
        ticks = replay(log, configuration, initial=trial.initial, estimator=estimator)
        laps: list[list[float]] = []
        with Stopwatch() as watch:
            records = collect(watch.laps(ticks, laps), log.truth)
        stages = 1e3 * np.diff(np.array(laps), axis=0, prepend=0.0)
        aligned = _absolute(records, log)
        for robot in log.robots:
            key = partial(_key, trial, estimator, robot, records.stamps)
            errors.append(key() | _errors(records, least, log, robot) | aligned[robot])
            timings.append(key() | _timings(records, robot, stages if estimator == "dgorl" else None))
    return Outcome(stacked(errors), stacked(timings))


def stacked(tables: Sequence[Columns]) -> Columns:
    """Tables of the same columns, one after the other; shorter lists are filled up with NaN."""
    return {name: np.concatenate(_equally_wide([table[name] for table in tables])) for name in tables[0]}


def _equally_wide(arrays: list[NDArray[Any]]) -> list[NDArray[Any]]:
    if arrays[0].ndim == 1:
        return arrays
    width = max(array.shape[1] for array in arrays)
    return [np.pad(a, ((0, 0), (0, width - a.shape[1])), constant_values=np.nan) for a in arrays]


def _key(trial: Trial, estimator: str, robot: str, t: Array) -> Columns:
    """What a row is about, the settings that sweeps vary among it."""
    scenario, n = trial.scenario, len(t)
    words = {"scenario": trial.name, "initial": trial.initial, "estimator": estimator, "robot": robot}
    numbers = {"seed": scenario.seed, "robots": scenario.robots}
    names = ("area", "shadowing_db", "path_loss_exponent", "reciprocity", "odometry_noise")
    settings = {name: getattr(scenario, name) for name in names}
    return (
        {name: np.full(n, word, dtype=object) for name, word in words.items()}
        | {name: np.full(n, number, dtype=np.int64) for name, number in numbers.items()}
        | {name: np.full(n, float(value)) for name, value in settings.items()}
        | {"step": np.rint(t / scenario.period).astype(np.int64), "t": np.array(t, dtype=float)}
    )


def _bound(trial: Trial, log: Log, configuration: Configuration) -> Mapping[tuple[str, str], Array]:
    """The expected Cramér–Rao bound, (steps, 3, 3) by pair; NaN where it is infinite or not asked for."""
    steps, every = trial.scenario.steps, trial.bound_every
    at = np.arange(steps % every or every, steps + 1, every)
    starts: list[Measurement] = [*known_starts(log)] if trial.initial == "known" else []
    found = {}
    stamps = np.asarray(at * trial.scenario.period, dtype=np.float64)
    for pair, covariance in bound(log, configuration, starts, stamps).items():
        found[pair] = np.full((steps, 3, 3), np.nan)
        found[pair][at - 1] = covariance
    return found


def _errors(records: Records, least: Mapping[tuple[str, str], Array], log: Log, robot: str) -> Columns:
    """How one robot sees its peers: sums over those in question, each tick; nothing is aligned.

    posed: peers with a pose; compared: of these those whose bound is finite; located, tracked: by status; wrong:
    located, yet off by more than 5σ and 2 m. The list ``nees_by_peer`` goes by the peers' names, NaN without a pose.
    """
    t, none = records.stamps, np.full((len(records.stamps), 3, 3), np.nan)
    peers = [peer for peer in sorted(log.robots) if peer != robot]
    pairs = [records.pairs.get((robot, peer)) or _nothing(robot, peer, t, log) for peer in peers]
    square = np.array([(position_error(pair) ** 2).sum(axis=1) for pair in pairs])
    turn = np.array([heading_error(pair) ** 2 for pair in pairs])
    limit = np.array([least.get((robot, peer), none) for peer in peers])
    limit_square, limit_turn = limit[..., 0, 0] + limit[..., 1, 1], limit[..., 2, 2]
    whole = np.array([nees(pair) for pair in pairs])
    inside = np.array([position_nees(pair) for pair in pairs]) <= CHI2_95_2DOF
    posed, finite = np.isfinite(square), np.isfinite(limit_square)
    located = np.array([pair.located for pair in pairs]) & posed
    tracked = np.array([pair.having(Status.TRACKED) for pair in pairs])
    both, sure = posed & finite, located & finite
    sigma = np.array([position_sigma(pair.covariance) for pair in pairs])
    wrong = located & (np.sqrt(square) > np.maximum(5 * sigma, 2.0))
    return {
        **_sums("posed", posed, square=square, heading_square=turn),
        **_sums("compared", both, square=square, bound=limit_square, heading_square=turn, heading_bound=limit_turn),
        **_sums("located", located),
        **_sums("located_compared", sure, square=square, bound=limit_square),
        **_sums("tracked", tracked),
        **_sums("wrong", wrong),
        **_sums("posed_inside_95", inside & posed),
        **_sums("located_inside_95", inside & located),
        "bound_square": np.where(finite.all(axis=0), np.where(finite, limit_square, 0.0).mean(axis=0), np.nan),
        "distance": np.mean([np.hypot(*pair.truth[:, :2].T) for pair in pairs], axis=0),
        "nees_by_peer": whole.T,
    }


def _sums(name: str, counts: NDArray[np.bool_], **values: Array) -> Columns:
    """How many peers count, and the sums of values over them: masks and values (peers, T)."""
    sums = {f"{name}_{of}": np.where(counts, value, 0.0).sum(axis=0) for of, value in values.items()}
    return {name: counts.sum(axis=0).astype(np.int64), **sums}


def _absolute(records: Records, log: Log) -> Mapping[str, Columns]:
    """Squared error of each robot's own place in the start frame, as it is and after one alignment of the run; NaN
    without known starts."""
    t = records.stamps
    seen = {robot: records.pairs.get((robot, WORLD)) for robot in log.robots}
    unknown = np.full((len(t), 3), np.nan)
    placed = np.array([unknown if pair is None else inverse(pair.pose) for pair in seen.values()])[..., :2]
    truth = np.array([truth_at(log.truth, robot, t) for robot in seen])[..., :2]
    fitted = aligned(placed, truth)
    return {
        robot: {
            "absolute_square": ((placed[k] - truth[k]) ** 2).sum(axis=-1),
            "aligned_square": ((fitted[k] - truth[k]) ** 2).sum(axis=-1),
        }
        for k, robot in enumerate(seen)
    }


def aligned(points: Array, truth: Array) -> Array:
    """Points (..., 2) moved by the one rigid motion that brings them closest to the truth (..., 2)."""
    known = np.isfinite(points).all(axis=-1) & np.isfinite(truth).all(axis=-1)
    if not known.any():
        return points
    p, q = points[..., 0] + 1j * points[..., 1], truth[..., 0] + 1j * truth[..., 1]
    p_mean, q_mean = p[known].mean(), q[known].mean()
    turn = np.sum(np.conj(p[known] - p_mean) * (q[known] - q_mean))
    moved = q_mean + (p - p_mean) * (turn / abs(turn) if turn else 1.0)
    return np.stack([moved.real, moved.imag], axis=-1)


def _timings(records: Records, robot: str, stages: Array | None) -> Columns:
    """CPU milliseconds of each tick of one robot, and of the stages of Alg. 3 in it; the rest is words and views."""
    cpu = 1e3 * records.tick_s[robot]
    columns = np.full((len(cpu), len(STAGES)), np.nan) if stages is None else stages
    return {"cpu_ms": cpu, **{f"{name}_ms": columns[:, k] for k, name in enumerate(STAGES)}}


def _nothing(ego: str, peer: str, t: Array, log: Log) -> PairRecord:
    """A peer never heard of."""
    n = len(t)
    truth = between(truth_at(log.truth, ego, t), truth_at(log.truth, peer, t))
    pose, covariance = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    status, words = (Status.ISOLATED,) * n, ("",) * n
    return PairRecord(ego, peer, t, pose, covariance, status, np.zeros(n), np.full(n, np.inf), words, words, truth)
