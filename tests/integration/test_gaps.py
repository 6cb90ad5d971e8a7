"""Sensors that say nothing for a while: nobody is located while wrong, and everybody is found again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from dgorl import Displacement, Odometry
from dgorl.estimate import Estimate
from dgorl.logs.log import Log
from dgorl.measurements import known_at, robots_of
from tests.integration.driven import KNOWN, arriving, every, is_right, position_error, wandering, watched

HOMES = [[0, 0], [7, 1], [2, 6], [8, 7]]
BEGIN = 17.0


def silenced(log: Log, robots: Sequence[str], begin: float, end: float) -> Log:
    """The log without what these robots would have said between the stamps."""

    def said(m) -> bool:
        who = m.robot if isinstance(m, Displacement) else robots_of(m)[0]
        inside = m.start >= begin and m.end <= end if isinstance(m, Displacement) else begin < m.stamp <= end
        return not (who in robots and inside)

    return replace(log, measurements=tuple(m for m in log.measurements if said(m)))


def pairs_of(log: Log, robots: Sequence[str]) -> list[str]:
    """The peers of which r1 knows no more after a gap of these robots."""
    return [peer for peer in log.robots[1:] if {"r1", peer} & set(robots)]


def never_wrong(log: Log, estimates: Sequence[Estimate]) -> None:
    """Nobody is located and off by more than 1 m and 4 σ."""
    for estimate in estimates:
        for peer, found in estimate.items():
            if found.status in KNOWN:
                error, _, sigma = position_error(log, estimate, peer)
                assert error < max(1.0, 4 * sigma), (estimate.stamp, peer)


@pytest.mark.parametrize(
    ("robots", "gap", "seed"),
    [(["r3"], 2.0, 1), (["r1"], 4.5, 2), (["r2"], 9.0, 3), (["r1", "r2", "r3", "r4"], 2.5, 4)],
    ids=["a peer", "the ego, first by name", "long", "everybody at once"],
)
def test_after_a_gap_a_robot_is_not_located_until_it_is_found(robots: list[str], gap: float, seed: int) -> None:
    log = silenced(wandering(HOMES, 60, seed=seed), robots, BEGIN, BEGIN + gap)
    estimates = watched(log, every(0.5, 60))
    reason = estimates[int((BEGIN + gap) * 2) + 2][pairs_of(log, robots)[0]].reason
    assert f"for {gap:.1f} s until {BEGIN + gap:.1f} s" in reason
    again = [e for e in estimates if BEGIN + gap < e.stamp <= BEGIN + gap + 2.0]
    pairs = pairs_of(log, robots)
    assert estimates[int(BEGIN * 2) - 1]["r2"].status in KNOWN, "found before the gap"
    assert not any(e[peer].status in KNOWN for e in again for peer in pairs)
    never_wrong(log, estimates)
    for peer in log.robots[1:]:
        assert estimates[-1][peer].status in KNOWN
        assert is_right(log, estimates[-1], peer)


@pytest.mark.parametrize(("robot", "jump"), [("r2", (9.0, -3.0, 0.1)), ("r1", (0.2, 0.0, 8.0))], ids=["peer", "ego"])
def test_a_jump_of_the_odometry_is_no_motion(robot: str, jump: tuple[float, float, float]) -> None:
    log = wandering(HOMES, 50, seed=7)
    at = next(k for k, m in enumerate(log.measurements) if isinstance(m, Odometry | Displacement)
              and m.robot == robot and m.start >= 22.0)  # fmt: skip
    row = log.measurements[at]
    v, _, omega = (value / 0.1 for value in jump)
    wild = replace(row, dx=jump[0], dy=jump[1], dtheta=0.2) if abs(jump[2]) < 4 else None
    rows = [wild] if wild else [Odometry(robot, row.start, row.start + 0.1, v, omega)]
    broken = replace(log, measurements=(*log.measurements[:at], *rows, *log.measurements[at + 1 :]))
    estimates = watched(broken, every(0.5, 50))
    told = estimates[int(23.5 * 2) - 1]
    assert told.rejected == {f"odometry of {robot} faster than the limits": 1}
    assert told["r2"].status not in KNOWN
    assert f"odometry of {robot} faster than its limits at 22.0 s" in told["r2"].reason
    never_wrong(log, estimates)
    assert is_right(log, estimates[-1], "r2", metres=1.5)


def test_the_others_stay_where_they_were() -> None:
    log = wandering(HOMES, 45, seed=5)
    estimates = watched(silenced(log, ["r2"], BEGIN, BEGIN + 3.0), every(0.5, 45))
    for estimate in estimates[int(BEGIN * 2) :]:
        for peer in ("r3", "r4"):
            assert estimate[peer].status in KNOWN
            assert is_right(log, estimate, peer, metres=1.5)


def test_nothing_of_a_gap_is_left_when_late_rows_fill_it() -> None:
    """Odometry that arrives out of order makes a gap for a while."""
    log = wandering(HOMES[:3], 40, seed=6)
    rows = [m for m in log.measurements if isinstance(m, Displacement) and m.robot == "r2" and 20 <= m.start < 24]
    late = [known_at(m) + (6.0 if m in rows else 0.0) for m in log.measurements]
    punctual = [known_at(m) for m in log.measurements]
    stamps = every(0.5, 40.0, since=29.5)
    assert arriving(log.measurements, late, log, stamps) == arriving(log.measurements, punctual, log, stamps)
    during = [26.0]
    assert arriving(log.measurements, late, log, during) != arriving(log.measurements, punctual, log, during)


@pytest.mark.parametrize(("step", "seed"), [(4.0, 8), (3.0, 10)])
def test_a_clock_that_steps_inside_a_log_is_not_believed(step: float, seed: int) -> None:
    """Odometry of another time than the ranges: it fits for a while, but only as it is bent."""
    log = wandering(HOMES[:3], 70, seed=seed)
    stepped = tuple(
        replace(m, start=m.start + step, end=m.end + step)
        if isinstance(m, Displacement) and m.robot == "r2" and m.start >= 25.0
        else m
        for m in log.measurements
    )
    stamps = every(0.5, 69)
    for ego in ("r1", "r2"):
        estimates = watched(replace(log, measurements=stepped), stamps, ego)
        never_wrong(log, estimates)
        honest = watched(log, stamps, ego)
        assert sum(e["r3"].status in KNOWN for e in honest) > 90


def test_a_robot_of_flaky_odometry_is_not_lost_for_good() -> None:
    """1.5 s are missing of every 20 s."""
    log = wandering(HOMES, 80, seed=12)
    for begin in range(16, 76, 20):
        log = silenced(log, ["r2"], begin, begin + 1.5)
    estimates = watched(log, every(0.5, 80))
    never_wrong(log, estimates)
    assert sum(e["r2"].status in KNOWN for e in estimates if e.stamp > 16) > 0.3 * 2 * 64
    assert sum(e["r3"].status in KNOWN for e in estimates if e.stamp > 16) > 0.95 * 2 * 64
