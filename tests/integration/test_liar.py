"""A robot that lies is named, nobody else is, and the others are none the worse for it. METHOD §4, break."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import pytest

from dgorl import Range
from dgorl.simulation import Scenario, simulate

LIAR = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "liar.py"))
TEAM = Scenario(robots=5, area=25.0, steps=240, sensors=("range",))


def assert_harmless(result, soon):
    assert result.named <= soon
    assert result.blamed == ()
    assert result.ratio <= 1.5
    assert result.located >= 0.99 * result.located_alone


@pytest.mark.parametrize("ends", ["liar", "both"])
def test_a_liar_is_named_and_harms_nobody(ends):
    assert_harmless(LIAR["trial"](1, TEAM, 60.0, ends, "known"), 15.0)


def test_a_liar_nobody_has_ever_located_is_named():
    assert_harmless(LIAR["trial"](1, replace(TEAM, steps=120), 0.0, "both", "unknown"), 30.0)


def test_a_liar_from_the_start_that_alone_measures_bends_nobody_for_long():
    """All that was joined, its past too, is bent by then: the others are placed anew without the liar."""
    result = LIAR["trial"](3, replace(TEAM, steps=160), 0.0, "liar", "unknown")
    assert_harmless(result, 20.0)
    assert result.ratio <= 1.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
@pytest.mark.parametrize(
    ("initial", "since", "ends"),
    [
        ("known", 0.0, "liar"),
        ("known", 0.0, "both"),
        ("unknown", 60.0, "liar"),
        ("unknown", 60.0, "both"),
        ("unknown", 0.0, "liar"),
        ("unknown", 0.0, "both"),
    ],
)
def test_whoever_lies_since_whenever(seed, initial, since, ends):
    assert_harmless(LIAR["trial"](seed, TEAM, since, ends, initial), 40.0)


@pytest.mark.parametrize("ends", ["liar", "both"])
def test_the_lie_is_in_what_the_liar_measures(ends):
    """Else there would be nothing to find, or the honest would lie as well."""
    log = simulate(Scenario(robots=3, area=20.0, steps=20, sensors=("range",)))
    before = [m for m in log.measurements if isinstance(m, Range)]
    after = [m for m in LIAR["lying"](log, 5.0, ends).measurements if isinstance(m, Range)]
    assert len(before) == len(after)
    for honest, told in zip(before, after, strict=True):
        assert {honest.robot, honest.peer} == {told.robot, told.peer}
        off = LIAR["METRES"] if told.robot == "r3" and told.stamp > 5.0 else 0.0
        assert told.range - honest.range == pytest.approx(off)
    authors = {m.robot for m in after if "r3" in (m.robot, m.peer)}
    assert authors == ({"r3"} if ends == "liar" else {"r1", "r2", "r3"})
