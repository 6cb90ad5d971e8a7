"""The gossip state machine step by step: what it sends, whom it asks, whom it admits."""

from __future__ import annotations

import zlib

import msgspec
import pytest

from dgorl.measurements import ClockReading
from dgorl.team.admission import Admission
from dgorl.team.bundles import Bundle, Name, Sealed
from dgorl.team.circle import Circle
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.gate import UNTOLD
from dgorl.team.gossip import CHUNK, Gossip, Reaction
from dgorl.team.keys import UNSIGNED, Roster
from dgorl.team.library import Library
from dgorl.team.messages import CHANNEL, MOST_INFLATED, Bundles, Digest, Message, Requests, packed, read, write
from dgorl.team.outbox import BYTES_PER_SECOND
from dgorl.team.push import NOBODY, Lackers, Pushes
from dgorl.team.voice import Outgoing
from dgorl.team.wire import LIMITS, open_sealed, seal

CONFIGURATION = b"12345678"
NAMES = tuple(f"r{k}" for k in range(1, 7))
ROSTER = Roster("t", dict.fromkeys(NAMES), insecure=True)
EPOCH = {name: 100 + k for k, name in enumerate(NAMES, start=1)}


class Team:
    """Gossip machines by name; ``hears``: who hears whom. Messages pass at once, tick by tick."""

    def __init__(self, *names: str, hears: dict[str, str] | None = None) -> None:
        self.now = 0.0
        self.machines = {name: Gossip(name, EPOCH[name], ROSTER, UNSIGNED, CONFIGURATION) for name in names}
        self.hears = {name: set((hears or {}).get(name, " ".join(names)).split()) - {name} for name in names}
        self.sent: list[tuple[str, Message]] = []
        self.clocks: dict[str, dict[str, ClockReading]] = {name: {} for name in names}
        self.numbers = dict.fromkeys(names, 0)

    def carry(self, sender: str, messages: tuple[Outgoing, ...]) -> None:
        for channel, payload in messages:
            self.sent.append((sender, read(channel, payload, sender, ROSTER, CONFIGURATION, LIMITS.message).message))
            for name, machine in self.machines.items():
                if sender in self.hears[name]:
                    reaction = machine.receive(channel, sender, payload, self.now)
                    self.clocks[name] |= {reading.peer: reading for reading in reaction.clocks}
                    self.carry(name, reaction.send)

    def publish(self, name: str) -> Sealed:
        clocks = tuple(self.clocks[name].values())
        bundle = Bundle("t", name, EPOCH[name], self.numbers[name], 0, self.now, clocks=clocks)
        self.numbers[name] += 1
        sealed = seal(bundle, UNSIGNED)
        self.carry(name, self.machines[name].publish(sealed, self.now))
        return sealed

    def run(self, seconds: float, publish: bool = False) -> None:
        for _ in range(round(seconds / 0.1)):
            self.now = round(self.now + 0.1, 3)
            for name in self.machines:
                if publish and round(self.now * 10) % 5 == 0:
                    self.publish(name)
                self.carry(name, self.machines[name].tick(self.now))

    def of(self, kind: type, sender: str | None = None) -> list:
        return [message for who, message in self.sent if isinstance(message, kind) and sender in (None, who)]


def met(*names: str, **options: dict[str, str]) -> Team:
    """A team that has admitted one another."""
    team = Team(*names, **options)
    team.run(5.0, publish=True)
    team.run(1.0)
    for machine in team.machines.values():
        assert all(machine._library.admission.current(name) == EPOCH[name] for name in names)
        assert not machine.rejected
    team.sent.clear()
    return team


def bundles_in(messages: list[Bundles]) -> list[tuple[str, int]]:
    opened = [open_sealed(data, ROSTER).bundle for message in messages for data in message.sealed]
    return [(bundle.robot, bundle.sequence) for bundle in opened]


