"""Recordings of real robots with unknown starts: when everybody is found, how well, how honestly, at what cost.

    python benchmarks/recordings.py DATA

DATA holds ``mrclam6`` and ``tiers`` (CONTRIBUTING says where to get them). Replayed causally with the settings of
``configs/``. "Located" are ticks with status position or tracked; what is required stands beside each figure.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dgorl import Configuration, logs
from dgorl.configuration import load, merge
from dgorl.estimate import Status
from dgorl.evaluation.metrics import figures, time_to_track
from dgorl.evaluation.records import PairRecord, Records, collect
from dgorl.measurements import known_at
from dgorl.replay import replay

CONFIGS = Path(__file__).parents[1] / "configs"


@dataclass(frozen=True)
class Case:
    """A recording, the sensors used, the egos and peers that are scored, and what is required by figure."""

    title: str
    log: str
    settings: str
    kinds: tuple[str, ...]
    required: Mapping[str, str]
    truth: str | None = None
    scored: tuple[str, ...] = ()


CASES = {
    "mrclam": Case(
        "MRCLAM 6, range + bearing", "mrclam6", "mrclam.yaml", ("range", "bearing"),
        {"last": "≤ 45", "fraction": "≥ 0.93", "rmse": "≤ 0.37", "wrong": "≤ 1"},
    ),
    "mrclam-range": Case(
        "MRCLAM 6, range only", "mrclam6", "mrclam.yaml", ("range",),
        {"median": "≤ 120", "fraction": "≥ 0.70", "rmse": "≤ 0.62", "wrong": "≤ 3"},
    ),
    "tiers": Case(
        "tiers.pyfg, A–D, range only", "tiers/tiers.pyfg", "tiers.yaml", ("range",),
        {"fraction": "≥ 0.85", "rmse": "≤ 0.13"}, "tiers/tiers_truth.csv", ("A", "B", "C", "D"),
    ),
}  # fmt: skip


def run(case: Case, data: Path, seconds: float, changes: Mapping[str, Any]) -> Records:
    """Replay a case's first ``seconds`` with unknown starts."""
    log = logs.select(logs.read(data / case.log), case.kinds)
    if case.truth:
        log = replace(log, truth=logs.read_truth(data / case.truth, log.robots))
    end = min(known_at(m) for m in log.measurements) + seconds
    log = replace(log, measurements=tuple(m for m in log.measurements if known_at(m) <= end))
    settings = CONFIGS / case.settings
    configuration = merge(Configuration(), log.configuration, case.log)
    configuration = merge(merge(configuration, load(settings), str(settings)), changes, "command line")
    return collect(replay(log, configuration, initial="unknown", egos=case.scored or None), log.truth)


def report(case: Case, records: Records, verbose: bool) -> None:
    """Print the case's figures."""
    everybody = records.between_robots()
    pairs = [r for r in everybody if not case.scored or r.peer in case.scored]
    found = figures(pairs)
    times = np.array([np.inf if (s := time_to_track(r)) is None else s for r in pairs])
    rows = [
        ("last", "every pair located once after [s]", times.max()),
        ("median", "median pair located after [s]", np.quantile(times, 0.5, method="higher")),
        ("fraction", "located ticks of all", found["tracked_fraction"]),
        ("rmse", "position RMSE of located ticks [m]", found["position_rmse_m"]),
        ("heading", "heading RMSE of tracked ticks [°]", found["heading_rmse_deg"]),
        ("wrong", "located ticks off by > 1.5 m [%]", percent(found["wrong_fraction"])),
        ("coverage", "inside the 95 % ellipse [%]", percent(found["coverage_95"])),
    ]
    print(f"\n{case.title}: {len(records.stamps)} ticks, {len(pairs)} pairs")
    for name, label, value in rows:
        wanted = f"  required {case.required[name]}" if name in case.required else ""
        print(f"  {label:<42} {'–' if value is None else format(value, '.3f'):>9}{wanted}")
    print_cpu(records, everybody)
    for peer in sorted({r.peer for r in everybody} - {r.peer for r in pairs}):
        print_standing(peer, [r for r in everybody if r.peer == peer])
    if verbose:
        for r, seconds in zip(pairs, times, strict=True):
            print(f"  {r.ego}→{r.peer}: first located after {seconds:.1f} s, {statuses(r)}")


def percent(fraction: float | None) -> float | None:
    return None if fraction is None else 100 * fraction


def print_cpu(records: Records, pairs: Sequence[PairRecord]) -> None:
    """CPU of a tick, mean over egos, while somebody is not joined and otherwise."""
    spent = 1e3 * np.mean(list(records.tick_s.values()), axis=0)
    searching = np.any([r.having(Status.ISOLATED, Status.AMBIGUOUS) for r in pairs], axis=0)
    for label, rows in (("somebody not joined", searching), ("all joined", ~searching)):
        if rows.any():
            median, p99 = np.quantile(spent[rows], [0.5, 0.99])
            print(f"  CPU of a tick, {label}: median {median:.2f} ms, p99 {p99:.2f} ms, {rows.sum()} ticks")


def print_standing(peer: str, pairs: Sequence[PairRecord]) -> None:
    """A peer that never moves and has no truth: its position can be found, its heading never."""
    reached = sum(bool(r.having(Status.POSITION).any()) for r in pairs)
    headings = sum(int(r.having(Status.TRACKED).sum()) for r in pairs)
    label = f"{peer}: position reached by how many of {len(pairs)} egos"
    print(f"  {label:<42} {reached:>9}  required all")
    print(f"  {peer + ': ticks with a heading (tracked)':<42} {headings:>9}  required 0")
    for r in pairs:
        print(f"    {r.ego}→{peer}: {statuses(r)}")


def statuses(record: PairRecord) -> str:
    """Share of the ticks by status."""
    shares = {status: float(record.having(status).mean()) for status in Status}
    return ", ".join(f"{status} {100 * share:.0f} %" for status, share in shares.items() if share)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with mrclam6/ and tiers/")
    parser.add_argument("--only", choices=list(CASES), action="append", help="repeatable; all when not given")
    parser.add_argument("--seconds", type=float, default=np.inf, help="from each recording's start")
    parser.add_argument("--window", type=float, default=30.0, help="[s]")
    parser.add_argument("--verbose", action="store_true", help="a line for each pair")
    given = parser.parse_args()
    for name in given.only or CASES:
        report(CASES[name], run(CASES[name], given.data, given.seconds, {"window": given.window}), given.verbose)


if __name__ == "__main__":
    main()
