"""The parts gossip is made of: sets of numbers, rates, losses, shelves, stamps."""

from __future__ import annotations

from itertools import pairwise
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl.team.bundles import Bundle, Name, Sealed
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.neighbours import LATEST, Neighbour, Stamps
from dgorl.team.outbox import REPEAT, Outbox
from dgorl.team.ranges import Ranges
from dgorl.team.rates import Bucket, Losses
from dgorl.team.shelf import BYTES, COUNT, Shelf
from dgorl.team.wants import AGAIN, AT_ONCE, GRACE, Wants

intervals = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 6)).map(lambda p: (p[0], p[0] + p[1])), max_size=12)


def numbers(ranges: Ranges) -> set[int]:
    return {n for low, high in ranges for n in range(low, high + 1)}


def plain(pairs: list[tuple[int, int]]) -> set[int]:
    return {n for low, high in pairs for n in range(low, high + 1)}


@settings(max_examples=100, deadline=None)
@given(intervals, intervals, st.integers(0, 45), st.integers(0, 45))
def test_ranges_are_sets(a: list[tuple[int, int]], b: list[tuple[int, int]], low: int, high: int) -> None:
    x, y, p, q = Ranges(a), Ranges(b), plain(a), plain(b)
    assert numbers(x) == p
    assert all(first[1] + 1 < second[0] for first, second in pairwise(x)), "intervals follow on in order, apart"
    assert numbers(x.minus(y)) == p - q
    assert numbers(x.both(y)) == p & q
    assert numbers(x.within(low, high)) == {n for n in p if low <= n <= high}
    assert [n for n in range(50) if n in x] == sorted(p)
    assert list(x.newest(7)) == sorted(p, reverse=True)[:7]
    assert (x.low, x.high, x.count(), bool(x)) == (min(p, default=-1), max(p, default=-1), len(p), bool(p))
    assert (x == y) == (p == q)
    x.drop_below(low)
    assert numbers(x) == {n for n in p if n >= low}


def test_ranges_of_huge_gaps_are_small() -> None:
    ranges = Ranges([(0, 0), (2**62, 2**62)])
    assert len(ranges) == 2
    assert list(Ranges([(0, 2**62)]).minus(ranges)) == [(1, 2**62 - 1)]


def test_bucket_passes_its_rate_and_burst() -> None:
    bucket = Bucket(rate=8.0, burst=20.0)
    assert sum(bucket.take(1.0, 0.0) for _ in range(100)) == 20
    assert sum(bucket.take(1.0, 0.125 * k) for k in range(1, 101)) == 100
    assert not bucket.take(30.0, 1e6), "more than a burst never passes"
    assert bucket.take(20.0, 5.0), "a clock that runs backwards gives nothing and takes nothing"


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.5, 0.9])
def test_losses_are_estimated(loss: float) -> None:
    random, losses, shares = Random(1), Losses(), []
    for k in range(2000):
        if random.random() >= loss:
            losses.count(k % Losses.MODULUS)
            shares.append(losses.share)
    assert sum(shares) / len(shares) == pytest.approx(loss, abs=0.05)


def test_overtaken_messages_are_no_losses() -> None:
    losses = Losses()
    for k in [0, 2, 1, 4, 3, 6, 5, 8, 7]:
        losses.count(k)
    assert losses.share == pytest.approx(0.0, abs=0.02)


def sealed(number: int, cut: float, size: int = 100) -> Sealed:
    return Sealed(bytes(size), Bundle("t", "r1", 7, number, 0, cut))


def test_shelf_lets_go_what_is_old_and_knows_it_had_it() -> None:
    shelf = Shelf(retention=10.0)
    assert all(shelf.add(sealed(k, 0.5 * k), now=0.5 * k) for k in range(100))
    assert list(shelf.kept) == [(79, 99)]
    assert list(shelf.had) == [(0, 99)]
    assert not shelf.add(sealed(3, 1.5), now=50.0)
    assert shelf.data(78) is None
    assert shelf.data(79) is not None


