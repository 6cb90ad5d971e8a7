"""What a live robot estimates: bundles in, what is said of its peers out, behind the last wall.

The Localizer is given bundles alone, the robot's own included, so that all robots compute the same.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import inf

from dgorl.localizer import Localizer
from dgorl.measurements import ClockKey
from dgorl.replay import start_priors
from dgorl.team.bundles import Bundle, Sealed
from dgorl.team.journal import Journal
from dgorl.team.journal_admission import Admission
from dgorl.team.journal_schema import JournalError
from dgorl.team.report import Clock, Peer, clocks_of, peers_of
from dgorl.team.team_file import TeamFile
from dgorl.team.wall import Failure, Wall, isolated
from dgorl.team_time import team_on

Said = tuple[Mapping[str, Peer], Mapping[str, Clock]]
"""Of peers and clocks, as a report says it."""


class Estimator:
    """The Localizer of a robot in one epoch, what waits for it, and what is done when it raises.

    opened: bundles out of what the journal holds. trouble: told what the disk refuses.
    """

    def __init__(
        self,
        clock: ClockKey,
        team: TeamFile,
        journal: Journal,
        opened: Callable[[Iterable[bytes]], Iterable[Sealed]],
        trouble: Callable[[JournalError], None],
    ) -> None:
        self.estimated = 0.0
        """Team time of the last estimate [s]."""
        self.spent = 0.0
        """CPU time that the estimate took that is being made [s]."""
        self._clock, self._team, self._journal = clock, team, journal
        self._opened, self._trouble = opened, trouble
        self._wall = Wall(team.configuration.history)
        self._refused: Counter[str] = Counter()
        self._begin(())

    @property
    def data(self) -> str:
        """What the estimate is made of, as the ``data`` column says it."""
        return self._admission.data

    @property
    def rejected(self) -> Counter[str]:
        """Measurements and bundles turned down since the robot began, by reason."""
        return self._refused + self._localizer.team.history.rejected + self._admission.rejected

    @property
    def failures(self) -> deque[Failure]:
        """Errors that ended at the wall; taken out by who logs them."""
        return self._wall.failures

    def offer(self, sealed: Sealed) -> None:
        """Take a bundle, own or received; twice without harm."""
        self._admission.offer(sealed)

    def admit(self, now: float, *, final: bool = False) -> None:
        """Let in what came by ``now`` [s], the stamp of a tick; the journal is told first: what fails is there."""
        began = time.process_time()
        if not self._wall.shut(now):
            if (past := self._wall.past()) is not None:
                self._begin_anew(now - past)
            takes_late = False
            with self._guarded(now):
                takes_late = self._localizer.team.takes_late(now)
            admitted = self._admission.due(now, takes_late=takes_late, final=final)
            self._journal.tick(now, admitted)
            with self._guarded(now):
                for sealed in admitted:
                    self._give(sealed.bundle)
        self.spent = time.process_time() - began

    def prepare(self, now: float) -> bool:
        """A part of the estimate at ``now`` [s]; whether more parts are left."""
        began, more = time.process_time(), False
        if not self._wall.shut(now):
            with self._guarded(now):
                more = self._localizer.prepare(self._team_time(now))
        self.spent += time.process_time() - began
        return more

    def said(self, now: float) -> Said:
        """What is known at ``now`` [s]; of nobody anything while the estimator fails."""
        began = time.process_time()
        said: Said = isolated(name for name in self._team.robots if name != self._clock[0]), {}
        self.estimated = now
        if not self._wall.shut(now):
            with self._guarded(now):
                self.estimated = self._team_time(now)
                estimate = self._localizer.update(self.estimated)
                said = peers_of(estimate), clocks_of(estimate)
        self.spent += time.process_time() - began
        return said

    def anticipate(self, now: float) -> None:
        """Compute what an estimate at ``now`` [s] of team time will need."""
        if not self._wall.shut(now):
            with self._guarded(now):
                self._localizer.anticipate(now)

    def _team_time(self, now: float) -> float:
        placed = self._localizer.team.team_now(*self._clock, now)
        return now if placed is None else placed

    def _give(self, bundle: Bundle) -> None:
        clock = bundle.robot, bundle.epoch
        for reading in bundle.clocks:
            self._localizer.team.add_reading(reading)
        for measurement in bundle.measurements:
            self._localizer.add(measurement, clock)

    def _begin(self, known: Iterable[Sealed], since: float = -inf) -> None:
        """The estimate begins with bundles of before, and with the known starts unless it knows no way from them."""
        configuration = self._team.configuration
        self._localizer = Localizer(self._clock[0], team=team_on(configuration, self._clock))
        self._admission = Admission(configuration)
        for start in start_priors(self._team.starts):
            if start.stamp >= since:
                self._localizer.add(start)
        for sealed in known:
            self._admission.offer(sealed)

    def _begin_anew(self, since: float) -> None:
        """It begins as after a restart of the agent, with what came after ``since`` [s] alone."""
        self._refused = self.rejected
        known: tuple[bytes, ...] = ()
        try:
            known = self._journal.begin_anew(since)
        except JournalError as error:
            self._trouble(error)
        self._begin(self._opened(known), since)

    @contextmanager
    def _guarded(self, now: float) -> Iterator[None]:
        """The last wall, at a tick [s]: what the estimator raises is told and ends here."""
        try:
            yield
        except Exception as error:
            try:
                self._journal.flush()
            except JournalError as refused:
                self._trouble(refused)
            self._wall.failed(error, now, self._journal.newest)
