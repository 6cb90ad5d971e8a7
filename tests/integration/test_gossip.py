"""Bundles reach everyone: bad networks, relays, partitions, restarts, late joins. Virtual time, chance by seed."""

from __future__ import annotations

from dataclasses import replace
from hashlib import blake2b
from random import Random

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dgorl.team.faults import Faults, Partition, topology

from ..team_network import Network, Robot, lossy


def started(count: int, faults: Faults | None = None, **options: object) -> Network:
    network = Network(count, faults, **options)  # type: ignore[arg-type]
    network.start(*network.names)
    return network


def delays(network: Network, since: float) -> np.ndarray:
    """How long bundles cut after ``since`` took to reach the others [s]."""
    return np.array([
        stamp - robot.journal[name].bundle.cut
        for robot in network.robots.values()
        for name, stamp in robot.arrivals.items()
        if name.robot != robot.name and robot.journal[name].bundle.cut > since
    ])  # fmt: skip


def everything(network: Network, seconds: float) -> int:
    return round(seconds / 0.5) * len(network.robots)


def test_without_faults_all_comes_at_once_and_traffic_is_small() -> None:
    network = started(5, signed=True)
    network.run(20.0)
    before = {robot.name: robot.air.traffic.sent_bytes for robot in network.robots.values()}
    network.run(20.0)
    for robot in network.robots.values():
        assert (robot.air.traffic.sent_bytes - before[robot.name]) / 20.0 <= 2000.0
        assert not robot.gossip.rejected
        assert not robot.gossip.counts["requests sent"]
    network.run(0.1)
    assert network.equal()
    assert len(network.robots["r1"].journal) == everything(network, 40.0)
    assert delays(network, 5.0).max() <= 0.1


@pytest.mark.parametrize("seed", range(4))
def test_half_lost_late_twice_and_overtaken(seed: int) -> None:
    network = started(5, lossy(seed=seed), seed=seed)
    network.run(30.0)
    assert not network.equal()
    network.quiet = True
    network.run(10.0)
    assert network.missing() == dict.fromkeys(network.names, 0)
    assert len(network.robots["r1"].journal) == everything(network, 30.0)


def test_signed_and_half_lost() -> None:
    network = started(4, lossy(seed=9), signed=True)
    network.run(10.0)
    network.quiet = True
    network.run(10.0)
    assert network.equal()
    assert {reason for robot in network.robots.values() for reason in robot.gossip.rejected} <= {"replayed"}


@pytest.mark.parametrize("seed", range(2))
def test_nine_of_ten_lost(seed: int) -> None:
    """All that was measured is with all within a second or two; of messages and bytes no more is sent than may be."""
    network = started(5, Faults(loss=0.9, seed=seed), signed=True, seed=seed)
    network.run(15.0)
    assert all(len(robot.admitted) == 4 for robot in network.robots.values())
    before = {name: robot.air.traffic for name, robot in network.robots.items()}
    network.run(30.0)
    took = delays(network, 15.0)
    assert np.quantile(took, 0.5) <= 0.5
    assert np.quantile(took, 0.99) <= 2.0
    for name, robot in network.robots.items():
        assert len(robot.gossip.live(network.now)) == 4
        assert (robot.air.traffic.sent_bytes - before[name].sent_bytes) / 30.0 <= 50_000
        assert (robot.air.traffic.sent_messages - before[name].sent_messages) / 30.0 <= 36
        assert "too fast" not in robot.gossip.rejected
    assert network.until_equal(30.0) < 10.0


def test_nine_of_ten_lost_from_robot_to_robot() -> None:
    reaches = topology("line", [f"r{k + 1}" for k in range(4)])
    network = started(4, Faults(loss=0.9, reaches=reaches), seed=1)
    network.run(60.0)
    assert np.quantile(delays(network, 30.0), 0.9) <= 4.0


