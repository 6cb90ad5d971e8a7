"""Strangers, replays, floods and members gone mad: rejected and counted, without effect. Virtual time."""

from __future__ import annotations

import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from random import Random

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl.measurements import ClockReading, Odometry
from dgorl.team.admission import CANDIDATES, WAITING
from dgorl.team.bundles import Bundle, track_epoch
from dgorl.team.envelope import Reason
from dgorl.team.faults import Faults, Partition
from dgorl.team.gate import MESSAGES_PER_SECOND
from dgorl.team.gossip import Gossip, Reaction
from dgorl.team.keys import Key, Roster, generate
from dgorl.team.messages import Bundles, Digest, Requests, write
from dgorl.team.voice import Outgoing
from dgorl.team.wire import LIMITS, NUMBERS, seal

from ..fuzz.mutations import mutations, overheard, told
from ..team_network import CONFIGURATION, TEAM, Network, Robot

DAY = 86_400.0


@pytest.fixture
def network() -> Network:
    network = Network(3, signed=True)
    network.start(*network.names)
    network.run(6.0)
    return network


def state(robot: Robot) -> object:
    """All that could reach an estimate or another robot."""
    gossip = robot.gossip
    return (
        {key: list(kept) for key, kept in gossip.holds().items()},
        {name: list(epochs) for name, epochs in gossip._library.admission.epochs.items()},
        {name: (n.key, n.heard, n.hears, dict(n.holds)) for name, n in gossip._neighbours.items()},
        gossip._library.shelves[gossip._library.own].had.high,
        frozenset(robot.journal),
    )


def unchanged(robot: Robot, messages: Iterator[tuple[str, str, bytes]] | list, now: float) -> Counter[str]:
    """What was counted for messages that have no effect."""
    before, counted = state(robot), Counter(robot.gossip.rejected)
    for channel, sender, payload in messages:
        reaction = robot.gossip.receive(channel, sender, payload, now)
        assert reaction == Reaction()
    assert state(robot) == before
    return Counter(robot.gossip.rejected) - counted


def head(network: Network, name: str = "r2", **changes: object) -> tuple:
    robot = network.robots[name]
    values = {
        "team": TEAM, "robot": name, "epoch": robot.epoch, "stamp": network.now + 0.01, "number": 0,
        "configuration": CONFIGURATION,
    }  # fmt: skip
    return tuple((values | changes).values())


def a_bundle(network: Network, name: str = "r2", number: int = 10_000, **changes: object) -> Bundle:
    epoch = int(changes.pop("epoch", network.robots[name].epoch))  # type: ignore[call-overload]
    row = Odometry(name, network.now - 0.5, network.now, 9.0, 9.0, track_epoch(epoch, 0))
    return Bundle(TEAM, name, epoch, number, 0, network.now, (row,), **changes)  # type: ignore[arg-type]


def forged(network: Network, key: Key, **changes: object) -> list[tuple[str, str, bytes]]:
    """One of each kind as r2 might have sent it, signed by ``key``."""
    r2, first = network.robots["r2"], head(network, **changes)
    sender = str(changes.get("robot", "r2"))
    sealed = seal(a_bundle(network), key).data
    return [
        ("digest", sender, write(Digest(*first, [("r2", r2.epoch, [0, 10_000])], []), key)),
        ("requests", sender, write(Requests(*first, [("r1", [("r1", network.robots["r1"].epoch, [0, 5])])]), key)),
        ("bundles", sender, write(Bundles(*first, [sealed]), key)),
    ]


def test_a_stranger_injects_nothing(network: Network) -> None:
    r1, stranger = network.robots["r1"], generate()
    assert unchanged(r1, forged(network, stranger), network.now) == {Reason.SIGNATURE: 3}
    assert unchanged(r1, forged(network, stranger, robot="r9"), network.now) == {Reason.UNKNOWN: 3}
    assert unchanged(r1, forged(network, stranger, robot="r1"), network.now) == {Reason.OWN: 3}
    as_another = [(channel, "r3", payload) for channel, _, payload in forged(network, stranger)]
    assert unchanged(r1, as_another, network.now) == {Reason.SENDER: 3}
    assert unchanged(r1, forged(network, stranger, team="u"), network.now) == {Reason.TEAM: 3}
    assert unchanged(r1, forged(network, stranger, configuration=bytes(8)), network.now) == {Reason.CONFIGURATION: 3}


