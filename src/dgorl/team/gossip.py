"""Gossip: how bundles reach all robots. Digests say what a robot holds, others ask for what they lack. METHOD §6.

A pure state machine: no sockets, threads, clock or files; ``now`` is the robot's local clock [s], which never runs
backwards within an epoch. Everything is broadcast to those who hear, and may get lost, late, twice, reordered.

- A robot's own bundles go out at once, again where neighbours' messages get lost.
- A neighbour's are relayed if another neighbour does not hear that one; of those who could, one does, in turn.
- What a digest or a gap in the numbers shows to be missing is asked for, of one holder, then of others.
- Digests come every 2 s, every 0.5 s while something is missing anywhere or somebody is new.
- Where most messages get lost, if only to one neighbour, what it lacks is sent again and again instead, see ``push``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import inf, log
from random import Random
from typing import NamedTuple

from dgorl.measurements import ClockReading
from dgorl.team.bundles import Name, Sealed
from dgorl.team.circle import Circle
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.gate import Gate
from dgorl.team.keys import Roster, Signer
from dgorl.team.library import Library
from dgorl.team.messages import Bundles, Digest, Key, Message, Requests, flat, packed, unflat
from dgorl.team.outbox import Outbox
from dgorl.team.push import AT_ONCE as PUSHED_AT_ONCE
from dgorl.team.push import Pushes
from dgorl.team.ranges import Ranges
from dgorl.team.rejections import Rejections
from dgorl.team.voice import Outgoing, Voice
from dgorl.team.wants import AT_ONCE, Wants
from dgorl.team.wire import LIMITS, Limits
from dgorl.team.witness import Witness

CHUNK = 12_000
"""Bundles go together in messages of about this size [bytes]."""

GATHER = 0.1
"""Relays and answers wait this long [s] for others to go with."""

JUST_SENT = 0.25
"""A request for what was sent this long ago [s] crossed it."""

OFTEN, SELDOM = 0.5, 2.0
"""Shortest and longest time between digests [s]."""

ASK_EVERY, TIDY_EVERY = 0.25, 5.0
"""Times between looks at what is missing, and at what is too old [s]."""

CANDIDATE_BUNDLES = 32
"""Of an epoch that is not admitted yet, only the newest are asked for."""

DIGEST_INTERVALS = 16
"""A digest tells of so many intervals of an epoch, the newest."""

ARRIVE = 0.8
"""A bundle is repeated so often that it arrives with this probability ..."""

MOST_COPIES = 16
"""... but no more often than this."""

MEETING, UNMET_EVERY, UNMET_COPIES = 5.0, 0.25, 4
"""So long [s] after the start a robot that has not heard all others yet sends digests so often [s] and its bundles so
many times: how much gets lost shows in what is heard."""

PUSHED_DIGESTS = 0.15
"""Time between digests while bundles are pushed [s]."""


class Reaction(NamedTuple):
    """What came of a message: bundles not known before, answers, clock readings, epochs admitted by it."""

    new: tuple[Sealed, ...] = ()
    send: tuple[Outgoing, ...] = ()
    clocks: tuple[ClockReading, ...] = ()
    admitted: tuple[Key, ...] = ()


class Gossip:
    """One robot's part. ``rejected`` counts by reason what came in and was not taken, ``counts`` what it did."""

    def __init__(
        self,
        robot: str,
        epoch: int,
        roster: Roster,
        signer: Signer,
        configuration: bytes,
        *,
        history: float = 180.0,
        limits: Limits = LIMITS,
        born: float = inf,
        made: int = 0,
        began: float = -inf,
        before: Gossip | None = None,
    ) -> None:
        """configuration: 8 bytes, hash of what all must have in common. history: how far back peers catch up [s].

        born, made, began: of its epoch, see Witness. before: the robot's part in the epoch before, in the same program.
        """
        self.robot, self.epoch = robot, epoch
        self.rejected: Rejections = Rejections() if before is None else before.rejected
        self.counts: Counter[str] = Counter() if before is None else before.counts
        self._roster = roster
        self._voice = Voice((robot, epoch), roster, signer, configuration)
        self._gate: Gate = Gate(robot, roster, configuration, limits) if before is None else before._gate
        self.witness: Witness = Witness() if before is None else before.witness
        """what the robot's own signature proves of its epoch"""
        self.witness.begin(born, made, began)
        self._library = Library((robot, epoch), roster, history, limits, self.witness)
        self._circle, self._outbox, self._wants, self._pushes = Circle(), Outbox(), Wants(), Pushes()
        self._neighbours = self._circle.neighbours
        self._began = inf
        self._random = Random(f"{robot}:{epoch}")
        self._digest_after, self._next_digest = OFTEN, -inf
        self._next_ask, self._next_tidy = -inf, -inf

    # What comes in

    def receive(self, channel: str, sender: str, payload: bytes, now: float) -> Reaction:
        """Take a message; ``sender`` is who the network says it is, ``now`` when it came [s]. Never raises."""
        if channel == "estimate":
            return Reaction()
        try:
            message = self._gate.open(channel, sender, payload, now)
        except Rejected as rejected:
            self.rejected.take(sender, rejected)
            return Reaction()
        try:
            self._library.admission.check(message.key)
        except Rejected as rejected:
            return self._refuse(message, rejected, now)
        reading = ClockReading(self.robot, self.epoch, sender, message.epoch, message.stamp, now)
        if not self._library.admission.admitted(message.key):
            return self._from_candidate(message, now)._replace(clocks=(reading,))
        if self._circle.hear(message, now):
            self._hasten(now)
        try:
            reaction = self._take(message, now)
        except Rejected as rejected:
            self.rejected.take(sender, rejected)
            reaction = Reaction()
        return reaction._replace(send=(*reaction.send, *self._due(now)), clocks=(reading,))

    def _refuse(self, message: Message, rejected: Rejected, now: float) -> Reaction:
        """A robot whose epoch does not count is shown why, unless that was an error."""
        self.rejected.take(message.robot, rejected)
        try:
            if rejected.reason is Reason.EPOCH and (sealed := self._sealed(message)):
                self._library.returned(sealed[0], message.key, now)
        except Rejected as wrong:
            self.rejected.take(message.robot, wrong)
        return Reaction(send=self._voice.prove(message.robot, self._library.proof(message.robot), now))

    def _from_candidate(self, message: Message, now: float) -> Reaction:
        """A message of an epoch that is not admitted: only its own bundles are looked at."""
        self._library.admission.heard(message.key, now)
        self._library.admission.candidate(message.key)
        self._circle.call(message, now)
        for data in self._sealed(message):
            self._open(data, message, now)
        return self._admit(now)

    def _sealed(self, message: Message) -> list[bytes]:
        """The sealed bundles in a message."""
        try:
            return message.bundles() if isinstance(message, Bundles) else []
        except Rejected as rejected:
            self.rejected.take(message.robot, rejected)
            return []

    def _take(self, message: Message, now: float) -> Reaction:
        """A message of a neighbour."""
        neighbour = self._neighbours[message.robot]
        match message:
            case Digest():
                neighbour.digest(message)
                if self._library.beyond(neighbour.holds, now, settled=True):
                    neighbour.lags(now)
                    if not self._pushes.on:
                        self._hasten(now)
            case Requests():
                self._answer(message, now)
            case Bundles():
                new = [sealed for data in self._sealed(message) if (sealed := self._open(data, message, now))]
                for sealed in new:
                    self._relay(sealed, message.robot, now)
                reaction = self._admit(now)
                return reaction._replace(new=(*new, *reaction.new))
        return Reaction()

    def _open(self, data: bytes, message: Message, now: float) -> Sealed | None:
        """One bundle of a message, if it is new and of an admitted epoch; others wait, or are counted."""
        try:
            name, sealed = self._library.open(data, message.key, now)
        except Rejected as rejected:
            self.rejected.take(message.robot, rejected)
            return None
        if message.robot in self._neighbours:
            self._neighbours[message.robot].showed(name)
        return sealed

    def _admit(self, now: float) -> Reaction:
        """Let in the epochs that are proved to live."""
        new, admitted = self._library.admit(now)
        for sealed in new:
            self._relay(sealed, sealed.bundle.robot, now)
        if admitted:
            self._hasten(now)
        return Reaction(tuple(new), admitted=tuple(admitted))

    # What goes out

    def publish(self, sealed: Sealed, now: float) -> tuple[Outgoing, ...]:
        """Send a bundle of one's own, which the journal holds already."""
        self._library.keep(sealed, now)
        name = sealed.bundle.name
        if self._pushes.on:
            return self._push(now, name)
        self._outbox.add(name, now, UNMET_COPIES if self._unmet(now) else self._copies(now))
        return self._bundles(self._outbox.due(now + GATHER), now, at_once=name)

    def hold(self, sealed: Sealed, now: float) -> None:
        """A bundle of one's own that was held up: it is sent when its turn comes."""
        self._library.keep(sealed, now)
        if not self._pushes.on:
            self._outbox.add(sealed.bundle.name, now, 1)

    def tick(self, now: float) -> tuple[Outgoing, ...]:
        """What is due; call it ten times a second or more often."""
        out: list[Outgoing] = []
        self._began = min(self._began, now)
        if self._pushes.begin(self._circle.loss_to_bear(now)):
            self._outbox.clear()
            self._hasten(now)
        if now >= self._next_tidy:
            self._next_tidy = now + TIDY_EVERY
            self._library.tidy(now)
            self._pushes.tidy(now)
        if now >= self._next_ask:
            self._next_ask = now + ASK_EVERY
            out.extend(self._ask(now))
        if now >= self._next_digest:
            out.append(self._digest(now))
        if self._pushes.due(now):
            out.extend(self._push(now))
        return (*out, *self._due(now))

    def restore(self, bundles: Sequence[Sealed], admitted: Iterable[Key], now: float) -> None:
        """Go on after a restart with what the journal holds: own and received bundles in the order they came.

        Their epochs were admitted when they came; ``admitted`` names others that were.
        """
        self._library.restore(bundles, admitted, now)
        self._gate.restore(bundles)

    # What others may ask

    def live(self, now: float) -> frozenset[str]:
        """The robots heard lately, by ourselves."""
        return frozenset(self._circle.live(now))

    def loss(self, now: float) -> float:
        """Which share of the neighbours' messages does not arrive, on average."""
        return self._circle.loss(now)

    def losses(self, now: float) -> dict[str, float]:
        """... of each neighbour's."""
        return self._circle.losses(now)

    def holds(self) -> dict[Key, Ranges]:
        """The bundles kept, by robot and epoch."""
        return self._library.holds()

    # How

    def _outgoing(self, message: Message) -> Outgoing:
        said = self._voice.say(message)
        self.counts[f"{said.channel} sent"] += 1
        if self._pushes.on:
            self._outbox.charge(len(said.payload), message.stamp)
        return said

    def _copies(self, now: float) -> int:
        """How often a bundle is sent for a good chance to arrive."""
        loss = self.loss(now)
        return min(MOST_COPIES, max(1, round(log(1.0 - ARRIVE) / log(loss)))) if loss > 0.0 else 1

    def _hasten(self, now: float) -> None:
        """Send a digest soon, and the next ones often."""
        self._digest_after = OFTEN
        self._next_digest = min(self._next_digest, now + OFTEN * self._random.random())

    def _digest(self, now: float) -> Outgoing:
        if self._wants.pressing(now):
            self._digest_after = OFTEN
        after = PUSHED_DIGESTS if self._pushes.on else UNMET_EVERY if self._unmet(now) else self._digest_after
        self._next_digest = now + after * (0.75 + 0.5 * self._random.random())
        self._digest_after = min(SELDOM, 2 * self._digest_after)
        holds = [(*key, flat(kept, DIGEST_INTERVALS)) for key, kept in sorted(self.holds().items())]
        return self._outgoing(Digest(*self._voice.head(now), holds, self._circle.heard_well(now)))

    def _ask(self, now: float) -> Iterable[Outgoing]:
        live = self._circle.live(now).values()
        missing = [self._library.missing(neighbour.holds, CANDIDATE_BUNDLES) for neighbour in live]
        self._wants.refresh(missing, now)
        if self._pushes.on:
            requests = self._wants.standing(lambda name: self._circle.holders(name, now), now)
        else:
            requests = self._wants.requests(lambda name: self._circle.holders(name, now), self._copies(now), now)
        if requests:
            wants = [
                (robot, [(*key, flat(numbers, DIGEST_INTERVALS)) for key, numbers in wanted.items()])
                for robot, wanted in requests.items()
            ]
            yield self._outgoing(Requests(*self._voice.head(now), wants))

    def _answer(self, message: Requests, now: float) -> None:
        if self._pushes.on:
            self._pushes.asked(message, self._library, now)
            return
        for addressee, wanted in message.wants:
            if addressee == self.robot:
                self._send_all({(robot, epoch): unflat(numbers) for robot, epoch, numbers in wanted}, now)

    def _send_all(self, wanted: Mapping[Key, Ranges], now: float) -> None:
        """What of this is kept here goes out, unless it just did."""
        copies = self._copies(now)
        for key, ranges in wanted.items():
            shelf = self._library.shelves.get(key)
            if shelf is not None:
                for number in shelf.kept.both(ranges).newest(AT_ONCE):
                    if now - shelf.sent(number) >= JUST_SENT:
                        self._outbox.add(Name(*key, number), now + GATHER, copies)

    def _relay(self, sealed: Sealed, sender: str, now: float) -> None:
        """Pass a new bundle on if a neighbour lacks it that does not hear the sender, and it is our turn."""
        name = sealed.bundle.name
        if not self._pushes.on and self._circle.relays(name, sender, self.robot, now):
            self._outbox.add(name, now + GATHER, self._copies(now))

    def _unmet(self, now: float) -> bool:
        """Whether the robot has just begun and not heard all others yet."""
        return now - self._began < MEETING and self._circle.met() < len(self._roster.robots) - 1

    def _push(self, now: float, first: Name | None = None) -> tuple[Outgoing, ...]:
        """Messages of what neighbours may lack, as many as may be sent; ``first`` in any case."""
        out: list[Outgoing] = []
        lacking = self._pushes.lacking(self._library, self._circle, now)
        for _ in range(PUSHED_AT_ONCE):
            if first is None and not (self._outbox.allows(now) and self._pushes.allows(now)):
                break
            bundles = self._pushes.next(lacking, self._library, first, now)
            if not bundles:
                break
            sealed = packed(list(bundles.values()))
            out.append(self._outgoing(Bundles(*self._voice.head(now), sealed)))
            self._pushes.sent(bundles, len(out[-1].payload), now)
            first = None
        return tuple(out)

    def _due(self, now: float) -> tuple[Outgoing, ...]:
        """Bundles that are due; what nearly is goes with them."""
        if self._outbox.earliest() > now or not self._outbox.allows(now):
            return ()
        return self._bundles(self._outbox.due(now + GATHER), now)

    def _bundles(self, names: Sequence[Name], now: float, at_once: Name | None = None) -> tuple[Outgoing, ...]:
        """Messages of these bundles, as many as may be sent; ``at_once`` in any case."""
        out: list[Outgoing] = []
        chunk: list[bytes] = []
        for name in sorted(names, key=lambda name: name != at_once):
            shelf = self._library.shelves.get((name.robot, name.epoch))
            data = shelf.data(name.sequence) if shelf else None
            if shelf is None or data is None:
                self._outbox.drop(name)
                continue
            if name != at_once and not self._outbox.allows(now):
                break
            if chunk and sum(map(len, chunk)) + len(data) > CHUNK:
                out.append(self._outgoing(Bundles(*self._voice.head(now), chunk)))
                chunk = []
            chunk.append(data)
            shelf.mark_sent(name.sequence, now)
            self._outbox.sent(name, len(data), now)
        if chunk:
            out.append(self._outgoing(Bundles(*self._voice.head(now), chunk)))
        return tuple(out)