def test_a_bundle_is_new_once_and_not_relayed_where_all_hear() -> None:
    team = met("r1", "r2", "r3")
    sealed = team.publish("r1")
    assert bundles_in(team.of(Bundles)) == [("r1", sealed.bundle.sequence)]
    team.run(3.0)
    assert bundles_in(team.of(Bundles)) == [("r1", sealed.bundle.sequence)]
    assert not team.of(Requests)


def test_one_of_several_relays_in_turn() -> None:
    """r1 and r4 do not hear one another; r2 and r3 hear both."""
    team = met("r1", "r2", "r3", "r4", hears={"r1": "r2 r3", "r4": "r2 r3"})
    for _ in range(8):
        team.publish("r1")
        team.run(0.5)
    relayed = bundles_in(team.of(Bundles, "r2")), bundles_in(team.of(Bundles, "r3"))
    assert not set(relayed[0]) & set(relayed[1])
    assert [len(r) for r in relayed] == [4, 4]
    assert not team.of(Bundles, "r4")
    assert not team.of(Requests)


def test_digests_back_off_and_come_back() -> None:
    team = met("r1", "r2")
    team.run(20.0)
    team.sent.clear()
    team.run(20.0)
    assert 8 <= len(team.of(Digest, "r1")) <= 14
    team.hears["r2"].discard("r1")
    team.publish("r1")
    team.run(2.0)
    team.hears["r2"].add("r1")
    team.sent.clear()
    team.run(3.0)
    assert bundles_in(team.of(Bundles, "r1")) == [("r1", 10)]
    for name in ("r1", "r2"):
        team.hears[name].clear()
    team.run(10.0)
    team.sent.clear()
    team.hears |= {"r1": {"r2"}, "r2": {"r1"}}
    team.run(3.0)
    assert len(team.of(Digest, "r1")) >= 3, "somebody is back"


def test_one_holder_is_asked_and_alone_answers() -> None:
    team = met("r1", "r2", "r3", "r4")
    team.hears["r4"].discard("r1")
    sealed = team.publish("r1")
    team.run(0.2)
    team.hears["r4"].add("r1")
    team.sent.clear()
    team.run(4.0)
    requests = team.of(Requests, "r4")
    assert len(requests) == 1
    assert len(requests[0].wants) == 1
    assert bundles_in(team.of(Bundles)) == [("r1", sealed.bundle.sequence)], "one answer"
    assert team.of(Bundles, requests[0].wants[0][0])
    assert sealed.bundle.sequence in team.machines["r4"].holds()["r1", EPOCH["r1"]]


def test_another_holder_is_asked_when_one_is_silent() -> None:
    team = met("r1", "r2", "r3", "r4")
    team.hears["r4"].discard("r1")
    team.publish("r1")
    team.run(0.2)
    team.hears["r4"].add("r1")
    for name in ("r1", "r2", "r3"):
        team.hears[name].discard("r4")
    team.run(4.0)
    asked = {robot for request in team.of(Requests, "r4") for robot, _ in request.wants}
    assert asked == {"r1", "r2", "r3"}


def test_a_joiner_gets_the_history_within_its_rate() -> None:
    team = met("r1", "r2")
    team.machines["r3"] = Gossip("r3", EPOCH["r3"], ROSTER, UNSIGNED, CONFIGURATION)
    team.hears |= {"r1": {"r2", "r3"}, "r2": {"r1", "r3"}, "r3": set()}
    team.clocks["r3"], team.numbers["r3"] = {}, 0
    for _ in range(170):
        team.run(0.5, publish=True)
    team.hears["r3"] = {"r1", "r2"}
    team.sent.clear()
    team.run(10.0, publish=True)
    held = team.machines["r3"].holds()
    for robot in ("r1", "r2"):
        assert list(held[robot, EPOCH[robot]]) == list(team.machines[robot].holds()[robot, EPOCH[robot]])
    sent = sum(len(data) for message in team.of(Bundles, "r1") for data in message.sealed)
    assert sent < 11 * BYTES_PER_SECOND
    assert all(sum(map(len, message.sealed)) <= CHUNK + LIMITS.bundle for message in team.of(Bundles))


