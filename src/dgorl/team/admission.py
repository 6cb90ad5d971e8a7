"""Which epochs of the team's robots are live, so that nothing recorded earlier counts again. METHOD §6.

A new epoch is admitted when its own bundles tell of a message of a live epoch, sent lately on that epoch's clock, and
that one tells of a message of the new epoch: two-way clock readings. A recording cannot know of an epoch that began
after it (64 random bits), nor of a stamp that was later. Live is the own epoch, and those admitted that reported within
the history: also one that ended since, so that those who died together are let in one by another.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator

from dgorl.team.bundles import Bundle, Sealed
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.messages import Key
from dgorl.team.ranges import Ranges

CANDIDATES = 4
"""So many epochs of a robot wait for admission at once."""

WAITING, WAITING_BYTES = 64, 100_000
"""So many bundles of a waiting epoch are kept, and so many bytes of them: opened, they take 25 times as much."""

HEARINGS = 256
"""So many waiting epochs a live one may tell of."""


class Candidate:
    """A waiting epoch: its newest bundles, and of whom they tell."""

    def __init__(self) -> None:
        self.bundles: dict[int, Sealed] = {}
        self._bytes = 0
        self.tells: dict[Key, float] = {}
        """live epoch → latest send stamp it was heard with [s], that epoch's clock"""

    def add(self, sealed: Sealed) -> None:
        """Keep a bundle, the oldest makes way."""
        if sealed.bundle.sequence in self.bundles:
            return
        self.bundles[sealed.bundle.sequence] = sealed
        for reading in sealed.bundle.clocks:
            live = reading.peer, reading.peer_epoch
            self.tells[live] = max(reading.sent, self.tells.get(live, reading.sent))
        self._bytes += len(sealed.data)
        while len(self.bundles) > WAITING or self._bytes > WAITING_BYTES:
            self._bytes -= len(self.bundles.pop(min(self.bundles)).data)
        while len(self.tells) > HEARINGS:
            del self.tells[next(iter(self.tells))]

    @property
    def numbers(self) -> Ranges:
        """Sequence numbers that are here."""
        return Ranges((number, number) for number in self.bundles)


