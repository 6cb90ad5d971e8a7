"""Nobody is cut off because many steps are looked at, or because walls make ranges long. METHOD §2, §4."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from dgorl import Team
from dgorl.logs import read
from dgorl.measurements import known_at
from dgorl.simulation import Scenario, simulate

from ..recordings import case
from .teams import everything, settings


def cut_off(log, **changes):
    """Who was cut off, node by node, starts known."""
    team = Team(settings(log, **changes))
    waiting = iter(everything(log))
    following = next(waiting, None)
    found = set()
    for now in np.arange(6.0, known_at(log.measurements[-1]) + 2, 5.0):
        while following is not None and known_at(following) <= now:
            team.add(following)
            following = next(waiting, None)
        team.update(float(now))
        found |= {key.robot for key in team._memo.node(team._memo.due(float(now))).since}
    return found


@pytest.mark.parametrize(
    ("seed", "sensor", "steps"),
    [(10052, "rssi", 150), (10008, "range", 220), *(pytest.param(10000 + k, s, 300, marks=pytest.mark.slow)
                                                     for k in range(10) for s in ("rssi", "range"))],
)  # fmt: skip
def test_chance_cuts_off_nobody(seed, sensor, steps):
    """In the first two the step most bent, of all that were looked at, was beyond the quantile for one."""
    assert cut_off(simulate(Scenario(seed=seed, sensors=(sensor,), steps=steps))) == set()


@pytest.mark.parametrize(
    "seed", [10008, *(pytest.param(k, marks=pytest.mark.slow) for k in (10001, 10002, 10003, 10010))]
)
def test_long_ranges_cut_off_nobody(seed):
    """A fifth of the ranges without line of sight, 1.5 m too long on average, and a kernel that gives them up."""
    log = simulate(Scenario(robots=3, seed=seed, steps=200, area=30.0, sensors=("range",), nlos=0.2))
    assert cut_off(log, ranging={"kernel": "cauchy_negative"}) == set()


@pytest.fixture(scope="module")
def false_alarms():
    benchmarks = Path(__file__).parents[2] / "benchmarks"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(benchmarks))
        yield runpy.run_path(str(benchmarks / "false_alarms.py"))


def test_hardly_any_node_calls_somebody_inconsistent(false_alarms):
    """Of 264 nodes of honest teams of many kinds; one in 10⁴ is promised. It was one in ten."""
    named = [robots for seed in range(12) for _, robots in false_alarms["trial"](1000 + seed, 115.0)]
    assert len(named) == 12 * 22
    assert sum(map(bool, named)) <= 1


def test_wheels_that_tell_often_and_precise_ranges_accuse_nobody(false_alarms):
    for g, robots in false_alarms["accused"](read(case("false_inconsistent"))):
        assert not robots, g
