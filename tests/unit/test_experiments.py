"""Trials, their parts on disk, who computes them, the claims' statistics and the figures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.evaluation import answers, experiments, results
from dgorl.evaluation.claims import Claim, Rows
from dgorl.evaluation.claims import kept as kept_limit
from dgorl.evaluation.experiments import Paper, combine, compute
from dgorl.evaluation.metrics import nees_band
from dgorl.evaluation.one_robot import Cost, cost, processes
from dgorl.evaluation.records import collect
from dgorl.evaluation.report import markdown
from dgorl.evaluation.results import Parts, read, write
from dgorl.evaluation.statistics import bootstrap, ratio, root_ratio
from dgorl.evaluation.trials import Columns, Outcome, Trial, aligned, run, stacked
from dgorl.evaluation.workers import on_processes
from dgorl.plotting.paper import write_paper_figures
from dgorl.plotting.sweeps import plot_sweeps
from dgorl.replay import replay
from dgorl.se2 import transform
from dgorl.simulation import Scenario, simulate
from dgorl.stages import STAGES, Stopwatch, stage

SMALL = Scenario(robots=3, steps=12, area=20.0)
TRIALS = [
    Trial(replace(SMALL, seed=seed), initial, ("dgorl", "naive"))
    for initial in ("known", "unknown")
    for seed in range(2)
]


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    return [run(trial) for trial in TRIALS]


@pytest.fixture(scope="module")
def errors(outcomes: list[Outcome]) -> Columns:
    return {name: np.concatenate([o.errors[name] for o in outcomes]) for name in outcomes[0].errors}


@pytest.fixture
def kept(tmp_path: Path, outcomes: list[Outcome]) -> Parts:
    parts = Parts(tmp_path / "parts")
    for trial, outcome in zip(TRIALS, outcomes, strict=True):
        parts.keep(trial, outcome)
    return parts


def test_rows_are_the_replay_scored_by_hand(errors: Columns) -> None:
    log = simulate(TRIALS[0].scenario)
    records = collect(replay(log, merge(Configuration(), log.configuration, "")), log.truth)
    rows = Rows(errors, "known")
    assert len(rows) == 2 * 3 * 12  # trials, robots, steps
    mine = (rows["seed"] == 0) & (rows["robot"] == "r2")
    pairs = [records.pairs["r2", peer] for peer in ("r1", "r3")]
    off = [((p.pose - p.truth)[:, :2] ** 2).sum(axis=1) for p in pairs]
    assert rows["posed_square"][mine] == pytest.approx(sum(off))
    assert rows["distance"][mine] == pytest.approx(np.mean([np.hypot(*p.truth[:, :2].T) for p in pairs], axis=0))
    assert (rows["posed"][mine] == 2).all()
    assert rows["tracked"][mine].tolist() == sum(p.having("tracked") for p in pairs).tolist()
    assert rows["nees_by_peer"].shape == (72, 2)
    world = records.pairs["r2", "world"]
    place = transform([0, 0, -world.pose[-1, 2]], -world.pose[-1, :2])
    assert rows["absolute_square"][mine][-1] == pytest.approx(np.sum((place - log.truth["r2"][-1, 1:3]) ** 2))
    assert rows["aligned_square"].sum() < rows["absolute_square"].sum()


def test_unknown_starts_have_no_place_in_the_world_and_no_finite_bound_at_first(errors: Columns) -> None:
    rows = Rows(errors, "unknown")
    assert np.isnan(rows["absolute_square"]).all()
    assert np.isnan(rows["bound_square"][rows["step"] == 1]).all()
    assert (rows["located_compared"] <= rows["located"]).all()


def test_the_bound_is_only_where_asked_for() -> None:
    sparse = run(Trial(SMALL, bound_every=5)).errors
    every = run(Trial(SMALL)).errors
    at = np.isin(sparse["step"], (2, 7, 12))
    assert (sparse["compared"][at] == 2).all()
    assert (sparse["compared"][~at] == 0).all()
    assert sparse["compared_bound"][at] == pytest.approx(every["compared_bound"][at])


def test_a_run_is_aligned_by_one_rigid_motion() -> None:
    truth = np.random.default_rng(0).normal(size=(3, 5, 2))
    moved = transform([3.0, -2.0, 2.5], truth)
    assert aligned(moved, truth) == pytest.approx(truth)
    assert ((aligned(1.1 * truth, truth) - truth) ** 2).sum() == pytest.approx(
        0.01 * ((truth - truth.mean(axis=(0, 1))) ** 2).sum()
    )
    nothing = np.full((2, 2), np.nan)
    assert np.isnan(aligned(nothing, truth[0, :2])).all()


def test_tables_come_back_bit_for_bit(tmp_path: Path, outcomes: list[Outcome]) -> None:
    write(outcomes[3].errors, tmp_path / "t.parquet")
    back = read(tmp_path / "t.parquet")
    assert back.keys() == outcomes[3].errors.keys()
    for name, values in outcomes[3].errors.items():
        np.testing.assert_array_equal(back[name], values)
    assert [p.name for p in tmp_path.iterdir()] == ["t.parquet"]


def test_teams_of_any_size_share_a_table() -> None:
    pair, three = ({"step": np.arange(2), "nees_by_peer": np.ones((2, peers))} for peers in (1, 2))
    table = stacked([three, pair])
    assert table["step"].tolist() == [0, 1, 0, 1]
    np.testing.assert_array_equal(table["nees_by_peer"], [[1, 1], [1, 1], [1, np.nan], [1, np.nan]])


def test_parts_are_found_again_and_no_stale_one_is(kept: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(kept.holds(trial) for trial in TRIALS)
    other = replace(TRIALS[0], scenario=replace(SMALL, shadowing_db=3.0))
    assert not kept.holds(other)
    assert not kept.holds(replace(TRIALS[0], estimators=("dgorl",)))
    monkeypatch.setattr(results, "program", lambda: "dgorl of yesterday")
    assert not any(kept.holds(trial) for trial in TRIALS)


def test_a_broken_part_is_not_taken(kept: Parts) -> None:
    path = kept.folder / f"{results.key(TRIALS[1])}.errors.parquet"
    path.write_bytes(path.read_bytes()[:-20])
    assert [kept.holds(trial) for trial in TRIALS] == [True, False, True, True]
    (kept.folder / f"{results.key(TRIALS[2])}.timings.parquet").unlink()
    assert not kept.holds(TRIALS[2])


def test_an_unfinished_file_leaves_nothing(tmp_path: Path) -> None:
    with suppress(KeyboardInterrupt), results.atomically(tmp_path / "x.parquet") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_the_same_table_whoever_computes_it(tmp_path: Path, kept: Parts) -> None:
    tables = []
    combine(TRIALS, kept, tmp_path, "alone")
    tables.append((tmp_path / "alone.parquet").read_bytes())
    for workers in (1, 2):
        parts = Parts(tmp_path / f"{workers}")
        assert sorted(map(results.key, compute(TRIALS, parts, workers))) == sorted(map(results.key, TRIALS))
        combine(TRIALS, parts, tmp_path, f"by{workers}")
        tables.append((tmp_path / f"by{workers}.parquet").read_bytes())
    assert tables[0] == tables[1] == tables[2]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Dask's own
def test_the_same_table_from_a_cluster(tmp_path: Path, kept: Parts) -> None:
    distributed = pytest.importorskip("distributed")
    combine(TRIALS, kept, tmp_path, "alone")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        parts = Parts(tmp_path / "cluster")
        list(compute(TRIALS, parts, 1, cluster.scheduler_address))
        combine(TRIALS, parts, tmp_path, "cluster")
    assert (tmp_path / "alone.parquet").read_bytes() == (tmp_path / "cluster.parquet").read_bytes()


def test_interrupted_in_the_middle_it_goes_on(
    tmp_path: Path, kept: Parts, outcomes: list[Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = dict(zip(TRIALS, outcomes, strict=True))
    asked: list[Trial] = []

    def alone(work: object, tasks: list[Trial], workers: int) -> Iterator[tuple[Trial, tuple[str, Outcome]]]:
        for task in tasks:
            asked.append(task)
            if len(asked) == 3:
                raise KeyboardInterrupt
            yield task, (results.program(), given[task])

    monkeypatch.setattr(experiments, "on_processes", alone)
    parts = Parts(tmp_path / "interrupted")
    with pytest.raises(KeyboardInterrupt):
        list(compute(TRIALS, parts, 1))
    assert sum(parts.holds(trial) for trial in TRIALS) == 2
    assert set(compute(TRIALS, parts, 1)) == set(TRIALS)
    assert len(asked) == 5  # the third is asked for again, the first two are not
    for name, folder in (("all", kept), ("resumed", parts)):
        combine(TRIALS, folder, tmp_path, name)
    assert (tmp_path / "all.parquet").read_bytes() == (tmp_path / "resumed.parquet").read_bytes()


def test_another_programs_results_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        experiments, "on_cluster", lambda work, tasks, address: ((t, ("dgorl 0.0.1", None)) for t in tasks)
    )
    with pytest.raises(experiments.DgorlError, match=r"--cluster tcp://x: its workers run dgorl 0\.0\.1"):
        list(compute(TRIALS, Parts(tmp_path), 1, "tcp://x"))


def test_workers_end_when_the_caller_stops() -> None:
    done = on_processes(abs, [-3, -4, -5], 2)
    task, result = next(done)
    assert result == -task
    done.close()
    import multiprocessing

    for child in multiprocessing.active_children():
        child.join(10)
    assert not multiprocessing.active_children()


def test_the_stopwatch_changes_nothing_and_counts_each_stage_once() -> None:
    log = simulate(SMALL)
    configuration = merge(Configuration(), log.configuration, "")
    plain = collect(replay(log, configuration, initial="unknown"), log.truth)
    with Stopwatch() as watch:
        timed = collect(replay(log, configuration, initial="unknown"), log.truth)
    for pair, record in plain.pairs.items():
        np.testing.assert_array_equal(record.pose, timed.pairs[pair].pose)
    assert watch.seconds["formation"] > 0
    assert watch.seconds["optimisation"] > 0
    assert sum(watch.seconds.values()) <= timed.tick_s["r1"].sum() * 1.5
    before = dict(watch.seconds)
    with stage("formation"):
        sum(range(100_000))
    assert watch.seconds == before


def test_a_stage_inside_another_counts_for_itself() -> None:
    def work() -> None:
        import time

        end = time.process_time() + 0.02
        while time.process_time() < end:
            pass

    with Stopwatch() as watch, stage("optimisation"):
        work()
        with stage("expansion"):
            work()
            work()
    assert watch.seconds["optimisation"] == pytest.approx(0.02, rel=0.5)
    assert watch.seconds["expansion"] == pytest.approx(0.04, rel=0.5)
    assert set(watch.seconds) == set(STAGES)


def test_intervals_are_of_whole_trials() -> None:
    sums = np.array([[4.0, 1.0], [4.0, 1.0], [4.0, 1.0]])
    assert bootstrap(sums, root_ratio) == (2.0, 2.0)
    low, high = bootstrap(np.array([[0.0, 1.0], [1.0, 1.0]]), ratio)
    assert (low, high) == (0.0, 1.0)
    assert np.isnan(bootstrap(np.array([[0.0, 0.0]]), ratio)).all()
    generator = np.random.default_rng(1)
    covered = 0
    for k in range(100):
        low, high = bootstrap(np.column_stack([generator.normal(5, 1, 40), np.ones(40)]), ratio, draws=300, seed=k)
        covered += low <= 5 <= high
    assert 85 <= covered <= 99


def test_the_band_holds_what_is_consistent_and_nothing_else() -> None:
    """χ² drawn per pair and tick: the share inside is the band's level; twice too sure, it is none."""
    generator = np.random.default_rng(0)
    trials, robots, steps = 10, ("r1", "r2"), 400
    seed, robot, step = (a.ravel() for a in np.meshgrid(range(trials), robots, range(1, steps + 1), indexing="ij"))
    n = len(seed)
    columns: Columns = {
        "scenario": np.full(n, "paper", dtype=object), "initial": np.full(n, "known", dtype=object),
        "estimator": np.full(n, "dgorl", dtype=object), "robot": robot.astype(object), "seed": seed, "step": step,
        "nees_by_peer": generator.chisquare(3, (n, 1)),
    }  # fmt: skip
    assert answers.share_in_band(Rows(columns, "known")).mean() == pytest.approx(0.95, abs=0.02)
    columns["nees_by_peer"] *= 4
    assert answers.share_in_band(Rows(columns, "known")).mean() < 0.01
    assert nees_band(10)[0] < 3 < nees_band(10)[1]


