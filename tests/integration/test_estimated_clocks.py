"""``clock: estimated``: a team whose robots have no clock in common is located as if they had (METHOD §1)."""

from __future__ import annotations

import random
from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from dgorl import Localizer, Odometry, Status, Team, se2
from dgorl.measurements import ClockReading, known_at
from dgorl.replay import known_starts
from dgorl.team_time import ClockedTeam, team_on
from tests.integration.own_clocks import (
    Clock,
    all_pairs,
    author,
    clocks_of,
    distorted,
    exchanged,
    key,
    line,
    prompt,
    slow,
    stamped,
)
from tests.integration.teams import settings, simulated

GOOD = (Status.TRACKED, Status.POSITION)


def configured(log, **changes):
    return settings(log, clock="estimated", **changes)


def heard(log, clocks, readings, late=None):
    """(true time of arrival, measurement or reading, its clock), in the order of arrival."""
    rng = random.Random(late)
    items = [
        (known_at(m), raw, clock) for m, (clock, raw) in zip(log.measurements, distorted(log, clocks), strict=True)
    ]
    items += [(true, reading, None) for true, reading in readings]
    if late is not None:
        items = [(true + rng.uniform(0, 12.0), *rest) for true, *rest in items]
    items.sort(key=lambda item: item[0])
    starts = [(-1.0, stamped(m, clocks[m.robot]), key(m.robot)) for m in known_starts(log)]
    return starts + items


def give(team, item, clock):
    if isinstance(item, ClockReading):
        team.add_reading(item)
    else:
        team.add(item, clock)


def localised(team, log, clock, items, stamps, home="r1"):
    """Every robot's estimate at the true ``stamps``, as ``home``, whose clock it is, knows it; and the team times."""
    found, times = {}, []
    waiting = iter([*items, (np.inf, None, None)])
    true, item, by = next(waiting)
    for stamp in stamps:
        while true <= stamp:
            give(team, item, by)
            true, item, by = next(waiting)
        now = team.team_now(*key(home), clock.at(stamp))
        state = team.update(now)
        times.append(now)
        found |= {(float(stamp), ego): team.view(ego, state, now) for ego in log.robots}
    return found, times


def bits(estimates):
    return {
        (*at, peer): (
            e.status,
            e.pose is not None and e.pose.tobytes(),
            e.covariance is not None and e.covariance.tobytes(),
        )
        for at, estimate in estimates.items()
        for peer, e in estimate.items()
    }


def errors(log, estimates):
    """Relative position errors [m] by (stamp, ego, peer), where the estimate says it is good."""

    def at(robot, stamp):
        t, x, y, theta = log.truth[robot].T
        return np.array([np.interp(stamp, t, x), np.interp(stamp, t, y), np.interp(stamp, t, np.unwrap(theta))])

    found = {}
    for (stamp, ego), estimate in estimates.items():
        for peer in log.robots:
            if peer in estimate and estimate[peer].status in GOOD:
                true = se2.compose(se2.inverse(at(ego, stamp)), at(peer, stamp))
                found[stamp, ego, peer] = float(np.hypot(*(estimate[peer].pose - true)[:2]))
    return found


def rmse(found, common):
    return sqrt(sum(found[k] ** 2 for k in common) / len(common))


def compared(log, clocks, readings, home="r1", last=50.0):
    """RMSE with estimated clocks and with the perfect one of ``home``, over what both call good; and their share.

    Odometry and readings of the simulator end at the same instant, and so do ticks. Here readings come at every other
    step and ticks between them: by a clock 0.1 ms off, the newest would miss the tick, with a perfect one never.
    """
    log = replace(log, measurements=[m for m in log.measurements if hasattr(m, "end") or m.stamp == round(m.stamp)])
    stamps = np.arange(1.52, last, 1.0)
    team = ClockedTeam(configured(log), key(home))
    own, _ = localised(team, log, clocks[home], heard(log, clocks, readings), stamps, home)
    one = dict.fromkeys(log.robots, clocks[home])
    perfect, _ = localised(Team(settings(log)), log, clocks[home], heard(log, one, ()), stamps, home)
    a, b = errors(log, own), errors(log, perfect)
    assert team.restarts == 0
    return rmse(a, a.keys() & b.keys()), rmse(b, a.keys() & b.keys()), len(a.keys() & b.keys()) / len(b)


@pytest.fixture(scope="module")
def log():
    return simulated()


