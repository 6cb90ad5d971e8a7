"""Who is a suspect for how long: two nodes in a row mean the same story, or they do not count together."""

from __future__ import annotations

import pytest
from scipy.stats import chi2

from dgorl.consistency import Suspect, chi2_limit
from dgorl.tracks import TrackKey

R1 = TrackKey("r1", 0, 0.0)


def carried(since: int, nodes: int = 1) -> Suspect:
    return Suspect(R1, since, 2.0, True, nodes)


def rejected(since: int, nodes: int = 1) -> Suspect:
    return Suspect(R1, since, 2.0, False, nodes)


@pytest.mark.parametrize("tail", [1e-4, 1e-6])
@pytest.mark.parametrize("dof", [3, 10, 100])
def test_the_limit_is_the_quantile_of_the_tail(dof: int, tail: float) -> None:
    assert chi2_limit(dof, tail) == pytest.approx(chi2.isf(tail, dof), rel=0.07)


def test_a_new_suspect_counts_once() -> None:
    assert carried(99).after(None) == carried(99)


def test_the_same_step_counts_on_where_more_is_known_of_it() -> None:
    assert carried(100).after(carried(99)) == carried(100, nodes=2)


def test_another_step_begins_anew() -> None:
    assert carried(109).after(carried(99)) == carried(109)


def test_readings_that_lie_have_lied_since_they_were_first_found() -> None:
    assert rejected(110).after(rejected(100)) == rejected(100, nodes=2)
    assert rejected(120).after(rejected(100, nodes=2)) == rejected(100, nodes=3)


def test_a_step_first_and_readings_next_are_one_story() -> None:
    assert rejected(110).after(carried(99)) == rejected(99, nodes=2)
    assert carried(101).after(rejected(100)) == carried(101, nodes=2)