def test_shelf_is_bounded_in_number_and_bytes() -> None:
    shelf = Shelf(retention=1e9)
    for k in range(COUNT + 10):
        shelf.add(sealed(k, float(k)), now=0.0)
    assert shelf.kept.count() == COUNT
    heavy = Shelf(retention=1e9)
    for k in range(10):
        heavy.add(sealed(k, float(k), BYTES // 4), now=0.0)
    assert heavy.kept.count() == 4


def test_outbox_repeats_and_stops() -> None:
    outbox, name = Outbox(), Name("r1", 7, 0)
    outbox.add(name, due=1.0, copies=3)
    sent = []
    for k in range(400):
        for due in outbox.due(0.01 * k):
            outbox.sent(due, 100, 0.01 * k)
            sent.append(0.01 * k)
    assert len(sent) == 3
    assert sent[0] == pytest.approx(1.0)
    assert all(b - a == pytest.approx(REPEAT, abs=0.011) for a, b in pairwise(sent))


def test_wants_ask_one_then_others_the_newest_first() -> None:
    wants, key = Wants(), ("r9", 7)
    missing = {key: Ranges([(0, 2 * AT_ONCE)])}
    wants.refresh([missing], now=0.0)
    assert not wants.pressing(GRACE / 2)
    assert wants.requests(lambda name: ["a", "b"], 1, GRACE / 2) == {}
    first = wants.requests(lambda name: ["a", "b"], 1, GRACE)
    asked = [n for of in first.values() for n in numbers(of[key])]
    assert sorted(asked) == list(range(AT_ONCE + 1, 2 * AT_ONCE + 1)), "each of one robot, the newest"
    assert set(first) == {"a", "b"}, "the load is shared"
    assert wants.requests(lambda name: ["a", "b"], 1, GRACE + AGAIN) == {}, "the answer to so many takes a while"
    again = wants.requests(lambda name: ["a", "b"], 1, GRACE + AGAIN + 0.004 * AT_ONCE + 0.1)
    assert 2 * AT_ONCE in again["a"][key] or 2 * AT_ONCE in again["b"][key]
    one_of = next(robot for robot, of in first.items() if 2 * AT_ONCE in of[key])
    assert 2 * AT_ONCE not in again.get(one_of, {}).get(key, Ranges()), "another one is asked now"
    wants.refresh([], now=10.0)
    assert wants.requests(lambda name: ["a"], 1, 20.0) == {}


def test_a_lie_hides_nothing_that_another_holds() -> None:
    wants, key = Wants(), ("r9", 7)
    for k in range(1, 9):  # numbers nobody holds, new ones every time
        lie, truth = Ranges([(k * 10**6, k * 10**6 + 2 * AT_ONCE)]), Ranges([(10, 19)])
        wants.refresh([{key: lie}, {key: truth}], now=k * GRACE)
        asked = wants.requests(lambda name: ["b"] if name.sequence < 20 else ["a"], 1, (k + 1) * GRACE)
        if "b" in asked:
            assert numbers(asked["b"][key]) == set(range(10, 20))
            return
    raise AssertionError("never asked for")


def test_requests_that_stand_name_one_holder_each_at_every_look() -> None:
    wants, key = Wants(), ("r9", 7)
    wants.refresh([{key: Ranges([(0, 40)])}], now=0.0)
    for k in range(20):
        asked = wants.standing(lambda name: ["a", "b", "c"], GRACE + 0.25 * k)
        assert sum(of[key].count() for of in asked.values()) == 41
    assert set(asked) == {"a", "b", "c"}


def test_stamps_know_what_was_heard() -> None:
    stamps = Stamps()
    for stamp in (10.0, 12.0, 11.0):
        stamps.check(1, stamp)
        stamps.mark(1, stamp)
    for stamp in (10.0, 11.0, 12.0, 12.0 - LATEST - 0.1):
        with pytest.raises(Rejected) as rejected:
            stamps.check(1, stamp)
        assert rejected.value.reason == Reason.REPLAYED
    stamps.check(2, 10.0)
    for k in range(10_000):
        stamps.mark(1, 12.0 + 0.1 * k)
    assert max(len(seen) for _, seen in stamps._epochs.values()) < 200, "memory is bounded"


def test_a_neighbour_shows_what_it_holds() -> None:
    neighbour = Neighbour(("r2", 5))
    neighbour.showed(Name("r1", 7, 3))
    neighbour.showed(Name("r2", 5, 10))
    neighbour.showed(Name("r2", 5, 14))
    assert list(neighbour.holds["r1", 7]) == [(3, 3)]
    assert list(neighbour.holds["r2", 5]) == [(10, 14)], "its own it holds without gaps"
    for k in range(20_000):
        neighbour.showed(Name("r3", 1, 2 * k))
    assert len(neighbour.holds["r3", 1]) <= 4096
