"""Bundles a robot lacks and its neighbours hold: whom it asks for which, and when again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

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

MOST_HOLDERS = 4
"""... and of no more robots than this."""

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

    def refresh(self, missing: Sequence[Mapping[Key, Ranges]], now: float) -> None:
        """What of each neighbour's is missing now; what is new in it waits for a moment.

        Neighbours come one after the other: who lies of what it holds hides nothing that another does hold.
        """
        together = _in_turn(
            _in_turn(
                [Name(robot, epoch, number) for number in ranges.newest(AT_ONCE)]
                for (robot, epoch), ranges in of_one.items()
            )
            for of_one in missing
        )
        self._wants = {name: self._wants.get(name) or _Want(now + GRACE) for name in together}

    def pressing(self, now: float) -> bool:
        """Whether anything is missing for longer than it may be on its way."""
        return any(want.asked or want.due <= now for want in self._wants.values())

    def requests(
        self, holders: Callable[[Name], Sequence[str]], eager: int, now: float
    ) -> dict[str, dict[Key, Ranges]]:
        """Whom to ask for what: one holder each, more of them after failures; ``eager``: how many at first."""
        on_their_way = sum(want.due > now and want.asked > 0 for want in self._wants.values())
        chosen = self._due(now, max(0, AT_ONCE - on_their_way))
        requests: dict[str, dict[Key, Ranges]] = {}
        for name in chosen:
            want = self._wants[name]
            many = min(MOST_HOLDERS, eager + want.asked // 2)
            self._ask(requests, name, holders(name), many, now + AGAIN + PER_BUNDLE * len(chosen))
        return requests

    def standing(self, holders: Callable[[Name], Sequence[str]], now: float) -> dict[str, dict[Key, Ranges]]:
        """... where robots push: all at every look, of anyone, as whoever hears it answers."""
        requests: dict[str, dict[Key, Ranges]] = {}
        for name in self._due(now, AT_ONCE):
            self._ask(requests, name, holders(name), 1, now)
        return requests

    def _due(self, now: float, most: int) -> list[Name]:
        """What is to be asked for, what was asked for least first."""
        due = [name for name, want in self._wants.items() if want.due <= now]
        return sorted(due, key=lambda name: self._wants[name].asked)[:most]

    def _ask(
        self, requests: dict[str, dict[Key, Ranges]], name: Name, known: Sequence[str], many: int, due: float
    ) -> None:
        want = self._wants[name]
        first = name.sequence // BLOCK + want.asked
        for k in range(min(len(known), many)):
            of_robot = requests.setdefault(known[(first + k) % len(known)], {})
            of_robot.setdefault((name.robot, name.epoch), Ranges()).add(name.sequence)
        want.due, want.asked = due, want.asked + 1


def _in_turn(lists: Iterable[Iterable[Name]]) -> Iterator[Name]:
    """The first of each, the second of each..."""
    return (name for turn in zip_longest(*lists) for name in turn if name is not None)