def test_answers_are_bounded_in_rate() -> None:
    """A request for everything, again and again."""
    team = met("r1", "r2")
    machine = team.machines["r1"]
    for number in range(10, 400):
        clocks = tuple(ClockReading("r1", EPOCH["r1"], "r2", k, 0.1, 0.2) for k in range(40))
        bundle = Bundle("t", "r1", EPOCH["r1"], number, 0, 5.0 + number / 10, clocks=clocks)
        machine.publish(seal(bundle, UNSIGNED), 5.0)
    total = 0
    for k in range(100):
        now = 6.0 + 0.1 * k
        wants = [("r1", [("r1", EPOCH["r1"], [0, 1000])])]
        request = Requests("t", "r2", EPOCH["r2"], now, k, CONFIGURATION, wants)
        for _, payload in (*_receive(machine, request, now).send, *machine.tick(now)):
            total += len(payload)
    assert BYTES_PER_SECOND < total < 12 * BYTES_PER_SECOND + 3 * CHUNK


def test_deflated_bundles_are_the_same_and_bounded() -> None:
    sealed = [seal(Bundle("t", "r1", EPOCH["r1"], k, 0, float(k)), UNSIGNED).data for k in range(20)]
    head = ("t", "r1", EPOCH["r1"], 1.0, 0, CONFIGURATION)
    deflated = packed(sealed)
    assert isinstance(deflated, bytes)
    assert len(deflated) < sum(map(len, sealed)) / 2
    assert Bundles(*head, deflated).bundles() == sealed
    assert packed([b"short"]) == [b"short"], "nothing to win"
    encode = msgspec.msgpack.encode
    for bad in (
        b"",
        b"no deflate",
        deflated[:-1],
        deflated + b"more",
        zlib.compress(encode([bytes(MOST_INFLATED)])),
        zlib.compress(encode(["text"])),
    ):
        with pytest.raises(Rejected, match="malformed"):
            Bundles(*head, bad).bundles()
    machine = Gossip("r2", EPOCH["r2"], ROSTER, UNSIGNED, CONFIGURATION)
    assert _receive(machine, Bundles(*head, b"no deflate"), 0.0).new == ()
    assert machine.rejected == {Reason.MALFORMED: 1}


def test_what_is_new_and_lacking_is_pushed_first() -> None:
    library = Library(("r1", EPOCH["r1"]), ROSTER, 180.0, LIMITS)
    for number in range(40):
        library.keep(seal(Bundle("t", "r1", EPOCH["r1"], number, 0, number / 2), UNSIGNED), number / 2)
    names = [Name("r1", EPOCH["r1"], number) for number in range(40)]
    pushes, now = Pushes(), 20.0
    one, two, four = (Lackers(robots, 0.9) for robots in (1, 2, 4))
    first = list(pushes.next(dict.fromkeys(names, two), library, None, now))
    assert first[:3] == names[:-4:-1]
    assert list(pushes.next({names[0]: four, names[-1]: two}, library, names[5], now)) == [
        names[5],
        names[-1],
        names[0],
    ]
    for _ in range(30):
        pushes.sent({names[-1]: b"data"}, 4, now)
    assert not pushes.next({names[-1]: two}, library, None, now), "sent often enough for now"
    assert list(pushes.next({names[-1]: two}, library, None, now + 3.0)) == [names[-1]]
    assert list(pushes.next({names[-1]: two}, library, names[-1], now)) == [names[-1]], "a fresh one in any case"
    for _ in range(3):
        pushes.sent({names[20]: b"data"}, 4, now)
    assert list(pushes.next({names[20]: one}, library, None, now)) == [names[20]], "more often where most get lost"
    assert not pushes.next({names[20]: NOBODY.and_one(0.9).and_one(0.1)}, library, None, now)


