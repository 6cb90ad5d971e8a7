"""The bundles a robot knows: opened, checked, kept by epoch; those of epochs that are not admitted yet wait."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import inf

from dgorl.team.admission import Admission
from dgorl.team.bundles import Name, Sealed
from dgorl.team.envelope import Reason, Rejected, unwrap, verify
from dgorl.team.keys import Roster
from dgorl.team.messages import Key
from dgorl.team.ranges import Ranges
from dgorl.team.shelf import Shelf
from dgorl.team.wire import PURPOSE, Limits, content, open_sealed, peek
from dgorl.team.witness import Witness

SETTLING, SETTLED = 4, 2.0
"""The newest bundles of an epoch may be on their way still, for this long [s] after one came."""

SILENT = 10.0
"""Of an epoch that still is lived in something comes within this time [s]."""

RETAINED = 10.0
"""Bundles are kept this much longer [s] than the history."""


class Library:
    """Of one robot in one epoch, ``own``. ``duplicates`` counts what was here before; see Witness for ``witness``."""

    def __init__(
        self, own: Key, roster: Roster, history: float, limits: Limits, witness: Witness | None = None
    ) -> None:
        self.own, self.witness = own, witness or Witness()
        self.admission = Admission(own, history)
        self.shelves: dict[Key, Shelf] = {}
        self.duplicates = 0
        self._roster, self._limits = roster, limits
        self._retention = history + RETAINED
        self.shelves[own] = Shelf(self._retention)

    def open(self, data: bytes, sender: Key, now: float) -> tuple[Name, Sealed | None]:
        """A bundle that came from ``sender``: its name, and itself if it is new and of an admitted epoch.

        What is new of other epochs waits. Raises Rejected.
        """
        signature, text = unwrap(data, self._limits.bundle)
        body = peek(text, self._roster)
        key, name = (body.robot, body.epoch), Name(body.robot, body.epoch, body.sequence)
        told = key == sender or self.admission.admitted(sender)
        if not told and body.robot != self.own[0]:
            raise Rejected(Reason.EPOCH, "told by a robot whose own is not")
        shelf = self.shelves.get(key)
        known = self._data(name)
        second = shelf is not None and shelf.contradicted(name.sequence, body.cut)
        if known == data or (known is None and not second and shelf is not None and name.sequence in shelf.had):
            self.duplicates += 1
            return name, None
        if key in self.admission.distrusted:
            self.admission.check(key)
        verify(PURPOSE, body.robot, signature, text, self._roster)
        sealed = Sealed(data, content(body, self._roster))
        if body.robot == self.own[0]:
            self._look(sealed, known is not None or second, now)
            if not told:
                raise Rejected(Reason.EPOCH, "told by a robot whose own is not")
        other = known or (shelf.last if shelf is not None and second else None)
        if other is not None:
            self.admission.distrust(key, (other, data))
            self.admission.check(key)
        if shelf is None:
            self.admission.candidate(key).add(sealed)
            return name, None
        self.keep(sealed, now)
        return name, sealed

    def _look(self, sealed: Sealed, second: bool, now: float) -> None:
        """A bundle with the own signature that is not here; second: another is, in its place. Raises Rejected."""
        bundle = sealed.bundle
        if (bundle.robot, bundle.epoch) == self.own:
            if second or not self.witness.knows(bundle.sequence):
                self.witness.copied()
                raise Rejected(Reason.ENDED, f"{bundle.name} was not made here")
        elif self.witness.lived(bundle, now):
            raise Rejected(Reason.ENDED, f"{bundle.name} was made after this epoch began")

    def returned(self, data: bytes, key: Key, now: float) -> None:
        """An epoch that does not count does again if it answers us and the one that does is silent. Raises Rejected.

        data: the bundle that a message of it begins with; it has to tell of a message of ours, sent lately. Robots may
        be wrong about the order in which another lived; then its own signature cannot tell it to begin anew.
        """
        current = self.admission.current(key[0])
        shelf = None if current is None else self.shelves.get((key[0], current))
        if shelf is None or now - shelf.changed < SILENT or key not in self.shelves:
            return
        bundle = open_sealed(data, self._roster).bundle
        heard = max((told.sent for told in bundle.clocks if (told.peer, told.peer_epoch) == self.own), default=-inf)
        if (bundle.robot, bundle.epoch) == key and heard >= now - SILENT:
            self.admission.prefer(key)

    def proof(self, robot: str) -> list[bytes]:
        """What its own signature proves to a robot whose messages do not count: that its epoch has ended."""
        signed = [data for key, pair in self.admission.distrusted.items() if key[0] == robot for data in pair][-2:]
        current = self.admission.current(robot)
        shelf = None if current is None else self.shelves.get((robot, current))
        return signed if shelf is None or shelf.last is None else [*signed, shelf.last]

    def keep(self, sealed: Sealed, now: float) -> None:
        """Put a bundle of an admitted epoch on its shelf."""
        self.shelves[sealed.bundle.robot, sealed.bundle.epoch].add(sealed, now)
        self.admission.learn(sealed.bundle)

    def admit(self, now: float) -> tuple[list[Sealed], list[Key]]:
        """Let in the epochs that are proved to live, until no more are: their bundles so far, and which they are."""
        new: list[Sealed] = []
        admitted: list[Key] = []
        while key := next(self.admission.ready(lambda live: self._clock(live, now)), None):
            waiting = sorted(self.admission.candidate(key).bundles.items())
            self._let_in(key)
            admitted.append(key)
            for _, sealed in waiting:
                self.keep(sealed, now)
                new.append(sealed)
        return new, admitted

    def restore(self, bundles: Sequence[Sealed], admitted: Iterable[Key], now: float) -> None:
        """Bundles in the order they came; their epochs were admitted then. ``admitted`` names others that were."""
        last = {(sealed.bundle.robot, sealed.bundle.epoch): index for index, sealed in enumerate(bundles)}
        for key in sorted({*admitted, *last}, key=lambda key: (last.get(key, -1), key)):
            if not self.admission.admitted(key):
                self._let_in(key)
        for sealed in bundles:
            if (sealed.bundle.robot, sealed.bundle.epoch) in self.shelves:
                self.keep(sealed, now)
        self.admission.sort()

    def tidy(self, now: float) -> None:
        """Let go of epochs that ended longer ago than the history."""
        for shelf in self.shelves.values():
            if now - shelf.changed > self._retention:
                shelf.clear()

    def holds(self) -> dict[Key, Ranges]:
        """The bundles that can be passed on."""
        distrusted = self.admission.distrusted
        return {key: shelf.kept for key, shelf in self.shelves.items() if shelf.kept and key not in distrusted}

    def lacks(self, key: Key, held: Ranges, newest: int) -> Ranges:
        """What of ``held`` is not here; of an epoch that waits, of its ``newest`` alone."""
        shelf = self.shelves.get(key)
        if key in self.admission.distrusted:
            return Ranges()
        if shelf is not None:
            return held.minus(shelf.had)
        waiting = self.admission.waits(key)
        lacking = held.minus(waiting.numbers if waiting else Ranges())
        lacking.drop_below(held.high - newest + 1)
        return lacking

    def missing(self, held: Mapping[Key, Ranges], newest: int) -> dict[Key, Ranges]:
        """What another holds, of robots of the roster, and is not here."""
        return {key: self.lacks(key, numbers, newest) for key, numbers in held.items() if key[0] in self._roster}

    def beyond(self, held: Mapping[Key, Ranges], now: float, *, settled: bool = False) -> dict[Key, Ranges]:
        """What is kept here of the epochs robots live in and not by another, from the lowest it holds on.

        settled: but for the newest, which may be on their way.
        """
        beyond: dict[Key, Ranges] = {}
        for key, kept in self.holds().items():
            if self.admission.current(key[0]) != key[1]:
                continue
            shelf = self.shelves[key]
            of_key = held.get(key, Ranges())
            high = kept.high - (SETTLING if settled and now - shelf.changed < SETTLED else 0)
            missing = kept.minus(of_key).within(of_key.low, high)
            if missing:
                beyond[key] = missing
        return beyond

    def _data(self, name: Name) -> bytes | None:
        key = name.robot, name.epoch
        if key in self.shelves:
            return self.shelves[key].data(name.sequence)
        waiting = self.admission.waits(key)
        sealed = waiting.bundles.get(name.sequence) if waiting else None
        return sealed.data if sealed else None

    def _let_in(self, key: Key) -> None:
        forgotten = self.admission.admit(key)
        if forgotten is not None:
            self.shelves.pop((key[0], forgotten), None)
        self.shelves[key] = Shelf(self._retention)

    def _clock(self, key: Key, now: float) -> float | None:
        """The newest stamp known of a live epoch [s], on its clock."""
        if key == self.own:
            return now
        shelf = None if key in self.admission.distrusted else self.shelves.get(key)
        return shelf.newest if shelf and now - shelf.changed <= self._retention else None