def sent_per_second(network: Network, seconds: float) -> float:
    """What a robot sends on average [bytes/s]."""
    before = sum(robot.air.traffic.sent_bytes for robot in network.robots.values())
    network.run(seconds)
    after = sum(robot.air.traffic.sent_bytes for robot in network.robots.values())
    return (after - before) / seconds / len(network.robots)


def test_nine_of_ten_lost_to_one_robot_alone() -> None:
    dice = Random(1)

    def reaches(sender: str, receiver: str, now: float) -> bool:
        return "r5" not in (sender, receiver) or dice.random() < 0.1

    network = started(5, Faults(reaches=reaches))
    network.run(60.0)
    assert np.quantile(delays(network, 15.0), 0.95) <= 3.0
    assert sent_per_second(network, 10.0) <= 25_000.0
    network.change(Faults())
    network.run(20.0)
    assert sent_per_second(network, 10.0) <= 2000.0


def test_bad_links_beside_good_ones_do_not_matter() -> None:
    """Robots in a line hear the next but one now and then: what they miss of it comes through the next."""
    dice, names = Random(1), [f"r{k + 1}" for k in range(5)]

    def reaches(sender: str, receiver: str, now: float) -> bool:
        apart = abs(names.index(sender) - names.index(receiver))
        return apart == 1 or (apart == 2 and dice.random() < 0.1)

    network = started(5, Faults(reaches=reaches))
    network.run(30.0)
    assert sent_per_second(network, 30.0) <= 4000.0
    assert np.quantile(delays(network, 10.0), 0.9) <= 1.0


def test_a_latecomer_gets_the_history_where_nine_of_ten_are_lost() -> None:
    network = Network(5, Faults(loss=0.9), seed=3)
    network.start("r1", "r2", "r3", "r4")
    network.run(60.0)
    network.start("r5")
    network.run(45.0)
    late = network.robots["r5"]
    told = [name for name in late.known if name.robot == "r1" and late.journal[name].bundle.cut <= 60.0]
    assert len(told) == 120


def test_bundles_are_pushed_only_where_most_messages_get_lost() -> None:
    network = started(5, Faults(loss=0.4))
    for _ in range(60):
        network.run(0.5)
        assert not any(robot.gossip._pushes.on for robot in network.robots.values())
    network.change(Faults(loss=0.9))
    network.run(20.0)
    assert all(robot.gossip._pushes.on for robot in network.robots.values())
    network.change(Faults())
    network.run(10.0)
    assert not any(robot.gossip._pushes.on for robot in network.robots.values())
    network.run(10.0)
    before = network.robots["r1"].air.traffic.sent_bytes
    network.run(10.0)
    assert (network.robots["r1"].air.traffic.sent_bytes - before) / 10.0 <= 2000.0


def test_who_has_not_met_all_speaks_up_for_a_moment() -> None:
    network = Network(5)
    network.start("r1", "r2")
    network.run(10.0)
    before = network.robots["r1"].air.traffic.sent_messages
    network.run(20.0)
    assert network.robots["r1"].air.traffic.sent_messages - before <= 20 * 3, "the other three may be away for good"


@pytest.mark.parametrize(("name", "count"), [("line", 6), ("ring", 7)])
def test_relays(name: str, count: int) -> None:
    robots = [f"r{k + 1}" for k in range(count)]
    network = started(count, Faults(reaches=topology(name, robots), delay=(0.01, 0.03)))  # type: ignore[arg-type]
    network.run(20.0)
    first, last = network.robots["r1"], network.robots[robots[-1]]
    assert first.gossip.live(network.now) == ({"r2"} if name == "line" else {"r2", robots[-1]})
    assert any(sealed.bundle.robot == robots[-1] for sealed in first.journal.values())
    assert any(sealed.bundle.robot == "r1" for sealed in last.journal.values())
    assert network.until_equal(5.0) < 2.5
    assert delays(network, 10.0).max() < 2.0
    asked = sum(robot.gossip.counts["requests sent"] for robot in network.robots.values())
    assert asked <= 2 * count, "relays come unasked"