def test_a_member_cannot_speak_for_another(network: Network) -> None:
    r1, r3 = network.robots["r1"], network.keys["r3"]
    assert unchanged(r1, forged(network, r3), network.now) == {Reason.SIGNATURE: 3}
    of_r2 = seal(a_bundle(network), r3).data
    payload = write(Bundles(*head(network, "r3"), [of_r2]), r3)
    holds = r1.gossip.holds()
    assert r1.gossip.receive("bundles", "r3", payload, network.now).new == ()
    assert r1.gossip.rejected == {Reason.SIGNATURE: 4}
    assert r1.gossip.holds() == holds


def test_a_signature_serves_one_purpose(network: Network) -> None:
    """A signed digest is nothing on another channel, a sealed bundle no message."""
    r1, key = network.robots["r1"], network.keys["r2"]
    digest, requests, _ = forged(network, key)
    sealed = seal(a_bundle(network), key).data
    counted = unchanged(
        r1,
        [("requests", "r2", digest[2]), ("digest", "r2", requests[2]), ("bundles", "r2", sealed), ("x", "r2", sealed)],
        network.now,
    )
    assert sum(counted.values()) == 4
    assert set(counted) <= {Reason.MALFORMED, Reason.SIGNATURE}


def test_another_version_is_said_to_be_one(network: Network) -> None:
    later = [(c, s, b"\x94\x02" + p[2:] + b"\0") for c, s, p in forged(network, network.keys["r2"])]
    assert unchanged(network.robots["r1"], later, network.now) == {Reason.VERSION: 3}


def test_cut_off_too_long_and_garbage(network: Network) -> None:
    r1 = network.robots["r1"]
    good = forged(network, network.keys["r2"])
    long = [(c, s, p + bytes(LIMITS.message)) for c, s, p in good]
    assert unchanged(r1, long, network.now) == {Reason.TOO_LARGE: 3}
    cuts = [(c, s, p[:k]) for c, s, p in good for k in range(len(p))]
    for k, cut in enumerate(cuts):
        counted = unchanged(r1, [cut], network.now + 0.1 * k)
        assert counted in ({Reason.MALFORMED: 1}, {Reason.SIGNATURE: 1})
    nested = b"\x93\x01\xc4\x00\xc5\x70\x00" + b"\x91" * 0x7000
    assert unchanged(r1, [("digest", "r2", nested)], network.now + 1e4) == {Reason.MALFORMED: 1}


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=300), st.sampled_from(["digest", "requests", "bundles", "x", "estimate"]))
def test_any_bytes_are_rejected(payload: bytes, channel: str) -> None:
    fuzzed(_GOSSIP, channel, payload)


@settings(max_examples=50, deadline=None)
@given(st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.binary(max_size=9) | st.text("r12"),
    lambda inner: st.lists(inner, max_size=7), max_leaves=25,
), st.sampled_from(["digest", "requests", "bundles"]), st.booleans())  # fmt: skip
def test_any_signed_content_is_survived(content: object, channel: str, with_head: bool) -> None:
    """A member's own key signs what no program would write."""
    values = [TEAM, "r2", 2, 5.0, 0, CONFIGURATION, content] if with_head else content
    body = msgspec.msgpack.encode(values)
    signature = _KEYS["r2"].sign(b"dgorl/1/" + channel.encode() + b"\0" + body)
    _GOSSIP.receive(channel, "r2", msgspec.msgpack.encode([1, signature, body]), next(_TIMES))


_KEYS = {name: generate() for name in ("r1", "r2", "r3")}
_TIMES = iter(range(10**9))


