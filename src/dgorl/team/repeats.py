"""How often the same thing is told: at once the first time, then as a count a minute. No clock in here."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

EVERY = 60.0
"""Time between two words about the same thing [s]."""

KINDS = 256
"""So many things are told apart; whoever thinks of more is counted together."""


@dataclass
class _Told:
    at: float
    untold: int = 0


class Repeats:
    """Ask :meth:`first` whether to tell, and now and then tell what is :meth:`due`."""

    def __init__(self) -> None:
        self._told: dict[Hashable, _Told] = {}

    def first(self, kind: Hashable, now: float) -> bool:
        """Whether it is told at ``now`` [s]; it is counted otherwise."""
        told = self._told.get(kind)
        if told is None and len(self._told) >= KINDS:
            kind, told = None, self._told.get(None)
        if told is None:
            self._told[kind] = _Told(now)
            return True
        told.untold += 1
        return False

    def due(self, now: float, *, all_of_it: bool = False) -> list[tuple[Hashable, int, float]]:
        """What came again and is told now: its kind, how often, within how long a time [s]. None: of many kinds.

        all_of_it: however short the time is, as nothing more will be told.
        """
        found = []
        for kind, told in list(self._told.items()):
            since = now - told.at
            if since < EVERY and not all_of_it:
                continue
            if told.untold:
                found.append((kind, told.untold, since))
                self._told[kind] = _Told(now)
            elif since >= EVERY:
                del self._told[kind]
        return found
