"""The paper's claims and ours beside them, each answered by a measured figure: pure functions of the tables.

RMSE are pooled over robots, peers and the steps from ``FIRST`` on, whatever the status where starts are known; with
unknown ones over located peers. Intervals are 95 % bootstraps over trials. Nothing is aligned unless it says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dgorl.evaluation.claims import Claim, Rows, beside, figure, kept
from dgorl.evaluation.metrics import nees_band
from dgorl.evaluation.one_robot import Cost
from dgorl.evaluation.statistics import ratio, root_ratio
from dgorl.evaluation.trials import Columns
from dgorl.se2 import Array


def accuracy(errors: Columns) -> list[Claim]:
    """Against the bound, and how alike the trials are."""
    known, unknown = Rows(errors, "known"), Rows(errors, "unknown")
    claims = []
    if len(known):
        of = figure(known.sums(known["compared_square"], known["compared_bound"]), root_ratio)
        limit = kept(of, "≤ 1.05", lambda x: x <= 1.05)
        claims.append(
            Claim("relative position RMSE ÷ expected Cramér–Rao bound, known starts", "–", unit="", **of, **limit)
        )
        rmse = figure(known.sums(known["posed_square"], known["posed"]), root_ratio)
        claims.append(Claim("relative position RMSE, known starts", "–", unit="m", **rmse))
        each = known.sums(known["posed_square"], known["posed"])
        trials = np.sqrt(each[:, 0] / each[:, 1])
        claims.append(
            Claim("“consistent results” over the repeated trials: RMSE of a trial, known starts", "consistent",
                  float(np.median(trials)), "m", float(trials.min()), float(trials.max()), "best to worst trial",
                  len(trials), note=f"standard deviation {trials.std():.2f} m")
        )  # fmt: skip
    if len(unknown):
        every = np.ones(len(unknown), dtype=bool)
        sums = unknown.sums(unknown["located_compared_square"], unknown["located_compared_bound"], where=every)
        of = figure(sums, root_ratio)
        limit = kept(of, "≤ 1.15", lambda x: x <= 1.15)
        claims.append(
            Claim("relative position RMSE of located peers ÷ bound, unknown starts", "–", unit="", **of, **limit)
        )
        peers = unknown["robots"] - 1
        share = figure(unknown.sums(unknown["located"], peers, where=every), ratio, 100)
        claims.append(Claim("located peers, unknown starts, all steps", "–", unit="%", **share))
        wrong = figure(unknown.sums(unknown["wrong"], unknown["located"], where=every), ratio, 100)
        limit = kept(wrong, "≤ 1 %", lambda x: x <= 1)
        claims.append(
            Claim("located peers off by more than 5σ and 2 m, unknown starts", "–", unit="%", **wrong, **limit)
        )
    return claims


IMPROVEMENTS = {
    "split-ci": ("split covariance intersection, same inputs", "23 % (its CI/TRN baseline)"),
    "trn": ("TRN with split CI, which knows the terrain besides", "23 %"),
    "ci": ("plain covariance intersection, same inputs", "–"),
    "naive": ("naive fusion, same inputs", "–"),
    "dead-reckoning": ("dead reckoning", "–"),
}
"""estimator → what it is, the paper's figure"""


def comparison(errors: Columns) -> list[Claim]:
    """RMSE against every baseline at the ticks and peers that both have; known starts, then unknown ones."""
    claims = []
    for initial in ("known", "unknown"):
        ours = Rows(errors, initial)
        for estimator, (what, paper) in IMPROVEMENTS.items():
            theirs = Rows(errors, initial, estimator)
            if not len(theirs) or not len(ours):
                continue
            of = figure(_both(ours, theirs), lambda s: 1 - root_ratio(s), 100)
            limit: dict[str, Any] = {}
            if estimator == "split-ci" and initial == "known":
                limit = kept(of, "≥ 25 %", lambda x: x >= 25)
                least = figure(_both(ours, theirs, "compared_bound"), lambda s: 1 - root_ratio(s), 100)
                words = f"at the bound itself it would be {least['value'] or 0:.0f} % lower"
                limit["note"] = "; ".join(filter(None, [limit["note"], words]))
            name = f"relative RMSE lower than that of {what}, {initial} starts"
            wins = of["value"] is not None and of["value"] < 0
            limit |= {"note": "the baseline is better" + _why(estimator)} if wins else {}
            under = None if of["value"] is None else 1 - of["value"] / 100
            paper = paper if initial == "known" else "–"
            claims.append(Claim(name, paper, unit="%", ratio=under, against=estimator, **of, **limit))
        theirs = Rows(errors, initial, "gtsam-fixed-lag")
        if len(theirs) and len(ours):
            of = figure(_both(ours, theirs), root_ratio)
            limit = kept(of, "≤ 1.02", lambda x: x <= 1.02) if initial == "known" else {}
            name = f"relative RMSE ÷ that of GTSAM's fixed-lag smoother, same window, {initial} starts"
            claims.append(Claim(name, "–", unit="", ratio=of["value"], against="gtsam-fixed-lag", **of, **limit))
    return claims


