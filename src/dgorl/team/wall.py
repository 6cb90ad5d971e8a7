"""The last wall: an estimator that raises costs a robot its estimate for some seconds, not its life.

A fault may come of the robots' data. These are kept, so it would come again at every tick and after every restart: the
estimator is asked again at the next node, and if it fails again made anew of ever less of the past.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from math import floor, inf

from dgorl.estimate import Status
from dgorl.expansion.step import SPACING
from dgorl.nodes import DELAY
from dgorl.team.report import Peer

REASON = "internal error, reported"
RESOLVE_BY = "report the traceback in its log, with its journal"

SELDOM = 60.0
"""A fault at the same place is told again after this [s], with how often it came."""


@dataclass(frozen=True)
class Failure:
    """An error of the estimator at ``tick`` [s], when ``entry`` was the journal's newest.

    repeated: how often it came since it was told last.
    """

    error: Exception
    tick: float
    entry: int
    repeated: int


class Wall:
    """When the estimator may be asked, and what is told of its failures.

    ``failures`` waits for who logs them. history: how long it remembers [s].
    """

    def __init__(self, history: float) -> None:
        self.failures: deque[Failure] = deque(maxlen=100)
        self._history = history
        self._stamps: list[float] = []
        self._past: float | None = None
        self._until = -inf
        self._told: dict[str, float] = {}
        self._untold: dict[str, int] = {}

    def shut(self, now: float) -> bool:
        """Whether it is left alone at ``now`` [s]: until the next node is due after it has failed."""
        return now < self._until

    def failed(self, error: Exception, now: float, entry: int) -> None:
        """It raised, at ``now`` [s], when the journal's newest entry was ``entry``."""
        self._until = (floor((now - DELAY) / SPACING) + 1) * SPACING + DELAY
        self._stamps = [stamp for stamp in self._stamps if now - stamp <= 2 * self._history] + [now]
        again = len(self._stamps) - 2
        self._past = None if again < 0 else self._history / 4**again
        where = _where(error)
        count = self._untold[where] = self._untold.get(where, 0) + 1
        if now - self._told.get(where, -inf) >= SELDOM:
            self.failures.append(Failure(error, now, entry, count - 1))
            self._told[where], self._untold[where] = now, 0

    def past(self) -> float | None:
        """Of how long a past [s] to make it anew before it is asked again, once; None: it goes on as it is.

        A first failure may be a tick's alone, or more data may mend it. Each further one quarters the past.
        """
        past, self._past = self._past, None
        return past


def isolated(robots: Iterable[str]) -> dict[str, Peer]:
    """What is said of the peers of a robot whose estimator failed."""
    return {name: Peer(None, None, Status.ISOLATED, 0.0, None, REASON, RESOLVE_BY) for name in sorted(robots)}


def _where(error: Exception) -> str:
    """What kind of error it is, and the line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__} {place}"
