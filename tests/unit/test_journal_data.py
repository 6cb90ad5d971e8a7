"""What an estimate was made of: the ``data`` column, and the gate that makes it exact."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import Localizer, Odometry, Range
from dgorl.configuration import Configuration
from dgorl.team.bundles import Bundle, Name, Sealed
from dgorl.team.journal_admission import EARLY, Admission
from dgorl.team.journal_data import held, parse, ranges
from dgorl.team.journal_schema import JournalError
from dgorl.team.keys import UNSIGNED
from dgorl.team.wire import seal

names = st.builds(
    Name, st.sampled_from(["r1", "r2", "a:b", "é.7-9"]), st.integers(0, 2**64 - 1), st.integers(0, 40) | st.just(2**40)
)


@settings(max_examples=50, deadline=None)
@given(st.sets(names, max_size=60))
def test_data_reads_back(named):
    found = parse(ranges(held(named)))
    assert {
        Name(robot, epoch, sequence)
        for (robot, epoch), numbers in found.items()
        for first, last in numbers
        for sequence in range(first, last + 1)
    } == named


def test_data_looks_like_this():
    found = held([Name("r2", 255, 0), Name("r1", 2**64 - 1, 7), *(Name("r2", 255, k) for k in (3, 2, 9))])
    assert ranges(found) == "r1:ffffffffffffffff.7-7 r2:00000000000000ff.0-0+2-3+9-9"
    assert ranges({}) == ""


@pytest.mark.parametrize(
    "text", ["r1", "r1:00000000000000ff", "r1:ff.0-3", "r1:00000000000000ff.3", "r1:00000000000000ff.0-3+"]
)
def test_other_text_is_an_error(text):
    with pytest.raises(JournalError, match="is not robot:epoch"):
        parse(text)


def sealed(sequence: int, begin: float, end: float, reading: float | None = None) -> Sealed:
    rows = (Odometry("r2", begin, end, 0.5, 0.0),)
    heard = () if reading is None else (Range("r2", "r1", reading, 4.0, 0.1),)
    return Sealed(b"", Bundle("lab", "r2", 1, sequence, 0, max(end, reading or end), rows, ranges=heard))


def test_bundles_are_admitted_in_order_of_their_numbers_once():
    admission = Admission(Configuration())
    first, second = sealed(1, 0.5, 1.0), sealed(0, 0.0, 0.5)
    for bundle in (first, second, first):
        admission.offer(bundle)
    assert admission.due(1.0, takes_late=True) == (second, first)
    admission.offer(second)
    assert admission.due(1.5, takes_late=True) == ()
    assert admission.data == "r2:0000000000000001.0-1"


def test_what_tells_of_the_future_waits_for_it():
    admission = Admission(Configuration())
    admission.offer(sealed(0, 0.0, 2.0))
    assert admission.due(1.9, takes_late=True) == ()
    assert admission.data == ""
    assert len(admission.due(2.0, takes_late=True)) == 1


@pytest.mark.parametrize(("missing", "waits"), [(1, False), (2, False), (3, True), (9, True)])
def test_what_has_not_been_heard_yet_makes_no_gap(missing, waits):
    """Of bundles of half a second: two that are missing leave nothing that is more than a second long."""
    admission, last = Admission(Configuration()), 5 + missing
    bundles = [sealed(k, 0.5 * k, 0.5 * (k + 1)) for k in range(last + 2)]
    now = bundles[-1].bundle.cut
    for k in (*range(5), last, last + 1):
        admission.offer(bundles[k])
    assert len(admission.due(now, takes_late=True)) == (5 if waits else 7)
    for k in range(5, last):
        admission.offer(bundles[k])
    found = admission.due(now + 0.5, takes_late=True)
    assert found == tuple(bundles[5:] if waits else bundles[5:last])


def test_what_is_never_heard_is_a_gap_in_the_end():
    admission = Admission(Configuration())
    for k in (0, 1, 7, 8):
        admission.offer(sealed(k, 0.5 * k, 0.5 * (k + 1)))
    assert len(admission.due(4.5, takes_late=True)) == 2
    assert len(admission.due(11.5, takes_late=True)) == 0
    assert len(admission.due(12.0, takes_late=True)) == 0
    assert len(admission.due(12.5, takes_late=True)) == 2


def test_at_the_end_nothing_waits_for_what_has_not_been_heard():
    admission = Admission(Configuration())
    for k in (0, 7):
        admission.offer(sealed(k, 0.5 * k, 0.5 * (k + 1)))
    assert len(admission.due(4.5, takes_late=True, final=True)) == 2


def test_what_is_late_waits_whole_until_it_is_taken():
    admission = Admission(Configuration())
    late = sealed(0, 20.0, 21.0, reading=21.6)  # at 31.5 its odometry is late, its range is not
    admission.offer(late)
    assert [admission.due(now, takes_late=False) for now in (31.5, 35.5)] == [(), ()]
    assert admission.due(36.0, takes_late=True) == (late,)


def test_what_comes_in_late_goes_together_when_no_more_comes():
    admission = Admission(Configuration())
    admission.due(29.5, takes_late=True)
    late = [sealed(k, 10.0 + k, 11.0 + k) for k in range(9)]
    taken = []
    for k in range(9):  # for two seconds, and on
        admission.offer(late[k])
        taken.append(len(admission.due(30.0 + 0.5 * k, takes_late=True)))
    assert taken == [0, 0, 0, 0, 5, 0, 0, 0, 0]
    assert admission.due(34.5, takes_late=False) == ()
    assert admission.due(35.0, takes_late=True) == tuple(late[5:])
    admission.offer(sealed(9, 34.0, 34.5))
    assert len(admission.due(35.5, takes_late=True)) == 1  # in time


def test_what_is_older_than_the_history_is_refused_whole():
    admission = Admission(Configuration(history=60.0))
    admission.offer(sealed(0, 39.5, 40.5))
    assert admission.due(100.0, takes_late=True) == ()
    assert admission.rejected == {"too late": 1}
    admission.offer(sealed(1, 40.0, 41.0))
    assert len(admission.due(100.5, takes_late=True)) == 0
    assert len(admission.due(101.0, takes_late=True)) == 0
    assert admission.rejected == {"too late": 2}
    assert admission.data == ""


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.floats(0.0, 60.0), st.floats(0.0, 90.0)), max_size=25))
def test_a_localizer_holds_back_nothing_it_is_given(bundles):
    """Whatever comes when: after an update its inbox is empty and nothing was rejected."""
    configuration = Configuration(history=45.0)
    admission, localizer = Admission(configuration), Localizer("r1", configuration)
    arrivals = sorted((begin + delay, k, begin) for k, (begin, delay) in enumerate(bundles))
    given_, taken = 0, 0
    for now in (0.5 * k for k in range(320)):
        while given_ < len(arrivals) and arrivals[given_][0] <= now:
            _, k, begin = arrivals[given_]
            admission.offer(sealed(k, begin, begin + 0.5, reading=begin + 0.25))
            given_ += 1
        due = admission.due(now, takes_late=localizer.team.takes_late(now))
        taken += len(due)
        for bundle in due:
            for measurement in bundle.bundle.measurements:
                localizer.add(measurement)
        localizer.update(now)
        assert not localizer.team.history._inbox
        assert not localizer.team.history.rejected
    assert taken + admission.rejected["too late"] == len(bundles)


def test_a_clock_that_is_ahead_costs_others_nothing():
    """What is stamped far ahead waits apart; when its time comes it counts like any other."""

    def told(number: int, stamp: float) -> Sealed:
        rows = tuple(Range("r2", "r1", stamp, 3.0 + k) for k in range(200))
        return seal(Bundle("t", "r2", 7, number, 0, stamp, (), (), rows), UNSIGNED)

    admission = Admission(Configuration())
    fit = EARLY // len(told(300, 10_300.0).data)
    for number in range(300, 300 + fit + 50):
        admission.offer(told(number, 10_000.0 + number))
        assert admission.due(1.0, takes_late=True) == ()
        assert not admission._waiting
    lost = admission.rejected["ahead of the clock"]
    assert 40 <= lost <= 60, "so much waits as the limit says"
    assert admission.due(10_300.0 + lost - 0.5, takes_late=True) == ()
    (first,) = admission.due(10_300.0 + lost, takes_late=True)
    assert first == told(300 + lost, 10_300.0 + lost), "the newest were kept"