def fresh() -> Gossip:
    return Gossip("r1", 1, Roster(TEAM, {n: k.public for n, k in _KEYS.items()}), _KEYS["r1"], CONFIGURATION)


_GOSSIP = fresh()


def fuzzed(gossip: Gossip, channel: str, payload: bytes) -> None:
    before = sum(gossip.rejected.values())
    assert gossip.receive(channel, "r2", payload, float(next(_TIMES))) == Reaction()
    assert sum(gossip.rejected.values()) == before + (channel != "estimate")
    assert gossip.holds() == {}


@pytest.mark.slow
def test_mutations_of_real_messages_change_nothing(network: Network) -> None:
    """A hundred thousand messages with bytes flipped, cut out, doubled or moved between them."""
    messages, r1 = overheard(network, "r1"), network.robots["r1"]
    before = state(r1)
    counted = told(r1, mutations(messages, 100_000, seed=1), network.now)
    assert counted.total() > 90_000
    assert state(r1) == before


# Replays


def test_what_is_replayed_is_rejected(network: Network) -> None:
    sent: list[tuple[str, Outgoing]] = []
    network.taps.append(lambda robot, out: sent.append((robot, out)))
    network.run(4.0)
    r1 = network.robots["r1"]
    replayed = [(out.channel, robot, out.payload) for robot, out in sent if robot != "r1"]
    network.run(1.0)
    counted = unchanged(r1, replayed, network.now)
    assert counted == {Reason.REPLAYED: len(replayed)}
    network.run(30.0)
    counted = unchanged(r1, replayed, network.now)
    assert counted == {Reason.REPLAYED: len(replayed)}


def day(names: tuple[str, ...], keys: dict[str, Key], disks: dict[str, Robot], at: float) -> tuple[Network, list]:
    """A day of a team from ``at`` [s] on its clocks, and all that was sent."""
    network = Network(4, signed=True, seed=int(at))
    network.keys = keys
    network.roster = Roster(TEAM, {name: key.public for name, key in keys.items()})
    for name in names:
        network.start(name, journal=disks.get(name), clock=lambda now: at + now)
    sent: list[tuple[str, Outgoing]] = []
    network.taps.append(lambda robot, out: sent.append((robot, out)))
    network.run(10.0)
    return network, sent


def test_a_recorded_day_is_rejected_later() -> None:
    """Valid signatures, old epochs: nobody's new journal, and no robot that kept its own, takes them for live."""
    keys = {f"r{k}": generate() for k in range(1, 5)}
    names = tuple(keys)
    first, recorded = day(names, keys, {}, at=0.0)
    old = {name: robot.epoch for name, robot in first.robots.items()}
    assert len(first.robots["r1"].gossip.live(first.now)) == 3
    for kept in ((), ("r1",)):
        # r4 stays at home: what was recorded of it is new to some, and its epoch knows that of r1.
        disks = {name: first.robots[name] for name in kept}
        for name in kept:
            disks[name].journal = {n: s for n, s in disks[name].journal.items() if n.robot == "r1"}
            disks[name].admitted = []
        second, _ = day(("r1", "r2", "r3"), keys, disks, at=DAY)
        believed = {name: set(robot.known) for name, robot in second.robots.items()}
        for robot in second.robots.values():
            for k, (sender, out) in enumerate(recorded):
                if sender != robot.name:
                    reaction = robot.gossip.receive(out.channel, sender, out.payload, DAY + second.now + 0.1 * k)
                    assert not reaction.new
                    assert not reaction.admitted
                    robot.bundler.heard(reaction.clocks)
        # Readings of the recording spread in the bundles of the living; still nobody is taken in by them.
        second.run(5.0)
        for name, robot in second.robots.items():
            new = robot.known - believed[name]
            assert new
            assert not any(n.epoch == old[n.robot] for n in new if n.robot not in kept)
            assert robot.gossip._library.admission.current("r4") is None
            assert robot.gossip.live(DAY + second.now) == set(second.robots) - {name}


