"""Transports in memory and faults round them: what is lost, late, twice, cut, by seed."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from dgorl.team.faults import Faults, Faulty, Partition, topology
from dgorl.team.memory import QUEUE, Air
from dgorl.team.transport import Traffic

COUNT = 4000


def heard(faults: Faults, count: int = COUNT, sender: str = "a", receiver: str = "b") -> list[tuple[int, float, float]]:
    """Messages 0, 1... sent every 10 ms: number, time of arrival [s], its stamp."""
    air = Air()
    a = air.transport(sender)
    b = Faulty(air.transport(receiver), receiver, faults, lambda: air.now)
    came = []
    for k in range(count + 200):
        air.now = 0.01 * k
        if k < count:
            a.send("bundles", k.to_bytes(4, "big"))
        came += [(int.from_bytes(m.payload, "big"), air.now, m.at) for m in b.poll()]
    return came


def test_without_faults_all_comes_in_order_at_once() -> None:
    assert heard(Faults()) == [(k, 0.01 * k, 0.01 * k) for k in range(COUNT)]


@pytest.mark.parametrize("loss", [0.1, 0.5, 0.9, 1.0])
def test_loss(loss: float) -> None:
    assert len(heard(Faults(loss=loss))) / COUNT == pytest.approx(1 - loss, abs=0.03)


def test_delay_is_within_its_bounds_and_told() -> None:
    came = heard(Faults(delay=(0.1, 0.5)))
    late = [at - 0.01 * number for number, _, at in came]
    assert len(came) == COUNT
    assert min(late) >= 0.1
    assert max(late) <= 0.5
    assert sum(late) / COUNT == pytest.approx(0.3, abs=0.01)
    assert all(0.0 <= now - at < 0.011 for _, now, at in came), "the stamp is that of the arrival"


def test_duplicates_and_reordering() -> None:
    twice = Counter(number for number, *_ in heard(Faults(duplicate=0.1)))
    assert sum(count == 2 for count in twice.values()) / COUNT == pytest.approx(0.1, abs=0.02)
    numbers = [number for number, *_ in heard(Faults(reorder=0.1))]
    assert sorted(numbers) == list(range(COUNT))
    overtaken = sum(a > b for a, b in pairwise(numbers))
    assert 0.05 < overtaken / COUNT < 0.2


def test_the_seed_decides_and_links_differ() -> None:
    faults = Faults(seed=3, loss=0.5, delay=(0.0, 0.5), duplicate=0.1, reorder=0.1)
    assert heard(faults) == heard(faults)
    assert heard(faults) != heard(Faults(seed=4, loss=0.5, delay=(0.0, 0.5), duplicate=0.1, reorder=0.1))
    assert [n for n, *_ in heard(faults)] != [n for n, *_ in heard(faults, sender="c")]


def test_a_partition_parts_while_it_lasts() -> None:
    faults = Faults(partitions=(Partition((frozenset("a"), frozenset("b")), 5.0, 10.0),))
    numbers = [number for number, *_ in heard(faults)]
    assert numbers == [k for k in range(COUNT) if not 5.0 <= 0.01 * k < 10.0]
    together = Faults(partitions=(Partition((frozenset("ab"), frozenset("c")), 5.0, 10.0),))
    assert len(heard(together)) == COUNT
    alone = Faults(partitions=(Partition((frozenset("a"),), 5.0, 10.0),))
    assert len(heard(alone)) == COUNT - 500, "who is in no group hears nobody"


@pytest.mark.parametrize(("name", "links"), [("full", 20), ("line", 8), ("ring", 10)])
def test_topologies(name: str, links: int) -> None:
    robots = [f"r{k}" for k in range(5)]
    reaches = topology(name, robots)  # type: ignore[arg-type]
    pairs = [(a, b) for a in robots for b in robots if a != b and reaches(a, b, 0.0)]
    assert len(pairs) == links
    assert all((b, a) in pairs for a, b in pairs)


def test_presence_and_traffic() -> None:
    air = Air()
    faults = Faults(reaches=topology("line", ["a", "b", "c"]))
    ends = {name: Faulty(air.transport(name), name, faults, lambda: air.now) for name in "abc"}
    assert ends["a"].present() == {"b"}
    assert ends["b"].present() == {"a", "c"}
    ends["a"].send("digest", b"12345")
    assert [m.sender for m in ends["b"].poll()] == ["a"]
    assert ends["c"].poll() == []
    assert ends["c"].cut == 1
    assert ends["a"].traffic == Traffic(sent_messages=1, sent_bytes=5)
    assert ends["b"].traffic == Traffic(received_messages=1, received_bytes=5)
    ends["b"].close()
    assert ends["a"].present() == frozenset()
    ends["b"].send("digest", b"x")
    assert ends["b"].traffic.dropped == 1


def test_clocks_and_bounded_queues() -> None:
    air = Air(now=10.0)
    a, b = air.transport("a"), air.transport("b", lambda now: now + 100.0)
    a.send("digest", b"x")
    assert b.poll()[0].at == 110.0
    for _ in range(QUEUE + 5):
        a.send("digest", b"x")
    assert b.traffic.dropped == 5
    assert len(b.poll()) == QUEUE