def test_prompt_links_are_as_good_as_perfect_clocks():
    """± 5 s, 50 ppm: the relative RMSE stays within 2 % of that with one clock."""
    squares = np.zeros(2)
    for seed in range(4):
        log = simulated(robots=4, steps=100, seed=seed, sensors=("rssi", "range"))
        clocks = clocks_of(log.robots, random.Random(seed))
        readings = exchanged(all_pairs(log.robots), clocks, (0.0, 50.0), random.Random(seed))
        own, perfect, share = compared(log, clocks, readings)
        squares += own**2, perfect**2
        assert share > 0.7
    own, perfect = np.sqrt(squares)
    assert abs(own / perfect - 1.0) < 0.02


@pytest.mark.parametrize("pairs", [all_pairs, line])
def test_slow_and_lossy_links(pairs):
    """Delays of 0 to 0.5 s, half of the messages lost, also where only neighbours hear one another."""
    log = simulated(robots=4, steps=160, seed=2, sensors=("rssi", "range"))
    clocks = clocks_of(log.robots, random.Random(7))
    readings = exchanged(pairs(log.robots), clocks, (0.0, 80.0), random.Random(7), slow, 0.5)
    own, perfect, share = compared(log, clocks, readings, last=80.0)
    assert share > (0.6 if pairs is all_pairs else 0.15)
    assert own < 1.15 * perfect + 0.02


@hypothesis_settings(deadline=None, max_examples=4)
@given(seed=st.integers(0, 2**32 - 1))
def test_late_shuffled_and_duplicated_arrival_leaves_no_trace(log, seed):
    """Half a minute after the last of it came, nobody can tell when and in which order it came."""
    clocks = clocks_of(log.robots, random.Random(seed))
    readings = exchanged(line(log.robots), clocks, (0.0, 30.0), random.Random(seed), slow, 0.3)
    quiet = [58.0, 63.3]
    stamps = [*np.arange(1.0, 30.0, 0.5), *np.arange(31.0, 58.0, 1.5), *quiet]

    def run(items, stamps):
        team = ClockedTeam(configured(log), key("r1"))
        estimates, times = localised(team, log, clocks["r1"], items, stamps)
        return {k: v for k, v in bits(estimates).items() if k[0] in quiet}, times[-2:]

    in_time = heard(log, clocks, readings)
    expected = run(in_time, stamps)
    assert len(expected[0]) >= 12
    assert run(heard(log, clocks, readings, seed), stamps) == expected
    shuffled = [(0.0, *rest) for _, *rest in in_time * 2]
    random.Random(seed).shuffle(shuffled)
    assert run(shuffled, quiet) == expected


def test_every_robot_computes_the_same(log):
    """The team as r2 and r3 know it is what r1 knows, bit for bit, each with its own clock."""
    clocks = clocks_of(log.robots, random.Random(1))
    readings = exchanged(all_pairs(log.robots), clocks, (0.0, 30.0), random.Random(1))
    found = {}
    for home in log.robots:
        team = ClockedTeam(configured(log), key(home))
        items = heard(log, clocks, readings)
        random.Random(home).shuffle(items)
        for _, item, clock in items:
            give(team, item, clock)
        assert team.team_now(*key(home), clocks[home].at(25.0)) is not None
        team.update(25.0 + clocks["r1"].offset)
        now = 29.5 + clocks["r1"].offset
        state = team.update(now)
        found[home] = bits({(0.0, ego): team.view(ego, state, now) for ego in log.robots})
        assert team.clocks.chain.reference == key("r1")
    assert found["r1"] == found["r2"] == found["r3"]
    assert len(found["r1"]) == 9  # two peers and the world each


def test_a_partition_costs_rewinds_and_ends_in_the_same(log):
    """r3's messages of 10 s to 24 s come all at once: maps change that have served, and the team is rewound."""
    clocks = clocks_of(log.robots, random.Random(3))
    readings = exchanged(all_pairs(log.robots), clocks, (0.0, 30.0), random.Random(3))
    items = heard(log, clocks, readings)

    def by_r3(item):
        return item.robot == "r3" if isinstance(item, ClockReading) else author(item) == "r3"

    parted = [((24.0 if 10.0 < true < 24.0 and by_r3(item) else true), item, clock) for true, item, clock in items]
    parted.sort(key=lambda item: item[0])
    stamps = [*np.arange(1.0, 46.0, 0.5)]
    late, in_time = (ClockedTeam(configured(log), key("r1")) for _ in range(2))
    found, _ = localised(late, log, clocks["r1"], parted, stamps)
    expected, _ = localised(in_time, log, clocks["r1"], items, stamps)
    assert in_time.rewinds == 0
    assert late.rewinds > 0
    assert bits({k: v for k, v in found.items() if k[0] > 45}) == bits({k: v for k, v in expected.items() if k[0] > 45})