def test_an_epoch_must_hear_the_living_and_be_heard(network: Network) -> None:
    """One-way proof is not enough, nor one from an epoch of which nothing is known."""
    network.stop("r3")
    r1, key, epoch = network.robots["r1"], network.keys["r3"], 77
    gossip, now = r1.gossip, network.now

    def say(*clocks: ClockReading) -> Reaction:
        say.number += 1  # type: ignore[attr-defined]
        stamp = now + 0.01 * say.number  # type: ignore[attr-defined]
        bundle = Bundle(TEAM, "r3", epoch, say.number, 0, stamp, clocks=clocks)  # type: ignore[attr-defined]
        first = (TEAM, "r3", epoch, stamp, 0, CONFIGURATION)
        return gossip.receive("bundles", "r3", write(Bundles(*first, [seal(bundle, key).data]), key), now)

    say.number = 0  # type: ignore[attr-defined]
    for clock in (
        ClockReading("r3", epoch, "r1", r1.epoch ^ 1, now, now),
        ClockReading("r3", epoch, "r2", 5, now, now),
        ClockReading("r3", epoch, "r1", r1.epoch, now - 181.0, now),
    ):
        assert not say(clock).admitted
    assert say(ClockReading("r3", epoch, "r1", r1.epoch, now - 1.0, now)).admitted == (("r3", epoch),)
    assert gossip._library.admission.current("r3") == epoch
    back = write(Digest(TEAM, "r3", 3, now + 1.0, 0, CONFIGURATION, [], []), key)
    assert not gossip.receive("digest", "r3", back, now).admitted


# Floods


def kinds(network: Network, random: Random) -> Callable[[], tuple[str, str, bytes]]:
    stranger = generate()
    valid = forged(network, stranger)
    names = ["r2", "r3", "r9", "r1", *(f"x{k}" for k in range(100))]

    def one() -> tuple[str, str, bytes]:
        channel, _, payload = random.choice(valid)
        payload = payload if random.random() < 0.7 else random.randbytes(random.choice([0, 10, 1000, 40_000]))
        return channel, random.choice(names[:2]) if random.random() < 0.8 else random.choice(names), payload

    return one


def test_a_flood_costs_little_and_changes_nothing(network: Network) -> None:
    """10 000 messages a second for ten seconds, most under the names of members."""
    r1, random = network.robots["r1"], Random(2)
    one, checks = kinds(network, random), Counter[str]()
    messages = [one() for _ in range(100_000)]
    verify = r1.gossip._gate._roster.verify
    r1.gossip._gate._roster.verify = lambda robot, *rest: checks.update([robot]) or verify(robot, *rest)  # type: ignore
    tracemalloc.start()
    before, started = state(r1), time.process_time()
    for k, (channel, sender, payload) in enumerate(messages):
        assert r1.gossip.receive(channel, sender, payload, network.now + 1e-4 * k) == Reaction()
    spent, (_, peak) = time.process_time() - started, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert state(r1) == before
    assert sum(r1.gossip.rejected.values()) == len(messages)
    assert spent < 5.0, "half of one core, traced"
    assert peak < 1e6
    assert max(checks.values()) <= 12 * MESSAGES_PER_SECOND, "the rate limit comes before signatures"


def test_whom_a_flood_drowns_is_heard_through_others(network: Network) -> None:
    r1, random = network.robots["r1"], Random(3)
    flood = [payload for _, _, payload in forged(network, generate())]
    for _ in range(200):
        network.run(0.05)
        for k in range(500):
            r1.gossip.receive("bundles", "r2", random.choice(flood), network.now + 1e-4 * k)
    assert r1.gossip.live(network.now) == {"r3"}
    network.quiet = True
    network.run(2.0)
    assert network.missing()["r1"] == 0


# Members gone mad: their keys are good