def test_what_was_asked_for_has_its_turn_among_what_is_pushed() -> None:
    key = "r1", EPOCH["r1"]
    library = Library(key, ROSTER, 180.0, LIMITS)
    for number in range(400):
        library.keep(seal(Bundle("t", *key, number, 0, number / 2), UNSIGNED), number / 2)
    lacking = {Name(*key, number): Lackers(9, 0.9) for number in range(380, 400)}
    old = {Name(*key, number): Lackers(1, 0.9, asked=True) for number in (50, 51, 300)}
    pushes, first = Pushes(), []
    for k in range(8):
        chosen = pushes.next(lacking | old, library, None, 200.0 + k)
        first.append(next(iter(chosen)).sequence)
        pushes.sent(dict.fromkeys(chosen, b"data"), 400, 200.0 + k)
    assert sum(number < 380 for number in first) == 2, "one in four"
    assert first[0] == 50, "the oldest"


def test_who_asked_for_an_epoch_that_is_forgotten_gets_nothing_of_it() -> None:
    library, pushes, circle, key = Library(("r1", EPOCH["r1"]), ROSTER, 180.0, LIMITS), Pushes(), Circle(), ("r2", 7)
    library._let_in(key)
    library.keep(seal(Bundle("t", *key, 0, 0, 1.0), UNSIGNED), 1.0)
    request = Requests("t", "r3", EPOCH["r3"], 1.0, 0, CONFIGURATION, [("r1", [(*key, [0, 0])])])
    circle.hear(request, 1.0)
    pushes.asked(request, library, 1.0)
    assert set(pushes.lacking(library, circle, 1.0)) == {Name(*key, 0)}
    for epoch in range(100, 100 + Admission.KEPT):
        library._let_in(("r2", epoch))
    assert pushes.lacking(library, circle, 1.0) == {}


def _receive(machine: Gossip, message: Message, now: float) -> Reaction:
    return machine.receive(CHANNEL[type(message)], message.robot, write(message, UNSIGNED), now)


def test_estimates_are_not_gossips_matter() -> None:
    machine = Gossip("r1", 1, ROSTER, UNSIGNED, CONFIGURATION)
    assert machine.receive("estimate", "r2", b"anything", 0.0) == Reaction()
    assert not machine.rejected


def test_an_earlier_epoch_counts_no_more() -> None:
    team = met("r1", "r2")
    machine, later = team.machines["r1"], 999
    back = ClockReading("r2", later, "r1", EPOCH["r1"], team.now, team.now)
    sealed = seal(Bundle("t", "r2", later, 0, 0, team.now, clocks=(back,)), UNSIGNED)
    message = Bundles("t", "r2", later, team.now, 0, CONFIGURATION, [sealed.data])
    reaction = _receive(machine, message, team.now)
    assert reaction.admitted == (("r2", later),)
    assert reaction.new == (sealed,)
    old = Digest("t", "r2", EPOCH["r2"], team.now + 1, 0, CONFIGURATION, [], [])
    (shown,) = _receive(machine, old, team.now).send
    told = read("bundles", shown.payload, "r1", ROSTER, CONFIGURATION, LIMITS.message).message
    assert told.bundles() == [sealed.data], "it is shown what it signed since"
    assert machine.rejected == {Reason.EPOCH: 1}


def test_a_restored_machine_goes_on() -> None:
    team = met("r1", "r2", "r3")
    order = [
        open_sealed(shelf.data(number) or b"", ROSTER)
        for key, shelf in team.machines["r1"]._library.shelves.items()
        for low, high in shelf.kept
        for number in range(low, high + 1)
    ]
    again = Gossip("r1", EPOCH["r1"], ROSTER, UNSIGNED, CONFIGURATION)
    again.restore(order, [], team.now)
    assert again.holds() == team.machines["r1"].holds()
    team.machines["r1"] = again
    team.now += UNTOLD
    team.sent.clear()
    team.run(3.0, publish=True)
    assert not team.of(Requests)
    assert not again.rejected
    assert again.live(team.now) == {"r2", "r3"}


