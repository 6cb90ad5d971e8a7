"""When the estimate is given a bundle: whole and at once, so that ``data`` says exactly what it was made of."""

from __future__ import annotations

from collections import Counter, defaultdict
from heapq import heappop, heappush
from itertools import count
from math import inf

from dgorl.configuration import Configuration
from dgorl.history import LATE
from dgorl.measurements import Displacement, Odometry, known_at
from dgorl.team.bundles import Bundle, Sealed
from dgorl.team.journal_data import ranges
from dgorl.team.ranges import Ranges
from dgorl.team.wire import reopened

PATIENCE = 2.0
"""What comes in late goes together: it waits until no more comes, at most so long [s]. Each time is a rewind."""

UNHEARD = 8.0
"""So long [s] what follows a bundle that has not been heard waits for it, where without it a robot were found anew."""

GAP = 1.0
"""Odometry that is missing for longer than this [s] ends a track."""

EARLY = 4_000_000
"""Of an epoch's bundles that are stamped after now so much waits [bytes], the newest ..."""

SOON = 1.0
"""... as bytes, those that are more than this [s] ahead: opened, a bundle takes 25 times the room."""


class Admission:
    """Bundles waiting for the tick at which a Localizer admits all their rows: it then holds back none of them.

    ``rejected`` counts bundles that came too late, whole, or were too many whose clocks are ahead. With ``clock:
    estimated`` nothing waits here: only the team can tell what is late.
    """

    def __init__(self, configuration: Configuration) -> None:
        self.rejected: Counter[str] = Counter()
        self._shared = configuration.clock == "shared"
        self._history = configuration.history
        self._waiting: list[Sealed] = []
        self._early: defaultdict[tuple[str, int], _Early] = defaultdict(_Early)
        self._order = count()
        self._late_before, self._late_since = inf, inf  # what is there at the start goes at once
        self._admitted: dict[tuple[str, int], Ranges] = {}
        self._told: dict[tuple[str, int], float] = {}
        """until when the odometry of an epoch is admitted [s]"""

    @property
    def data(self) -> str:
        """All that was admitted, as the ``data`` column says it."""
        return ranges(self._admitted)

    def offer(self, sealed: Sealed) -> None:
        """Take a bundle, own or received; twice without harm."""
        self._waiting.append(sealed)

    def due(self, now: float, *, takes_late: bool, final: bool = False) -> tuple[Sealed, ...]:
        """What to give the Localizer before it is updated at ``now`` [s], in order of their numbers.

        takes_late: whether it would admit what is later than 10 s. final: there is no later tick to wait for.
        """
        self._put_off(now)
        late = [s for s in self._waiting if _lateness(s.bundle, now) > LATE]
        stopped = self._stopped(len(late), now) or final
        filling = set() if stopped else {_origin(sealed.bundle) for sealed in late}
        takes_late = stopped and takes_late
        if takes_late:
            self._late_before, self._late_since = 0, inf
        taken, waiting = [], []
        for sealed in sorted(self._waiting, key=lambda sealed: sealed.bundle.sequence):
            if self._shared and (
                _origin(sealed.bundle) in filling
                or self._waits(sealed.bundle, now, takes_late)
                or (not final and self._leaves_out(sealed.bundle, now))
            ):
                waiting.append(sealed)
            elif self._shared and now - _since(sealed.bundle, now) > self._history:
                self.rejected["too late"] += 1
            elif self._is_new(sealed.bundle):
                taken.append(sealed)
        self._waiting = waiting
        return tuple(taken)

    def _put_off(self, now: float) -> None:
        """What is stamped ahead waits apart, the newest of it: a robot whose clock is wrong costs no more."""
        if not self._shared:
            return
        waiting, self._waiting = self._waiting, []
        for sealed in waiting:
            if (latest := _latest(sealed.bundle, now)) > now + SOON:
                early = self._early[_origin(sealed.bundle)]
                self.rejected["ahead of the clock"] += early.put(latest, next(self._order), sealed.data)
            else:
                self._waiting.append(sealed)
        for early in self._early.values():
            self._waiting.extend(reopened(data) for data in early.due(now + SOON))
        self._early = defaultdict(_Early, {origin: early for origin, early in self._early.items() if early.waiting})

    def _stopped(self, late: int, now: float) -> bool:
        """Whether of late bundles, ``late`` in number, no more came since the last tick, or they have come for long.

        Until then what is newer of these robots waits, too: with a gap in its way a robot has to be found anew.
        """
        self._late_since = min(self._late_since, now) if late else inf
        before, self._late_before = self._late_before, late
        return late <= before or now - self._late_since >= PATIENCE

    def _waits(self, bundle: Bundle, now: float, takes_late: bool) -> bool:
        """For its time to come, or, late, for a tick that takes it (METHOD §1)."""
        return _latest(bundle, now) > now or (_lateness(bundle, now) > LATE and not takes_late)

    def _leaves_out(self, bundle: Bundle, now: float) -> bool:
        """Whether a bundle that has not been heard yet would leave a gap of odometry before this one.

        Then the robot would have to be found anew; it is foreseen meanwhile.
        """
        known = self._admitted.get(_origin(bundle))
        if not known or bundle.sequence <= known.high or bundle.sequence - 1 in known:
            return False
        begin = min((m.start for m in _odometry(bundle)), default=-inf)
        return begin > self._told.get(_origin(bundle), -inf) + GAP and _lateness(bundle, now) <= UNHEARD

    def _is_new(self, bundle: Bundle) -> bool:
        numbers = self._admitted.setdefault(_origin(bundle), Ranges())
        new = bundle.sequence not in numbers
        numbers.add(bundle.sequence)
        told = max((m.end for m in _odometry(bundle)), default=-inf)
        self._told[_origin(bundle)] = max(told, self._told.get(_origin(bundle), -inf))
        return new


class _Early:
    """Sealed bundles of one epoch that wait for their time. ``waiting``: when, their order, the bytes."""

    def __init__(self) -> None:
        self.waiting: list[tuple[float, int, bytes]] = []
        self._bytes = 0

    def put(self, latest: float, order: int, data: bytes) -> int:
        """Keep one until ``latest`` [s]; how many make way."""
        heappush(self.waiting, (latest, order, data))
        self._bytes += len(data)
        before = len(self.waiting)
        while self._bytes > EARLY:
            self._next()
        return before - len(self.waiting)

    def due(self, now: float) -> list[bytes]:
        """Those whose time has come."""
        found = []
        while self.waiting and self.waiting[0][0] <= now:
            found.append(self._next())
        return found

    def _next(self) -> bytes:
        data = heappop(self.waiting)[2]
        self._bytes -= len(data)
        return data


def _origin(bundle: Bundle) -> tuple[str, int]:
    return bundle.robot, bundle.epoch


def _odometry(bundle: Bundle) -> list[Odometry | Displacement]:
    return [m for m in bundle.measurements if isinstance(m, Odometry | Displacement)]


def _latest(bundle: Bundle, now: float) -> float:
    """When the row is known that is known last [s]."""
    return max((known_at(m) for m in bundle.measurements), default=now)


def _lateness(bundle: Bundle, now: float) -> float:
    """How late the row is that was known first [s]."""
    return now - min((known_at(m) for m in bundle.measurements), default=now)


def _since(bundle: Bundle, now: float) -> float:
    """When the oldest row of a bundle began [s]."""
    return min(
        (m.start if isinstance(m, Odometry | Displacement) else known_at(m) for m in bundle.measurements), default=now
    )
