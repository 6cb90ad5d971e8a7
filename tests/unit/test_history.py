"""The history is a set: what comes twice, late or in another order leaves no trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import Bearing, Configuration, Displacement, Odometry, Range, RelativePose, Rssi
from dgorl.configuration import merge
from dgorl.history import AT_ONCE, History
from dgorl.measurements import Measurement

COVARIANCE = (0.01, 0.0, 0.0, 0.01, 0.0, 0.001)
MEASUREMENTS: tuple[Measurement, ...] = (
    *(Odometry(robot, 0.5 * k, 0.5 * k + 0.5, 0.3, 0.1) for robot in ("a", "b") for k in range(6)),
    Displacement("a", 3.0, 3.5, 0.1, 0.0, 0.0),
    Displacement("a", 3.0, 3.5, 0.1, 0.0, 0.0, COVARIANCE),
    Displacement("a", 3.5, 4.0, 0.1, 0.0, 0.0, COVARIANCE),
    *(Rssi("a", "b", stamp, dbm) for stamp in (0.5, 1.0, 1.0, 2.5) for dbm in (-50.0, -51.0)),
    Range("a", "b", 1.0, 2.0),
    Range("a", "b", 1.0, 2.0, None, 7),
    Range("b", "a", 1.1, 2.1, None, 7),
    Bearing("a", "b", 1.5, 0.2),
    Bearing("a", "b", 1.5, 0.2, 0.05),  # the σ of one that states none
    RelativePose("world", "a", 0.0, 0.0, 0.0, 0.0, COVARIANCE, prior=True),
)


def admitted(measurements: Sequence[Measurement], at: Sequence[int], changes: dict[str, object]) -> History:
    """... in the order given, looked at after each of these."""
    history = History(merge(Configuration(), changes, "test"))
    for k, measurement in enumerate(measurements):
        history.add(measurement)
        if k in at:
            history.admit(8.0, node_due=True)
    history.admit(8.0, node_due=True)
    return history


def contents(history: History) -> list[object]:
    """All that an estimate sees of it, names instead of numbers."""
    rows: list[object] = [history.poses]
    for kind, table in history.tables.items():
        found = table.between(-inf, inf)
        names = {number: key.robot for key, number in history.numbers.items()}
        ends = [[names[number] for number in column.tolist()] for column in (found.track_a, found.track_b)]
        values = [found.stamp, found.value, found.sigma, found.keyframe_a, found.offset_a, found.offset_b]
        rows.append((kind, ends, [np.asarray(value).tobytes() for value in values]))
    stamps = np.arange(0.0, 4.0, 0.1)
    return [*rows, *((t.key, [t.core.locate(s) for s in stamps[stamps < t.end]]) for t in history.tracks)]


@settings(max_examples=40, deadline=None)
@given(
    st.permutations(MEASUREMENTS),
    st.lists(st.sampled_from(MEASUREMENTS), max_size=12),
    st.sets(st.integers(0, 40)),
    st.sampled_from([{}, {"radio": {"thinning": 1.0}}, {"motion": {"stated_covariance": False}}]),
)
def test_order_and_duplicates_leave_no_trace(
    order: list[Measurement], again: list[Measurement], at: set[int], changes: dict[str, object]
) -> None:
    plain = admitted(MEASUREMENTS, (), changes)
    assert repr(contents(admitted([*order, *again], sorted(at), changes))) == repr(contents(plain))


@pytest.mark.parametrize("measurement", MEASUREMENTS, ids=repr)
def test_what_comes_twice_changes_nothing(measurement: Measurement) -> None:
    history = admitted(MEASUREMENTS, (), {})
    history.add(measurement)
    assert history.admit(8.0, node_due=True) == inf
    assert not history.rejected


def test_what_was_forgotten_on_a_rewind_comes_anew() -> None:
    history = admitted(MEASUREMENTS, (), {})
    history.rewind(1.0)
    for measurement in MEASUREMENTS:
        history.add(measurement)
    assert history.admit(8.0, node_due=True) <= 1.1
    assert repr(contents(history)) == repr(contents(admitted(MEASUREMENTS, (), {})))


def test_a_reading_equal_to_an_exchange_counts_beside_it() -> None:
    one = Range("a", "b", 1.0, 2.0)
    for order in ((one, replace(one, exchange=7)), (replace(one, exchange=7), one)):
        assert len(admitted(order, (0,), {}).tables["range"]) == 2


@pytest.mark.parametrize("gaps", [(4.0, 4.0), (6.0,), (0.01, 6.0, 0.01), (4.0, 6.0, 4.0, 4.0, 6.0)], ids=str)
def test_a_number_that_comes_again_later_is_another_exchange(gaps: tuple[float, ...]) -> None:
    stamps = np.cumsum([1.0, *gaps])
    ends = [("a", "b"), ("b", "a")] * len(stamps)
    readings = [Range(*pair, stamp, 2.0, None, 7) for stamp, pair in zip(stamps, ends, strict=False)]
    counted = [1.0, *(stamp for stamp, gap in zip(stamps[1:], gaps, strict=True) if gap > 5.0)]
    for order in permutations(readings):
        history = History(Configuration())
        for reading in order:
            history.add(reading)
            history.admit(40.0, node_due=True)
        assert history.tables["range"].between(-inf, inf).stamp.tolist() == counted


@pytest.mark.parametrize(
    ("measurement", "changes"),
    [(Range("a", "b", 1.2, 2.0), {"ranging": {"thinning": 1.0}}), (Range("b", "a", 1.1, 2.1, None, 7), {})],
    ids=["thinned", "exchange"],
)
def test_what_has_lost_before_costs_no_rewind(measurement: Measurement, changes: dict[str, object]) -> None:
    history = admitted([Range("a", "b", 1.5, 2.0), Range("a", "b", 1.0, 2.0, None, 7), measurement], (), changes)
    for _ in range(2 * AT_ONCE):
        history.add(measurement)
        assert history.admit(20.0, node_due=False) == inf
    assert history.takes_late(node_due=False)


def test_covariances_take_room_only_where_one_is_stated() -> None:
    steps = [Odometry("a", 0.1 * k, 0.1 * k + 0.1, 0.3, 0.1) for k in range(9)]
    assert admitted(steps, (), {}).trails["a"]._rows.view.shape == (9, 7)
    stated = [*steps, Displacement("a", 1.0, 1.1, 0.1, 0.0, 0.0, COVARIANCE)]
    assert admitted(stated, (4, 8), {}).trails["a"]._rows.view.shape == (10, 13)


def test_steps_that_differ_in_a_covariance_that_does_not_count_are_one() -> None:
    steps = (Displacement("a", 0.0, 0.5, 0.1, 0.0, 0.0), Displacement("a", 0.0, 0.5, 0.1, 0.0, 0.0, COVARIANCE))
    for at in ((), (0,)):
        assert len(admitted(steps, at, {"motion": {"stated_covariance": False}}).trails["a"]._rows) == 1