def _why(estimator: str) -> str:
    return ": it measures its height over a map of the terrain, which we do not" if estimator == "trn" else ""


def _both(ours: Rows, theirs: Rows, what: str = "posed_square") -> Array:
    """Sums of both squares where both have every peer; ours located, where starts are unknown and theirs begin late.

    what: of ours, is compared.
    """
    peers = ours["robots"] - 1
    where = ours.late & (ours["posed"] == peers) & (theirs["posed"] == peers)
    if ours["initial"][0] == "unknown":
        where &= ours["located"] == peers
    return ours.sums(ours[what], theirs["posed_square"], where=where)


def absolute(errors: Columns) -> list[Claim]:
    """The paper's absolute error: known starts, no alignment; its 8 % over both lengths it may mean."""
    rows = Rows(errors, "known")
    if not len(rows):
        return []
    every, one = np.ones(len(rows), dtype=bool), np.ones(len(rows))
    off, turned = np.sqrt(rows["absolute_square"]), np.sqrt(rows["aligned_square"])
    mean = figure(rows.sums(off, one, where=every), ratio)
    limit = kept(mean, "≤ 2.1 m", lambda x: x <= 2.1)
    side = float(rows["area"][0])
    percent = figure(rows.sums(off, side * one, where=every), ratio, 100)
    of_distance = figure(rows.sums(off, rows["distance"], where=every), ratio, 100)
    aligned = figure(rows.sums(turned, one, where=every), ratio)
    last = figure(rows.sums(off, one, where=rows["step"] == rows["step"].max()), ratio)
    words = f"over the side of {side:g} m"
    return [
        Claim("absolute error, mean, known starts, no alignment", "4.2 m", unit="m", **beside(mean, 4.2), **mean,
              **limit),
        Claim(f"localization error {words}", "8 %", unit="%", **beside(percent, 8), **percent),
        Claim("localization error over the mean distance between robots", "8 %", unit="%",
              **beside(of_distance, 8), **of_distance),
        Claim("absolute error, mean, each run SE(2)-aligned once", "–", unit="m", **aligned),
        Claim("absolute error, mean, at the last step", "–", unit="m", **last),
    ]  # fmt: skip


def consistency(errors: Columns) -> list[Claim]:
    """NEES by pair and tick over trials, which are independent; how often the truth lies in the 95 % ellipse."""
    rows = Rows(errors, "known")
    if not len(rows):
        return []
    trials = len(rows.seeds)
    shares = share_in_band(rows)
    note = "each ordered pair and tick by itself: the mean of its 3-dof NEES over the trials against χ²(3N)/N"
    of: dict[str, Any] = {"value": 100 * float(shares.mean()), "low": 100 * float(shares.min())}
    of |= {"high": 100 * float(shares.max()), "trials": trials, "spread": "worst to best pair"}
    nees = Claim("ticks at which the mean NEES lies in its 95 % band, known starts", "–", unit="%", **of,
                 asked="≥ 90 %", met=of["value"] >= 90, note=note)  # fmt: skip
    claims = [nees]
    for initial, what in (("known", "posed"), ("unknown", "located")):
        rows = Rows(errors, initial)
        if len(rows):
            every = np.ones(len(rows), dtype=bool)
            inside = figure(rows.sums(rows[f"{what}_inside_95"], rows[what], where=every), ratio, 100)
            limit = kept(inside, "92 to 98 %", lambda x: 92 <= x <= 98) if initial == "known" else {}
            claims.append(Claim(f"inside the 95 % ellipse, {initial} starts", "–", unit="%", **inside, **limit))
    for estimator in ("naive", "split-ci", "trn", "gtsam-fixed-lag"):
        rows = Rows(errors, "known", estimator)
        if len(rows):
            every = np.ones(len(rows), dtype=bool)
            inside = figure(rows.sums(rows["posed_inside_95"], rows["posed"], where=every), ratio, 100)
            claims.append(Claim(f"inside the 95 % ellipse, {estimator}, known starts", "–", unit="%", **inside))
    return claims


