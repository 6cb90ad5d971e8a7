"""Readings stamped exactly where something begins or ends: estimates are those of the same set asked at other times."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import Bearing, Configuration, Localizer, Odometry, Range, RelativePose, Team
from dgorl.measurements import WORLD, Measurement, known_at

from .driven import bits

ROBOTS = ("r1", "r2", "r3")
END = 22.0
SMALL = 1e-6
"""Rows nearer than this follow on."""

Break = tuple[float, str]
"""When something happens to a robot's odometry, and what: ``epoch``, or how long a gap [s]."""


def odometry(robot: str, step: float, breaks: Sequence[Break]) -> list[Odometry]:
    """Rows of a robot of ``step`` [s], cut at the breaks."""
    rows, epoch, at, k = [], 0, 0.0, 0
    waiting = deque(sorted(breaks))
    while at < END:
        if waiting and at >= waiting[0][0]:
            _, what = waiting.popleft()
            epoch += what == "epoch"
            at += 0.0 if what == "epoch" else float(what)
            continue
        k += 1
        end = min(k * step, waiting[0][0] if waiting else END, END)
        if end > at:
            rows.append(Odometry(robot, at, end, 0.5, 0.3 * (1 + ROBOTS.index(robot)), epoch))
            at = end
    return rows


def readings(stamps: Sequence[float]) -> list[Measurement]:
    """At each stamp ranges and bearings among all, that would be true if nobody moved."""
    found: list[Measurement] = []
    for k, (i, j) in enumerate(((0, 1), (1, 2), (2, 0))):
        for stamp in stamps:
            found.append(Range(ROBOTS[i], ROBOTS[j], stamp, 4.0 + 0.1 * np.sin(stamp + k), 0.1))
            found.append(Bearing(ROBOTS[i], ROBOTS[j], stamp, float(np.cos(stamp + k)), 0.3))
    return found


def starts() -> list[Measurement]:
    cov = (0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
    return [RelativePose(WORLD, r, 0.0, 4.0 * k, float(k % 2), 0.5 * k, cov, True) for k, r in enumerate(ROBOTS)]


def asked(measurements: Sequence[Measurement], times: Sequence[float], configuration: Configuration) -> dict:
    """What all say at the last time, having been asked at the others before, with what was known then."""
    team = Team(configuration)
    waiting = deque(sorted(measurements, key=known_at))
    for now in times:
        while waiting and known_at(waiting[0]) <= now:
            team.add(waiting.popleft())
        state = team.update(now)
    return {robot: bits(team.view(robot, state, now)) for robot in ROBOTS}


def compare(breaks: dict[str, list[Break]], step: float, times: list[float], shift: float, window: float) -> None:
    rows = [row for robot in ROBOTS for row in odometry(robot, step, breaks.get(robot, ()))]
    borders = {at + shift for row in rows for at in (row.start, row.end)} | {float(k) for k in range(1, int(END), 2)}
    measurements = [*starts(), *rows, *readings(sorted(s for s in borders if s > 0))]
    now = END + 0.5
    configuration = Configuration(window=window)
    expected = asked(measurements, [now], configuration)
    assert asked(measurements[::-1], [*sorted(times), now], configuration) == expected


moments = st.sampled_from([5.0, 7.5, 8.25, 10.0, 11.3, 12.5, 15.0, 16.0])
happenings = st.tuples(moments, st.sampled_from(["epoch", "0.4", "1.0", "2.5", "6.0", "7.5"]))


@settings(deadline=None, max_examples=15)
@given(
    breaks=st.dictionaries(st.sampled_from(ROBOTS), st.lists(happenings, max_size=3, unique_by=lambda b: b[0])),
    step=st.sampled_from([0.5, 0.25, 1.0, 0.7]),
    times=st.lists(st.one_of(moments, st.sampled_from([5.5, 8.0, 11.5, 13.0, 16.5, 20.0, 21.3])), max_size=6),
    shift=st.sampled_from([0.0, 0.0, 0.0, SMALL / 2, -SMALL / 2]),
    window=st.sampled_from([5.0, 10.0]),
)
def test_when_it_is_asked_leaves_no_trace(breaks, step, times, shift, window) -> None:
    compare(breaks, step, times, shift, window)


@pytest.mark.parametrize("at", [10.0, 11.3, 12.5])
@pytest.mark.parametrize("shift", [0.0, -SMALL / 2])
def test_a_reading_stamped_as_an_epoch_begins_is_the_new_epochs(at: float, shift: float) -> None:
    """Whether or not the old epoch was asked about when the new one was not known yet."""
    times = [at, at + 0.1, 14.0, 17.0]
    compare({"r2": [(at, "epoch")]}, 0.5, times, shift, 10.0)


def test_the_localizer_does_so_too() -> None:
    rows = [row for robot in ROBOTS for row in odometry(robot, 0.5, [(10.0, "epoch")] if robot == "r2" else [])]
    measurements = [*starts(), *rows, *readings([k / 2 for k in range(1, 40)])]
    found = []
    for times in ([20.5], [10.0, 10.1, 10.5, 20.5]):
        localizer = Localizer("r1", Configuration(window=10.0))
        waiting = deque(sorted(measurements, key=known_at))
        for now in times:
            while waiting and known_at(waiting[0]) <= now:
                localizer.add(waiting.popleft())
            estimate = localizer.update(now)
        found.append(bits(estimate))
    assert found[0] == found[1]