def test_claims_are_computed_from_the_rows(errors: Columns, outcomes: list[Outcome]) -> None:
    ours, theirs = Rows(errors, "known"), Rows(errors, "known", "naive")
    late = ours["step"] >= 10
    expected = np.sqrt(ours["posed_square"][late].sum() / theirs["posed_square"][late].sum())
    found = {claim.claim: claim for claim in answers.comparison(errors)}
    claim = found["relative RMSE lower than that of naive fusion, same inputs, known starts"]
    assert claim.ratio == pytest.approx(expected)
    assert claim.value == pytest.approx(100 * (1 - expected))
    assert (claim.note == "the baseline is better") == (expected > 1)
    first = answers.accuracy(errors)[0]
    assert first.value == pytest.approx(
        np.sqrt(ours["compared_square"][late].sum() / ours["compared_bound"][late].sum())
    )
    assert first.met == (first.value <= 1.05)
    mean = answers.absolute(errors)[0]
    assert mean.value == pytest.approx(np.sqrt(ours["absolute_square"]).mean())
    assert mean.ratio == pytest.approx(mean.value / 4.2)
    assert answers.absolute(errors)[1].value == pytest.approx(100 * mean.value / 20)


def test_a_missed_limit_is_called_missed() -> None:
    of = {"value": 1.2, "low": 1.0, "high": 1.3}
    assert kept_limit(of, "≤ 1.05", lambda x: x <= 1.05) == {
        "asked": "≤ 1.05", "met": False, "note": "the interval reaches across the limit",
    }  # fmt: skip
    row = Claim("c", "4.2 m", 1.2, "m", 1.0, 1.3, trials=3, asked="≤ 1.05", met=False)
    page = markdown(
        [row], {"trials": 3, "steps": 5, "seed": 0, "command": "x", "first": 10, "machine": "m", "longer": 2}
    )
    assert "| c | 4.2 m | 1.20 m | 1.00 to 1.30 | 3 |" in page
    assert "**not met**" in page
    assert page.rstrip().endswith("- c")


