"""Bundles a robot lacks and its neighbours hold: whom it asks for which, and when again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from dgorl.team.bundles import Name
from dgorl.team.messages import Key
from dgorl.team.ranges import Ranges

GRACE = 0.4
"""What is missing may be on its way for this long [s]."""

AGAIN = 0.6
"""Unanswered requests are repeated after this [s] ..."""

PER_BUNDLE = 0.004
"""... and this [s] for each bundle asked for at once."""

AT_ONCE = 256
"""So many bundles are asked for at once, the newest first; of an epoch no more than these are looked at."""

BLOCK = 16
"""Bundles that follow on are asked of one robot."""


@dataclass(slots=True)
class _Want:
    due: float
    asked: int = 0


class Wants:
    """What is missing, since when, and how often it was asked for."""

    def __init__(self) -> None:
        self._wants: dict[Name, _Want] = {}

    def refresh(self, missing: Mapping[Key, Ranges], now: float) -> None:
        """What is missing now; what is new in it waits for a moment."""
        names = [
            Name(robot, epoch, number)
            for (robot, epoch), ranges in missing.items()
            for number in ranges.newest(AT_ONCE)
        ]
        self._wants = {name: self._wants.get(name) or _Want(now + GRACE) for name in names}

    def pressing(self, now: float) -> bool:
        """Whether anything is missing for longer than it may be on its way."""
        return any(want.asked or want.due <= now for want in self._wants.values())

    def requests(
        self, holders: Callable[[Name], Sequence[str]], eager: int, now: float, again: float | None = None
    ) -> dict[str, dict[Key, Ranges]]:
        """Whom to ask for what: one holder each, more of them after failures; ``eager``: how many at first.

        again: repeat what is not answered after this [s] instead of AGAIN and PER_BUNDLE.
        """
        on_their_way = sum(want.due > now and want.asked > 0 for want in self._wants.values())
        due = [(want.asked, -name.sequence, name) for name, want in self._wants.items() if want.due <= now]
        requests: dict[str, dict[Key, Ranges]] = {}
        chosen = sorted(due)[: max(0, AT_ONCE - on_their_way)]
        again = AGAIN + PER_BUNDLE * len(chosen) if again is None else again
        for asked, _, name in chosen:
            known = holders(name)
            want = self._wants[name]
            want.due, want.asked = now + again, asked + 1
            first = name.sequence // BLOCK + asked
            for k in range(min(len(known), eager + asked // 2)):
                of_robot = requests.setdefault(known[(first + k) % len(known)], {})
                of_robot.setdefault((name.robot, name.epoch), Ranges()).add(name.sequence)
        return requests
