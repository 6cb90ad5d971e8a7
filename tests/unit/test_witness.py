"""When a robot believes that its epoch has ended. Times are on its own clock."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dgorl.team.bundles import Bundle
from dgorl.team.witness import BURST, COPY, OUTLIVED, PAUSE, QUIET, Witness

BORN, BEGAN = 100.0, 500.0


def witness() -> Witness:
    """Of an epoch that began long before the program."""
    made = Witness()
    made.begin(born=BORN, made=40, began=BEGAN)
    return made


def other(cut: float, sequence: int = 3, epoch: int = 9) -> Bundle:
    return Bundle("t", "r1", epoch, sequence, 0, cut)


def test_nothing_ends_without_proof() -> None:
    assert not witness().ended(1e9)
    assert not Witness().lived(other(1e9), 1e9)


@given(st.floats(0.0, BORN), st.integers(0, 2**40))
def test_what_was_made_before_the_epoch_began_is_none(cut: float, sequence: int) -> None:
    one = witness()
    assert not one.lived(other(cut, sequence), BEGAN + 1.0)
    assert not one.ended(BEGAN + 100.0)


def test_a_life_that_was_over_when_the_program_began_ends_the_epoch_at_once() -> None:
    one = witness()
    assert one.lived(other(BEGAN - 0.5), BEGAN + 1.0)
    assert one.ended(BEGAN + 1.0) == OUTLIVED


@given(st.lists(st.floats(0.1, 0.9 * QUIET), min_size=1, max_size=20))
def test_another_machine_counts_until_it_is_silent(gaps: list[float]) -> None:
    one, now = witness(), BEGAN + 1.0
    for sequence, gap in enumerate(gaps):
        assert one.lived(other(now, sequence), now)
        now += gap
        assert one.twin(now)
        assert not one.ended(now)
    assert one.lived(other(now - gaps[-1], len(gaps) - 1), now), "the same again"
    assert one.ended(now - gaps[-1] + QUIET + 1e-6) == OUTLIVED, "is no life"


def test_a_number_used_twice_ends_the_epoch_at_once() -> None:
    one = witness()
    assert one.knows(39)
    assert not one.knows(40)
    one.copied()
    assert one.ended(BEGAN) == COPY


def test_the_same_proof_serves_once_even_if_a_clock_was_set_back() -> None:
    one = witness()
    late = other(BEGAN + 1000.0)
    one.lived(late, BEGAN)
    assert one.ended(BEGAN + QUIET)
    one.begin(born=BEGAN + QUIET, began=BEGAN + QUIET)
    assert one.lived(late, BEGAN + 5.0), "counted"
    assert not one.ended(BEGAN + 50.0), "and no proof"


def test_epochs_follow_one_another_seldom() -> None:
    one, begun, now = witness(), 0, BEGAN
    while now < BEGAN + 10 * PAUSE:
        one.copied()
        if one.ended(now):
            begun += 1
            one.begin(born=now, began=now)
        now += 1.0
    assert begun == BURST + 9