def test_two_bundles_of_one_name(network: Network) -> None:
    r1, key = network.robots["r1"], network.keys["r2"]
    for number, cut in enumerate((network.now, network.now + 1.0)):
        bundle = Bundle(TEAM, "r2", network.robots["r2"].epoch, 500, 0, cut)
        payload = write(Bundles(*head(network, stamp=cut), [seal(bundle, key).data]), key)
        assert len(r1.gossip.receive("bundles", "r2", payload, cut).new) == 1 - number
    assert r1.gossip.rejected == {f"{Reason.CONFLICT}: r2": 1}


@pytest.mark.parametrize("number", [NUMBERS, 2**62, 2**63, 2**64 - 1])
def test_numbers_too_large_for_journal_and_digest(network: Network, number: int) -> None:
    key = network.keys["r2"]
    payload = write(Bundles(*head(network), [seal(a_bundle(network, number=number), key).data]), key)
    assert network.robots["r1"].gossip.receive("bundles", "r2", payload, network.now).new == ()
    assert network.robots["r1"].gossip.rejected == {Reason.MALFORMED: 1}


def test_lies_of_what_one_holds_hide_nothing_and_use_up_no_numbers(network: Network) -> None:
    key, r3 = network.keys["r2"], network.robots["r3"]
    groups = frozenset({"r1"}), frozenset({"r2", "r3"})
    network.change(Faults(partitions=(Partition(groups, 0.0, 1e9),)))
    network.run(12.0)
    network.change(Faults())
    for lies in range(1, 41):
        network.run(0.5)
        stamp = network.now + 0.01
        claims = [("r3", r3.epoch, [0, 10**6 * lies, 2**51, 2**52])]
        lie = write(Digest(*head(network, stamp=stamp), claims, ["r1", "r3"]), key)
        for name in ("r1", "r3"):
            network.robots[name].gossip.receive("digest", "r2", lie, stamp)
    assert not r3.endings, "a claim is no proof"
    assert r3.made < 1000
    lacking = r3.known - network.robots["r1"].known
    assert all(name.sequence >= r3.made - 4 for name in lacking), "the newest may be on their way"


def test_nonsense_of_a_member_is_bounded(network: Network) -> None:
    """Endless numbers, bundles it has not, epochs without end."""
    r1, key, random = network.robots["r1"], network.keys["r2"], Random(4)
    for k in range(2000):
        stamp = network.now + 0.05 * k
        epoch = network.robots["r2"].epoch if k % 2 else random.getrandbits(64)
        first = head(network, epoch=epoch, stamp=stamp)
        claims = [("r3", random.getrandbits(64), [0, 2**52]) for _ in range(3)] + [("r7", 1, [0, 5])]
        r1.gossip.receive("digest", "r2", write(Digest(*first, claims, ["r1", "r99"]), key), stamp)
        bundle = Bundle(TEAM, "r2", epoch, random.getrandbits(53), 0, stamp)
        r1.gossip.receive("bundles", "r2", write(Bundles(*first, [seal(bundle, key).data]), key), stamp)
        for out in r1.gossip.tick(stamp):
            assert len(out.payload) <= LIMITS.message
    waiting = r1.gossip._library.admission.candidates["r2"]
    assert len(waiting) <= CANDIDATES
    assert all(len(candidate.bundles) <= WAITING for candidate in waiting.values())
    assert len(r1.gossip._library.admission.epochs["r2"]) == 1
    assert len(r1.gossip._wants._wants) <= 10_000
    network.stop("r2")
    network.air.now += 100.0
    network._steps = round(network.air.now / 0.05)
    network.run(10.0)
    assert network.until_equal(10.0) < 10.0, "the others go on"


def test_a_robot_of_another_configuration_is_counted(network: Network) -> None:
    r1, r2 = network.robots["r1"], network.robots["r2"]
    r2.gossip._gate._configuration = r2.gossip._voice._configuration = b"another."
    network.run(3.0)
    assert r1.gossip.rejected[Reason.CONFIGURATION] >= 6
    assert r2.gossip.rejected[Reason.CONFIGURATION] >= 12
