"""Bundles to be sent: relayed, asked for, or repeated where much gets lost. Bounded in rate."""

from __future__ import annotations

from dataclasses import dataclass

from dgorl.team.bundles import Name
from dgorl.team.rates import Bucket

BYTES_PER_SECOND = 48_000
"""Beside its own fresh bundles a robot sends at most this much, on average over a second."""

REPEAT = 0.25
"""Copies of a bundle follow one another after this time [s]."""

WAITING = 8192
"""So many bundles wait at most."""


@dataclass(slots=True)
class _Entry:
    due: float
    copies: int


class Outbox:
    """What is to be sent when, and how often."""

    def __init__(self) -> None:
        self._entries: dict[Name, _Entry] = {}
        self._bucket = Bucket(BYTES_PER_SECOND, BYTES_PER_SECOND)

    def add(self, name: Name, due: float, copies: int) -> None:
        """Send a bundle from ``due`` [s] on, ``copies`` times."""
        entry = self._entries.get(name)
        if entry is not None:
            entry.due, entry.copies = min(entry.due, due), max(entry.copies, copies)
        elif copies > 0 and len(self._entries) < WAITING:
            self._entries[name] = _Entry(due, copies)

    def earliest(self) -> float:
        """When the next one is due [s]."""
        return min((entry.due for entry in self._entries.values()), default=float("inf"))

    def due(self, now: float) -> list[Name]:
        """What is due, in order."""
        entries = sorted((entry.due, name) for name, entry in self._entries.items() if entry.due <= now)
        return [name for _, name in entries]

    def allows(self, now: float) -> bool:
        """Whether more may be sent."""
        return self._bucket.level(now) > 0

    def charge(self, bytes_: int, now: float) -> None:
        """Something else was sent out of the same allowance."""
        self._bucket.charge(bytes_, now)

    def sent(self, name: Name, bytes_: int, now: float) -> None:
        """A bundle is sent; its next copy follows later."""
        self._bucket.charge(bytes_, now)
        entry = self._entries.get(name)
        if entry is not None:
            entry.copies -= 1
            entry.due = now + REPEAT
            if entry.copies <= 0:
                del self._entries[name]

    def clear(self) -> None:
        """Nothing waits any more."""
        self._entries.clear()

    def drop(self, name: Name) -> None:
        """Do not send it: it is not kept any more."""
        self._entries.pop(name, None)