def share_in_band(rows: Rows) -> Array:
    """(pairs,) of all ticks the share at which the mean NEES over the trials lies in the band of that many trials."""
    robots = np.unique(rows["robot"])
    steps = np.unique(rows["step"])
    values = rows["nees_by_peer"].reshape(len(rows.seeds), len(robots), len(steps), -1)
    mean = values.mean(axis=0)
    low, high = nees_band(len(rows.seeds))
    within: Array = ((mean >= low) & (mean <= high)).mean(axis=1)
    return within.ravel()


def effort(timings: Columns, robots: Sequence[Cost], solver: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """CPU: of the solver, of one robot's process, and of a tick beside the baselines'."""
    claims = list(_solver(solver))
    if robots:
        percent = np.array([cost.percent for cost in robots])
        sums = np.column_stack([percent, np.ones(len(percent))])
        of = figure(sums, ratio)
        limit = kept(of, "≤ 5 %", lambda x: x <= 5)
        tracking = 100 * float(np.mean([cost.tracking for cost in robots]))
        limit["note"] = f"± {percent.std():.2f} % of one core, {tracking:.0f} % of the ticks tracking all; no network"
        claims.append(
            Claim("CPU of one robot's process at 2 Hz, known starts", "143 ± 49 %", unit="%", **beside(of, 143), **of,
                  **limit)
        )  # fmt: skip
    for estimator, paper, asked in (("gtsam-fixed-lag", "–", 0.2), ("trn", "close", None), ("split-ci", "close", None)):
        ours, theirs = Rows(timings, "known"), Rows(timings, "known", estimator)
        if len(ours) and len(theirs):
            every = np.ones(len(ours), dtype=bool)
            both = np.column_stack([r.sums(r["cpu_ms"], where=every) for r in (ours, theirs)])
            of = figure(both, ratio)
            limit = {} if asked is None else kept(of, "≤ 0.2", lambda x: x <= 0.2)
            limit.setdefault("note", "")
            ms = [1.0 * float(np.mean(r["cpu_ms"])) for r in (ours, theirs)]
            limit["note"] = "; ".join(filter(None, [f"{ms[0]:.2f} ms and {ms[1]:.2f} ms", limit["note"]]))
            name = f"CPU of a tick ÷ that of {estimator}, known starts"
            claims.append(Claim(name, paper, unit="", ratio=of["value"], against=estimator, **of, **limit))
    return claims


SOLVERS = {"native": "our core", "g2o": "g2o, C++", "g2opy": "g2o from Python", "gtsam": "GTSAM from Python"}


def _solver(rows: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """Of summaries of the solvers' comparison: ``solver``, ``start`` and milliseconds each."""
    claims = []
    for row in (row for row in rows if row["solver"] in SOLVERS):
        ours = row["solver"] == "native"
        name = f"solver time per graph, 5 robots, 60 keyframes, from {row['start']}: {SOLVERS[row['solver']]}"
        marginals = (
            "" if row["marginals_ms"] is None else f" and marginals of the newest poses {row['marginals_ms']:.2f}"
        )
        claims.append(
            Claim(name, "10.2 ± 2.7 ms" if ours else "–", row["optimise_ms"], "ms", row["low_ms"], row["high_ms"],
                  "quartiles of the graphs", row["graphs"], row["optimise_ms"] / 10.2 if ours else row["ratio"],
                  "the paper's" if ours else "our core",
                  note=f"mean {row['mean_ms']:.2f} ± {row['std_ms']:.2f} ms; building the graph {row['build_ms']:.2f}"
                       f"{marginals} ms on top")
        )  # fmt: skip
    return claims


def not_measured(what: Mapping[str, str]) -> list[Claim]:
    """Rows for what is missing, and why."""
    return [Claim(name, "–", None, "", note=f"not measured: {why}") for name, why in sorted(what.items())]