def test_one_robots_process_is_measured_and_its_failure_told() -> None:
    with processes([SMALL], "known", pace=1000.0) as running:
        found = cost(running[0])
    assert 0 < found.cpu_s < 5
    assert found.stream_s == 6.0
    assert Cost(0, 0.3, 6.0, 1.0).percent == pytest.approx(5.0)
    with processes([SMALL], "known", pace=0.0) as running, pytest.raises(experiments.DgorlError, match="one robot"):
        cost(running[0])


def test_figures_are_drawn(tmp_path: Path, errors: Columns, outcomes: list[Outcome]) -> None:
    timings = {name: np.concatenate([o.timings[name] for o in outcomes]) for name in outcomes[0].timings}
    drawn = write_paper_figures(Outcome(errors, timings), tmp_path)
    names = ["shadowing_db=2", "shadowing_db=4"]
    swept = [run(Trial(replace(SMALL, shadowing_db=float(n[-1])), name=n, bound_every=5)).errors for n in names]
    plot_sweeps({name: np.concatenate([e[name] for e in swept]) for name in swept[0]}, tmp_path / "sweeps.png")
    for path in (*drawn, tmp_path / "sweeps.png"):
        assert path.read_bytes()[:4] == b"\x89PNG"
        assert path.with_suffix(".pdf").read_bytes()[:5] == b"%PDF-"


def test_the_plan_is_the_papers() -> None:
    paper = Paper(trials=3, seed=5)
    plan = paper.plan()
    assert [trial.scenario.seed for trial in plan] == [5, 6, 7, 5, 6, 7]
    defaults = Scenario()
    assert all(replace(t.scenario, seed=0, terrain=False) == defaults for t in plan[:3])
    assert plan[0].estimators[0] == "dgorl"
    assert not paper.sweeps()
    around = replace(paper, sweep=True).sweeps()
    assert {json.loads(results.definition(t))["name"].split("=")[0] for t in around} == set(experiments.SWEEPS)
    assert len({results.key(t) for t in (*plan, *around)}) == len(plan) + len(around)