class Admission:
    """Admitted epochs by robot, in the order the robot lived them, and those that wait.

    fresh: a message counts as sent lately up to this much [s] before the newest known of its sender.
    """

    KEPT = 8
    """So many epochs of a robot are remembered."""

    def __init__(self, own: Key, fresh: float) -> None:
        self.own = own
        self.epochs: dict[str, list[int]] = {own[0]: [own[1]]}
        self.candidates: dict[str, OrderedDict[int, Candidate]] = {}
        self.distrusted: OrderedDict[Key, tuple[bytes, bytes]] = OrderedDict()
        """epochs whose robot signed two contents where one can be: the two"""
        self._fresh = fresh
        self._told: dict[Key, OrderedDict[Key, float]] = {}

    def current(self, robot: str) -> int | None:
        """The epoch the robot lives in."""
        epochs = self.epochs.get(robot)
        return epochs[-1] if epochs else None

    def admitted(self, key: Key) -> bool:
        """Whether bundles of this epoch count."""
        return key[1] in self.epochs.get(key[0], ())

    def check(self, key: Key) -> None:
        """Whether what is signed by an epoch counts, or may once it is admitted. Raises Rejected."""
        if key in self.distrusted:
            raise Rejected(Reason.CONFLICT, f"{key[0]} signed two contents under one name in this epoch", key[0])
        if self.admitted(key) and self.current(key[0]) != key[1]:
            raise Rejected(Reason.EPOCH, "an earlier one")

    def distrust(self, key: Key, signed: tuple[bytes, bytes]) -> None:
        """Nothing of this epoch counts from now on: its robot signed both of these."""
        self.distrusted.setdefault(key, signed)
        self.candidates.get(key[0], OrderedDict[int, Candidate]()).pop(key[1], None)
        of_robot = [other for other in self.distrusted if other[0] == key[0]]
        if len(of_robot) > CANDIDATES:
            del self.distrusted[of_robot[0]]

    def admit(self, key: Key) -> int | None:
        """Let an epoch in; the robot's epoch that is forgotten for it, if any."""
        epochs = self.epochs.setdefault(key[0], [])
        self.candidates.get(key[0], OrderedDict[int, Candidate]()).pop(key[1], None)
        forgotten = epochs.pop(0) if len(epochs) == self.KEPT else None
        if forgotten is not None:
            self._told.pop((key[0], forgotten), None)
        self._insert(key, epochs)
        return forgotten

    def prefer(self, key: Key) -> None:
        """The robot lives in this admitted epoch, whatever was thought."""
        epochs = self.epochs[key[0]]
        epochs.remove(key[1])
        epochs.append(key[1])

    def candidate(self, key: Key) -> Candidate:
        """The waiting epoch; the one not heard of for longest makes way for a new one."""
        waiting = self.candidates.setdefault(key[0], OrderedDict())
        candidate = waiting.setdefault(key[1], Candidate())
        waiting.move_to_end(key[1])
        if len(waiting) > CANDIDATES:
            waiting.popitem(last=False)
        return candidate

    def waits(self, key: Key) -> Candidate | None:
        """The waiting epoch, if it is known."""
        return self.candidates.get(key[0], OrderedDict[int, Candidate]()).get(key[1])

    def heard(self, key: Key, now: float) -> None:
        """A message of an epoch that waits was heard here, at ``now`` [s]."""
        self._hearing(self.own, key, now)

    def learn(self, bundle: Bundle) -> None:
        """A bundle of an admitted epoch tells whom its robot hears."""
        for reading in bundle.clocks:
            self._hearing((bundle.robot, bundle.epoch), (reading.peer, reading.peer_epoch), bundle.cut)

    def sort(self) -> None:
        """Put epochs that were admitted before their bundles were known in their order."""
        for robot, epochs in self.epochs.items():
            as_admitted = epochs.copy()
            epochs.clear()
            for epoch in as_admitted:
                self._insert((robot, epoch), epochs)

    def ready(self, clock: Callable[[Key], float | None]) -> Iterator[Key]:
        """Waiting epochs that can be admitted.

        clock: the newest stamp known [s] of a live epoch, on its own clock; None of one that does not live.
        """
        for robot, waiting in self.candidates.items():
            for epoch, candidate in waiting.items():
                if any(self._two_way((robot, epoch), live, sent, clock) for live, sent in candidate.tells.items()):
                    yield robot, epoch

    def _two_way(self, key: Key, live: Key, sent: float, clock: Callable[[Key], float | None]) -> bool:
        told = self._told.get(live, OrderedDict[Key, float]()).get(key)
        newest = clock(live)
        return told is not None and newest is not None and min(told, sent) >= newest - self._fresh

    def _insert(self, key: Key, epochs: list[int]) -> None:
        """Bundles of an epoch may come after those of the epochs that followed it."""
        if key == self.own:
            place = len(epochs)
        else:
            later = (k for k, epoch in enumerate(epochs) if self._followed(key, (key[0], epoch)))
            place = next(later, len(epochs))
        epochs.insert(place, key[1])

    def _followed(self, key: Key, other: Key) -> bool:
        """Whether somebody heard ``other`` of the same robot later than ``key``."""
        if other == self.own:
            return True
        last = ((self._last(robot, key), self._last(robot, other)) for robot in self.epochs)
        return any(one is not None and two is not None and one < two for one, two in last)

    def _last(self, robot: str, key: Key) -> tuple[int, float] | None:
        """When a robot heard an epoch last: in which of its own epochs, at which stamp [s]."""
        for order, epoch in reversed(list(enumerate(self.epochs[robot]))):
            stamp = self._told.get((robot, epoch), OrderedDict[Key, float]()).get(key)
            if stamp is not None:
                return order, stamp
        return None

    def _hearing(self, live: Key, key: Key, stamp: float) -> None:
        told = self._told.setdefault(live, OrderedDict())
        told[key] = max(stamp, told.get(key, stamp))
        told.move_to_end(key)
        if len(told) > HEARINGS:
            told.popitem(last=False)
