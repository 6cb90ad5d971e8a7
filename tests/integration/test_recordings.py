"""Recordings of real robots: causal, known starts, every tick counts whatever its status."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dgorl import Configuration, logs
from dgorl.configuration import load, merge
from dgorl.evaluation.metrics import summarize
from dgorl.evaluation.records import collect
from dgorl.measurements import known_at
from dgorl.replay import replay
from tests.recordings import ROOT, recording


def settings(platform: str) -> Configuration:
    path = ROOT / "configs" / f"{platform}.yaml"
    return merge(Configuration(), load(path), str(path))


def shortened(log: logs.Log, seconds: float) -> logs.Log:
    end = min(known_at(m) for m in log.measurements) + seconds
    return replace(log, measurements=tuple(m for m in log.measurements if known_at(m) <= end))


@pytest.fixture(scope="module")
def mrclam() -> logs.Log:
    return logs.read(recording("mrclam6"))


@pytest.mark.parametrize(
    ("kinds", "position", "heading"), [({"range", "bearing"}, 0.42, 10.5), ({"range"}, 0.70, 17.5)]
)
@pytest.mark.parametrize("seconds", [150.0, pytest.param(1000.0, marks=pytest.mark.slow)])
def test_mrclam(mrclam, kinds, position, heading, seconds):
    log = shortened(logs.select(mrclam, kinds), seconds)
    team = summarize(collect(replay(log, settings("mrclam")), log.truth))["team"]
    assert team["all_ticks_position_rmse_m"] <= position
    assert team["all_ticks_heading_rmse_deg"] <= heading
    assert team["coverage_95"] >= 0.8


def test_tiers():
    log = logs.read(recording("tiers/tiers.pyfg"))
    truth = logs.read_truth(recording("tiers/tiers_truth.csv"), log.robots)
    ticks = replay(log, settings("tiers"), egos=["A", "B", "C", "D"])
    team = summarize(collect(ticks, truth))["team"]  # L has no truth there, so the pairs that count are of A–D
    assert team["all_ticks_position_rmse_m"] <= 0.12
    assert team["coverage_95"] >= 0.9