def test_who_is_not_placed_is_isolated_and_told_why(log):
    clocks = clocks_of(log.robots, random.Random(4))
    team = ClockedTeam(configured(log), key("r1"))
    readings = [
        r for r in exchanged(all_pairs(log.robots), clocks, (0.0, 30.0), random.Random(4)) if r[1].robot != "r3"
    ]
    found, _ = localised(team, log, clocks["r1"], heard(log, clocks, readings), np.arange(1.0, 20.0, 0.5))
    estimate = found[19.5, "r1"]
    assert estimate["r2"].status in GOOD
    assert estimate["r3"].status is Status.ISOLATED
    assert "clock" in estimate["r3"].reason
    assert estimate["r3"].resolve_by
    assert set(estimate.clocks) == {"r1", "r2"}
    state = estimate.clocks["r2"]
    true = clocks["r1"].offset - clocks["r2"].offset
    assert state.offset == pytest.approx(true, abs=0.005)
    assert state.drift == pytest.approx(clocks["r1"].drift - clocks["r2"].drift, abs=5e-5)
    assert 0 < state.sigma < 0.02
    assert estimate.clocks["r1"].offset == 0.0


def test_another_reference_restarts_the_team(log):
    """r1 and r2 begin 20 s before r3 and meet it then: r3 takes their time and goes on."""
    clocks = clocks_of(log.robots, random.Random(5))
    readings = exchanged([("r1", "r2")], clocks, (-20.0, 30.0), random.Random(5))
    readings += exchanged([("r2", "r3")], clocks, (10.0, 30.0), random.Random(6))
    items = heard(log, clocks, sorted(readings, key=lambda item: item[0]))
    items.sort(key=lambda item: item[0])
    team = ClockedTeam(configured(log), key("r3"))
    found, times = localised(team, log, clocks["r3"], items, np.arange(1.0, 29.0, 0.5), "r3")
    assert team.restarts == 1
    assert team.clocks.chain.reference == key("r1")
    assert times[0] == clocks["r3"].at(1.0)
    assert times[-1] == pytest.approx(clocks["r1"].at(28.5), abs=0.005)
    assert all(found[28.5, "r3"][peer].status in GOOD for peer in ("r1", "r2"))


def test_a_shared_clock_ignores_clocks(log):
    team = team_on(settings(log), key("r1"))
    assert type(team) is Team
    assert type(team_on(configured(log), key("r1"))) is ClockedTeam
    localizer = Localizer("r1", team=team)
    localizer.add(Odometry("r2", 0.0, 0.5, 1.0, 0.0), clock=("r2", 5))
    team.add_reading(ClockReading("r1", 1, "r2", 5, 0.0, 100.0))
    team.add_birth(("r2", 5), 0.0)
    assert team.team_now("r1", 1, 0.5) == 0.5
    assert set(localizer.update(0.5)) == {"r2"}
    assert not localizer.update(0.5).clocks


def test_wheels_keep_the_way_they_measured():
    """A fast clock stretches odometry's time, not its way."""
    clocks = {"r1": Clock(), "r2": Clock(0.0, 4e-4)}
    configuration = settings(simulated(), clock="estimated")
    team = ClockedTeam(configuration, key("r1"))
    for _, reading in exchanged([("r1", "r2")], clocks, (0.0, 40.0), random.Random(0), prompt):
        team.add_reading(reading)
    raw = Odometry("r2", 0.0, 40.0 * 1.0004, 1.0, 0.5)
    team.add(raw, key("r2"))
    team.update(40.1)
    mapped = team._given[key("r2")][0][1]
    assert mapped.end == pytest.approx(40.0, abs=1e-3)
    assert mapped.v * (mapped.end - mapped.start) == pytest.approx(raw.v * (raw.end - raw.start), rel=1e-12)
    assert mapped.omega * (mapped.end - mapped.start) == pytest.approx(raw.omega * (raw.end - raw.start), rel=1e-12)


@hypothesis_settings(deadline=None, max_examples=20)
@given(data=st.data())
def test_update_never_raises(data):
    """Whatever readings say, and whatever the time is."""
    team = ClockedTeam(settings(simulated(), clock="estimated"), ("r1", 1))
    times = st.one_of(st.floats(-1e10, 1e10), st.floats(0, 60))
    robots = st.sampled_from(["r1", "r2", "r3"])
    for _ in range(data.draw(st.integers(0, 25))):
        a, b = data.draw(robots), data.draw(robots)
        if a != b:
            team.add_reading(ClockReading(a, 1, b, 1, data.draw(times), data.draw(times)))
        start = data.draw(times)
        if start + 1 > start and start + 1 <= 1e10:
            team.add(Odometry(a, start, start + 1.0, 1.0, 0.1), (a, 1))
    now = data.draw(st.floats(-1e9, 1e9))
    for k in range(3):
        assert team.update(now + 6.0 * k) is not None