# Admission


@pytest.mark.parametrize(
    ("heard", "tells", "told", "admitted"),
    [
        (True, 90.0, None, True),
        (False, 90.0, None, False),
        (True, None, None, False),
        (True, -90.0, None, False),
        (False, None, 95.0, False),
        (False, "r2", 95.0, True),
        (False, "r2", None, False),
        (False, "r2", -95.0, False),
        (False, "r9", 95.0, False),
    ],
)
def test_admission_takes_readings_both_ways(
    heard: bool, tells: float | str | None, told: float | None, admitted: bool
) -> None:
    """At 100 s, with 180 s counted as lately: r3 tells of us or of r2 (r9 nobody admitted), and they tell of it."""
    admission = Admission(("r1", 1), fresh=180.0)
    admission.admit(("r2", 2))
    new = ("r3", 3)
    readings = {
        None: (),
        "r2": (ClockReading("r3", 3, "r2", 2, 90.0, 0.0),),
        "r9": (ClockReading("r3", 3, "r9", 9, 90.0, 0.0),),
    }.get(tells)  # type: ignore[arg-type]
    if readings is None:
        readings = (ClockReading("r3", 3, "r1", 1, float(tells), 0.0),)  # type: ignore[arg-type]
    admission.candidate(new).add(Sealed(b"", Bundle("t", "r3", 3, 0, 0, 5.0, clocks=readings)))
    if heard:
        admission.heard(new, 99.0)
    if told is not None:
        admission.learn(Bundle("t", "r2", 2, 0, 0, told, clocks=(ClockReading("r2", 2, "r3", 3, 5.0, told),)))
    newest = {("r1", 1): 100.0, ("r2", 2): 100.0}
    assert list(admission.ready(lambda key: newest.get(key))) == ([new] if admitted else [])


def test_own_earlier_epochs_do_not_become_the_current_one() -> None:
    admission = Admission(("r1", 1), fresh=180.0)
    for epoch in range(10, 10 + 2 * Admission.KEPT):
        admission.admit(("r1", epoch))
        admission.admit(("r2", epoch))
    assert admission.current("r1") == 1
    assert admission.current("r2") == 9 + 2 * Admission.KEPT
    assert len(admission.epochs["r1"]) == len(admission.epochs["r2"]) == Admission.KEPT


def test_an_epoch_that_becomes_known_late_does_not_become_the_current_one() -> None:
    """r2 lived epochs 20, 21, 22; r3 heard 20 and 22, and in an epoch before its own last 21."""
    admission = Admission(("r1", 1), fresh=180.0)
    for key in (("r3", 30), ("r3", 31), ("r2", 22), ("r2", 20), ("r2", 21)):
        told = {("r2", 22): [(31, 9.0)], ("r2", 20): [(30, 3.0), (31, 1.0)], ("r2", 21): [(31, 4.0)]}
        for listener, stamp in told.get(key, ()):
            reading = ClockReading("r3", listener, *key, 5.0, stamp)
            admission.learn(Bundle("t", "r3", listener, 0, 0, stamp, clocks=(reading,)))
        admission.admit(key)
    assert admission.epochs["r2"] == [20, 21, 22]


def test_what_waits_is_bounded() -> None:
    admission = Admission(("r1", 1), fresh=180.0)
    for epoch in range(100):
        for number in range(100):
            admission.candidate(("r2", epoch)).add(Sealed(b"", Bundle("t", "r2", epoch, number, 0, 0.0)))
    assert list(admission.candidates["r2"]) == [96, 97, 98, 99]
    assert list(admission.candidate(("r2", 99)).numbers) == [(36, 99)]
    for number in range(100, 200):
        admission.candidate(("r2", 99)).add(Sealed(bytes(8000), Bundle("t", "r2", 99, number, 0, 0.0)))
    assert list(admission.candidate(("r2", 99)).numbers) == [(188, 199)], "by bytes, too"
