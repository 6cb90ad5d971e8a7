"""More readings than any sensor makes: few count, the same in whatever order they came, at a cost that is bounded."""

from __future__ import annotations

from collections import Counter
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl.crowds import PER_PAIR, PER_ROBOT, Order, crowded_out, sampled, second
from dgorl.exchanges import EXCHANGE, Reading
from dgorl.history import History
from dgorl.measurements import Range, Rssi
from dgorl.sightings import Table
from dgorl.team.bundler import Bundler

NAMES = ("a", "b", "c", "d", "e", "f", "g")


def crowd(seed: int, count: int, numbers: int, robots: int = 3, span: float = 2.0) -> list[Reading]:
    """Readings within ``span`` seconds, some of them of numbered exchanges, most by the first robot."""
    random = Random(seed)
    found = {}
    for _ in range(count):
        a, b = random.sample(range(robots), 2) if random.random() < 0.3 else (0, 1)
        number = random.randrange(numbers) if numbers and random.random() < 0.5 else None
        stamp = round(random.uniform(0.001, span), 3)
        reading = Reading(stamp, NAMES[a], NAMES[b], random.uniform(1, 9), 0.1, a, b, number)
        found[reading.order] = reading
    return list(found.values())


def rows(table: Table) -> list[tuple[float, ...]]:
    view = table.between(-np.inf, np.inf)
    numbers = zip(*(column.view.tolist() for column in table._robots), strict=True)
    return [(*row, *pair) for row, pair in zip(zip(*(c.tolist() for c in view[:3]), strict=True), numbers, strict=True)]


def added(readings: list[Reading], batches: int) -> list[tuple[float, ...]]:
    table = Table("range", 0.0, directed=False)
    for k in range(batches):
        table.add(readings[k::batches])
    return rows(table)


def expected(readings: list[Reading]) -> list[tuple[float, ...]]:
    """Those left of each robot and second; of these, the first of each exchange."""
    groups: dict[tuple[int, str], list[Order]] = {}
    for reading in readings:
        groups.setdefault((second(reading.stamp), reading.a), []).append(reading.order)
    out = {order for group in groups.values() for order in crowded_out(group)}
    counted, last = [], dict[object, float]()
    for reading in sorted(r for r in readings if r.order not in out):
        slot = (*sorted((reading.a, reading.b)), reading.exchange)
        if reading.exchange is None or reading.stamp - last.get(slot, -np.inf) > EXCHANGE:
            counted.append(reading)
        last[slot] = reading.stamp
    return [(r.stamp, r.value, r.sigma, float(r.robot_a), float(r.robot_b)) for r in counted]


@settings(deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 400), st.sampled_from([0, 5, 60]), st.integers(1, 15))
def test_what_counts_does_not_depend_on_the_order(seed: int, count: int, numbers: int, batches: int) -> None:
    readings = crowd(seed, count, numbers)
    Random(seed).shuffle(readings)
    assert added(readings, batches) == expected(readings)


@given(st.integers(0, 10**6), st.integers(100, 900))
def test_no_robot_has_more_than_its_share(seed: int, count: int) -> None:
    readings = crowd(seed, count, 0, robots=7, span=1.0)
    kept = added(readings, 3)
    by_pair = Counter(row[3:] for row in kept)
    assert max(by_pair.values()) <= PER_PAIR
    assert max(Counter(row[3] for row in kept).values()) <= PER_ROBOT


@given(st.integers(0, 10**6), st.integers(1, 4), st.integers(1, PER_PAIR))
def test_sensors_are_not_thinned(seed: int, pairs: int, rate: int) -> None:
    random = Random(seed)
    orders = [(random.random(), "a", NAMES[1 + p], random.random(), 0.1) for p in range(pairs) for _ in range(rate)]
    assert crowded_out(orders) == []
    assert sampled(orders, lambda order: order, 1) == orders


def test_thinning_is_never_finer() -> None:
    table = Table("range", 1e-6, directed=False)
    table.add([Reading(k / 1000, "a", "b", 1.0, 0.1, 0, 1) for k in range(1, 1001)])
    assert len(table) == PER_PAIR


@pytest.mark.parametrize("batches", [1, 7])
def test_the_history_takes_few_of_many(batches: int) -> None:
    from dgorl import Configuration

    history = History(Configuration())
    ranges = [Range("b", "a", 10.0 + (k + 1) / 1500, 3.0 + 0.001 * k, 0.1) for k in range(1500)]
    signals = [Rssi("a", "b", m.stamp, -40.0 - m.range) for m in ranges]
    for k in range(batches):
        for m in (*ranges[k::batches], *signals[k::batches]):
            history.add(m)
        history.admit(11.0, node_due=False)
    assert [len(history.tables[kind]) for kind in ("range", "rssi")] == [PER_PAIR, PER_PAIR]


def test_a_robot_sends_no_more_than_counts() -> None:
    bundler = Bundler("lab", "a", 1)
    for k in range(600):
        bundler.add(Range("a", "b", 0.4 + k * 1e-4, 2.0, 0.1))
    for k in range(20):
        bundler.add(Range("a", "c", 0.4 + k * 1e-3, 2.0, 0.1))
    (bundle,) = bundler.cut(0.5)
    assert Counter(m.peer for m in bundle.ranges) == {"b": PER_PAIR, "c": 20}
    assert bundler.dropped == {"more readings than count": 600 - PER_PAIR}
