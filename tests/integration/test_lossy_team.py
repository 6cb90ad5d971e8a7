"""Real agents and gossip where nine of ten messages are lost: they stay located, honestly, and say how old it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from dgorl.simulation import Scenario, simulate
from dgorl.team.faults import Faults


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    from lossy_team import watched

    return watched


def test_nine_of_ten_messages_lost(watched):
    """From 30 s on, when all have found one another; the benchmark counts the search as well."""
    log = simulate(Scenario(robots=5, area=30.0, steps=120, sensors=("rssi",), seed=0))
    good = watched(log, Faults(), 60.0, 30.0)
    bad = watched(log, Faults(seed=0, loss=0.9), 60.0, 30.0)
    assert good.ages[1] <= 0.5
    assert 0.5 < bad.ages[1] < 3.0
    assert good.age_off < 1e-6
    assert bad.age_off < 1e-6  # an age is that of the newest bundle known
    assert bad.located >= 0.8 * good.located
    assert bad.inside >= 0.9
