"""Robots that come back in another epoch, as after a restart without their journal: nobody is lost, nobody wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest

from dgorl.configuration import Configuration, merge
from dgorl.logs.journal import read_journal
from dgorl.logs.log import Log
from dgorl.measurements import Displacement, known_at
from dgorl.replay import replay
from tests.integration.driven import KNOWN, every, is_right, position_error, wandering, watched
from tests.recordings import case

TRIANGLE = ([0, 0], [8, 0], [0, 8])
SQUARE = (*TRIANGLE, [8, 8])

AGAIN = 40.0
"""So long [s] after the last one came back everybody is located."""

Off = Mapping[str, Sequence[tuple[float, float]]]
"""From when until when [s] each robot is off; it comes back in another epoch."""


def restarted(log: Log, off: Off) -> Log:
    """The same log with robots that are off now and then: nothing is measured by them then, nor of them."""

    def runs(robot: str, start: float, end: float) -> bool:
        return not any(start < back and end > gone for gone, back in off.get(robot, ()))

    kept = []
    for m in log.measurements:
        if isinstance(m, Displacement):
            if runs(m.robot, m.start, m.end):
                epoch = 7 * sum(back <= m.start for _, back in off.get(m.robot, ()))
                kept.append(replace(m, epoch=(epoch * 1009) % 23))  # not in the order of time
        elif runs(m.robot, m.stamp, m.stamp) and runs(m.peer, m.stamp, m.stamp):
            kept.append(m)
    return replace(log, measurements=tuple(sorted(kept, key=known_at)))


@pytest.mark.parametrize(
    ("homes", "off"),
    [
        (TRIANGLE[:2], {"r2": [(30.0, 31.0)]}),
        (TRIANGLE, {"r1": [(15.0, 15.5)]}),
        (TRIANGLE, {"r1": [(27.0, 30.0)]}),
        (TRIANGLE, {"r1": [(12.0, 12.5), (24.0, 24.5), (37.0, 37.5), (49.0, 49.5)]}),
        (TRIANGLE, {"r3": [(20.0, 21.0)], "r1": [(26.0, 31.0)], "r2": [(45.0, 45.5)]}),
        (TRIANGLE, {robot: [(40.0, 42.0)] for robot in ("r1", "r2", "r3")}),
        (SQUARE, {"r1": [(14.0, 14.5), (50.0, 53.0)], "r4": [(29.5, 30.0)]}),
    ],
    ids=["of two", "while ambiguous", "once joined", "time and again", "one by one", "all at once", "two of four"],
)
@pytest.mark.parametrize("window", [10.0, 30.0])
def test_who_comes_back_in_another_epoch_is_located_again(homes: Sequence[Sequence[float]], off: Off, window: float):
    last = max(back for times in off.values() for _, back in times)
    log = restarted(wandering(homes, last + AGAIN, seed=len(off)), off)
    for ego in ("r1", "r2"):
        estimates = watched(log, every(2.5, last + AGAIN), ego, window=window)
        for estimate in estimates:
            for peer, found in estimate.items():
                if found.status in KNOWN:
                    error, _, sigma = position_error(log, estimate, peer)
                    assert error < 5 * sigma, (estimate.stamp, peer, error, sigma)
        end = estimates[-1]
        assert {
            peer: found.status in KNOWN and is_right(log, end, peer, metres=2.0) for peer, found in end.items()
        } == {robot: True for robot in log.robots if robot != ego}


def test_the_journal_of_an_agent_that_a_new_epoch_once_killed_replays():
    log = read_journal(case("new_epoch_journal/r2.journal"))
    ticks = list(replay(log, merge(Configuration(), log.configuration, "journal"), initial="unknown"))
    assert len(ticks) == len(log.live.steps)
    assert any(found.status in KNOWN for tick in ticks for found in tick.estimates["r2"].values())