def test_a_lossy_line() -> None:
    reaches = topology("line", [f"r{k + 1}" for k in range(5)])
    network = started(5, lossy(seed=1, reaches=reaches), seed=1)
    network.run(30.0)
    network.quiet = True
    network.run(15.0)
    assert network.equal()
    assert len(network.robots["r5"].journal) == everything(network, 30.0)


@pytest.mark.parametrize(("count", "loss", "within"), [(5, 0.0, 3.0), (5, 0.3, 8.0), (8, 0.0, 3.0), (10, 0.0, 5.0)])
def test_a_partition_heals(count: int, loss: float, within: float) -> None:
    names = [f"r{k + 1}" for k in range(count)]
    parts = (frozenset(names[:2]), frozenset(names[2:]))
    network = started(count, Faults(loss=loss, delay=(0.0, 0.05), partitions=(Partition(parts, 10.0, 40.0),)))
    network.run(40.0)
    assert max(network.missing().values()) >= 30 / 0.5
    network.run(within)
    healed = {n for robot in network.robots.values() for n in robot.known if robot.journal[n].bundle.cut <= 40.0}
    assert all(healed <= robot.known for robot in network.robots.values())
    assert len(healed) == count * 80
    assert network.until_equal(10.0) < (2.0 if loss == 0.0 else 6.0)


def test_a_killed_robot_goes_on_with_its_journal() -> None:
    network = started(4, lossy(seed=2))
    network.run(15.0)
    disk = network.stop("r2")
    network.run(5.0)
    network.start("r2", journal=disk)
    network.run(10.0)
    assert network.until_equal(10.0) < 10.0
    r1, r2 = network.robots["r1"], network.robots["r2"]
    assert r2.epoch == disk.epoch
    assert disk.known <= r2.known
    assert disk.known <= r1.known, "what was committed before is lost nowhere"
    own = sorted(name.sequence for name in r1.known if name.robot == "r2")
    assert own == list(range(own[-1] + 1)), "no number twice, none left out"
    assert len(r1.gossip._library.admission.epochs["r2"]) == 1
    assert r2.made == own[-1] + 1
    assert not r2.endings


def test_a_robot_without_its_journal_is_picked_up_in_a_new_epoch() -> None:
    network = started(4, lossy(seed=3))
    network.run(15.0)
    old = network.stop("r2")
    network.run(5.0)
    network.start("r2")
    network.run(15.0)
    assert network.until_equal(10.0) < 10.0
    new = network.robots["r2"].epoch
    assert new != old.epoch
    for robot in network.robots.values():
        assert robot.gossip._library.admission.current("r2") == new
        assert {name.epoch for name in robot.known if name.robot == "r2"} == {old.epoch, new}


def test_late_join_leave_and_return() -> None:
    network = Network(5)
    network.start("r1", "r2", "r3", "r4")
    network.run(20.0)
    network.start("r5")
    network.run(5.0)
    late = network.robots["r5"]
    assert min(late.journal[name].bundle.cut for name in late.known) < 5.0, "it catches up on the history"
    assert network.until_equal(5.0) < 3.0
    network.stop("r1")
    network.run(10.0)
    assert network.until_equal(5.0) < 3.0
    network.start("r1")
    network.run(10.0)
    assert network.until_equal(5.0) < 3.0
    assert network.robots["r1"].known == network.robots["r5"].known


def test_only_the_history_is_kept_and_told() -> None:
    network = started(3, history=20.0)
    network.run(60.0)
    for robot in network.robots.values():
        assert max(kept.count() for kept in robot.gossip.holds().values()) <= 2 * (20 + 10) + 1
    network.stop("r3")
    network.run(40.0)
    assert all(key[0] != "r3" for key in network.robots["r1"].gossip.holds())
    digests = network.robots["r1"].air.traffic.sent_bytes
    network.run(10.0)
    assert network.robots["r1"].air.traffic.sent_bytes - digests < 20_000, "nobody misses what is too old"


