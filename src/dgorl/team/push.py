"""Where most messages get lost, on all links or to a neighbour that is behind for it: what is lacked, again and again.

Where nine of ten messages are lost, a request and its answer both pass one time in a hundred, one of twenty copies
seven times in eight. So every robot repeats what it holds, its own and the others', as often as it may. What goes
first is what most neighbours lack, as far as is known, what is newest, and what was sent least often lately; and in
turn what was asked for, the oldest first.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import exp
from typing import NamedTuple

from dgorl.team.bundles import Name
from dgorl.team.circle import Circle
from dgorl.team.library import Library
from dgorl.team.messages import Requests
from dgorl.team.rates import Bucket

BEGIN, END = 0.7, 0.55
"""It begins where a larger share of the messages gets lost, and ends where a smaller one does."""

EVERY = 0.09
"""Time between looks at what to send [s]; at each no more than"""
AT_ONCE = 3
"""so many messages."""

MESSAGES_PER_SECOND = 24.0
"""With digests and requests it is less than receivers look at (:mod:`dgorl.team.gate`)."""

PAYLOAD = 2_400
"""Bundles go together in messages of about this size [bytes], deflated: what is lost at once is little."""

LEAST_RATIO = 0.25
"""Bundles count as no smaller than this when deflated: bounds a message."""

LOOKED_AT = 32
"""Of what a neighbour lacks of an epoch, the newest so many count."""

TOLD = 8
"""Who is not admitted yet is told the newest so many of the robot's own."""

ASKED, ASKED_AT_ONCE = 5.0, 128
"""A request stands for this long [s], whoever was asked, for the newest so many of an epoch."""

AGES = 6.0
"""The newest bundle of an epoch counts twice as much as the one this many before it."""

MEND = 4
"""Every so many messages one begins with what was asked for, the oldest first: else a gap would outlive the history."""

FADES = 2.0
"""A bundle sent this long [s] ago counts as sent 1/e times: by then a digest tells who lacks it still."""

REST = 0.3
"""A bundle rests when its last copies all got lost with less than this probability; others send theirs, too."""


class Lackers(NamedTuple):
    """How many robots lack a bundle; loss: which share of messages to them gets lost, on average; whether one asked."""

    robots: int
    loss: float
    asked: bool = False

    def and_one(self, loss: float, *, asked: bool = False) -> Lackers:
        """One more."""
        mean = (self.robots * self.loss + loss) / (self.robots + 1)
        return Lackers(self.robots + 1, mean, self.asked or asked)


NOBODY = Lackers(0, 0.0)


class Pushes:
    """Whether to push, what was pushed lately, and what is next."""

    def __init__(self) -> None:
        self.on = False
        self._sent: dict[Name, tuple[float, float]] = {}
        self._asked: dict[str, tuple[float, frozenset[Name]]] = {}
        self._messages_sent = 0
        self._messages = Bucket(MESSAGES_PER_SECOND, AT_ONCE)
        self._ratio = 1.0
        self._next = -float("inf")

    def begin(self, loss: float) -> bool:
        """Whether to begin, for a share of messages lost; ends it where fewer are."""
        before, self.on = self.on, loss > (END if self.on else BEGIN)
        return self.on and not before

    def due(self, now: float) -> bool:
        """Whether it is time for another look [s]; then it is not for a while."""
        if not self.on or now < self._next:
            return False
        self._next = now + EVERY
        return True

    def allows(self, now: float) -> bool:
        """Whether another message may be sent."""
        return self._messages.level(now) >= 1.0

    def asked(self, message: Requests, library: Library, now: float) -> None:
        """What a neighbour lacks, and is kept here. Raises Rejected."""
        wanted = frozenset(
            Name(*key, number)
            for key, ranges in message.wanted().items()
            if (shelf := library.shelves.get(key)) is not None
            for number in shelf.kept.both(ranges).newest(ASKED_AT_ONCE)
        )
        self._asked[message.robot] = now, wanted

    def lacking(self, library: Library, circle: Circle, now: float) -> dict[Name, Lackers]:
        """Who of those who hear may lack what is kept here."""
        lacking: dict[Name, Lackers] = {}
        for robot, neighbour in circle.live(now).items():
            at, asked = self._asked.get(robot, (now, frozenset[Name]()))
            lacks = {
                name: True
                for name in asked
                if now - at < ASKED and not neighbour.has(name) and (name.robot, name.epoch) in library.shelves
            }
            for key, missing in library.beyond(neighbour.holds, now).items():
                if key != neighbour.key:
                    for number in missing.newest(LOOKED_AT):
                        lacks.setdefault(Name(*key, number), False)
            for name, wanted in lacks.items():
                lacking[name] = lacking.get(name, NOBODY).and_one(neighbour.losses.share, asked=wanted)
        for caller in circle.calling(now):
            for number in library.shelves[library.own].kept.newest(TOLD):
                name = Name(*library.own, number)
                lacking[name] = lacking.get(name, NOBODY).and_one(caller.losses.share)
        return lacking

    def next(
        self, lacking: Mapping[Name, Lackers], library: Library, first: Name | None, now: float
    ) -> dict[Name, bytes]:
        """Bundles for one message, ``first`` the first."""
        mending = self._messages_sent % MEND == 0
        worth: list[tuple[bool, float, Name]] = []
        for name, lackers in lacking.items():
            lost = max(lackers.loss, END) ** self._lately(name, now)
            if lost >= REST and name != first:
                before = library.shelves[name.robot, name.epoch].kept.high - name.sequence
                urgent = mending and lackers.asked
                worth.append((not urgent, -before if urgent else -lackers.robots * lost * AGES / (AGES + before), name))
        chosen: dict[Name, bytes] = {}
        space = PAYLOAD / self._ratio
        for name in ([] if first is None else [first]) + [name for *_, name in sorted(worth)]:
            data = library.shelves[name.robot, name.epoch].data(name.sequence)
            if data is None:
                continue
            if chosen and len(data) > space:
                break
            space -= len(data)
            chosen[name] = data
        return chosen

    def sent(self, bundles: Mapping[Name, bytes], payload: int, now: float) -> None:
        """These went out, as a message of ``payload`` bytes."""
        self._messages.charge(1.0, now)
        self._messages_sent += 1
        ratio = payload / sum(map(len, bundles.values()))
        self._ratio = max(LEAST_RATIO, self._ratio + 0.2 * (ratio - self._ratio))
        for name in bundles:
            self._sent[name] = now, self._lately(name, now) + 1.0

    def tidy(self, now: float) -> None:
        """Forget what was sent or asked for long ago."""
        self._sent = {name: (at, times) for name, (at, times) in self._sent.items() if now - at < 5 * FADES}
        self._asked = {robot: (at, names) for robot, (at, names) in self._asked.items() if now - at < ASKED}

    def _lately(self, name: Name, now: float) -> float:
        """How often it was sent lately, the longer ago the less."""
        at, times = self._sent.get(name, (now, 0.0))
        return times * exp((at - now) / FADES)