def test_own_bundles_that_others_hold_come_back() -> None:
    """A journal that lost its end, and whose mark tells so: the robot gets back what it made, and goes on after it."""
    network = started(3)
    network.run(10.0)
    disk = network.stop("r1")
    for name in sorted(n for n in disk.known if n.robot == "r1")[-3:]:
        del disk.journal[name]
    network.quiet = True
    network.start("r1", journal=disk)
    network.run(5.0)
    assert network.equal()
    r1 = network.robots["r1"]
    assert (r1.epoch, r1.made, r1.endings) == (disk.epoch, 20, [])


def test_clocks_that_differ_do_not_matter() -> None:
    network = Network(3)
    for k, name in enumerate(network.names):
        network.start(name, clock=lambda now, k=k: 1.7e9 * k + now * (1 + 1e-4 * k))
    network.run(20.0)
    assert network.until_equal(5.0) < 1.0
    readings = [r for s in network.robots["r1"].journal.values() for r in s.bundle.clocks if s.bundle.robot == "r2"]
    assert {r.peer for r in readings} == {"r1", "r3"}
    assert all(r.received - r.sent == pytest.approx(1.7e9 + 2e-3, abs=0.01) for r in readings if r.peer == "r1")


def test_the_same_seed_gives_the_same_bytes() -> None:
    def fingerprint() -> tuple[bytes, dict[str, int]]:
        network, digest = started(4, lossy(seed=5), seed=5), blake2b()
        network.taps.append(lambda robot, out: digest.update(f"{robot}{out.channel}".encode() + out.payload))
        network.run(10.0)
        return digest.digest(), network.missing()

    assert fingerprint() == fingerprint()


def test_twenty_robots() -> None:
    network = started(20, Faults(loss=0.1, delay=(0.0, 0.05)))
    network.run(5.0)
    assert network.until_equal(10.0) < 6.0


events = st.lists(
    st.tuples(st.sampled_from(["kill", "forget", "part", "heal", "wait"]), st.integers(0, 4), st.integers(1, 6)),
    max_size=8,
)


@settings(max_examples=6, deadline=None)
@example([("forget", 0, 1), ("forget", 1, 1)], 0, 0.0, "line")
@example([("forget", 0, 1), ("forget", 1, 1)], 0, 0.0, "ring")
@given(
    events, st.integers(0, 10**6), st.sampled_from([0.0, 0.3, 0.5, 0.7]), st.sampled_from(["full", "line", "ring"])
)  # fmt: skip
def test_whatever_happens_all_are_equal_in_the_end(
    events: list[tuple[str, int, int]], seed: int, loss: float, shape: str
) -> None:
    names = [f"r{k + 1}" for k in range(5)]
    faults = lossy(seed=seed, loss=loss, reaches=topology(shape, names))  # type: ignore[arg-type]
    network = started(5, faults, seed=seed)
    network.run(4.0)
    disks: dict[str, Robot | None] = {}
    for what, which, seconds in events:
        name = names[which]
        if what in ("kill", "forget") and name in network.robots:
            disk = network.stop(name)
            disks[name] = disk if what == "kill" else None
        elif what == "part":
            groups = (frozenset(names[: which + 1]), frozenset(names[which + 1 :]))
            network.change(replace(network.faults, partitions=(Partition(groups, 0.0, 1e9),)))
        elif what == "heal":
            network.change(replace(network.faults, partitions=()))
        network.run(float(seconds))
        if what == "wait":
            for gone, disk in disks.items():
                network.start(gone, journal=disk)
            disks.clear()
    for gone, disk in disks.items():
        network.start(gone, journal=disk)
    network.change(replace(network.faults, partitions=()))
    network.run(5.0)
    assert network.until_equal(60.0) < 60.0
