"""The team where every robot has its own clock: stamps become team time before anything else. METHOD §1, "Clocks".

Measurements wait until their clock is placed; then the ordinary Team gets them with stamps in team time. Where readings
come so late that a map changes that has served already, the team is rewound to before what it served, and gets it anew.
"""

from __future__ import annotations

import bisect
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from math import ceil, floor, inf

from dgorl.clocks import Clocks, Piece
from dgorl.configuration import Configuration
from dgorl.errors import MeasurementError
from dgorl.estimate import ClockState
from dgorl.expansion.step import SPACING
from dgorl.localizer import Team
from dgorl.measurements import ClockKey, ClockReading, Displacement, Measurement, Odometry, known_at
from dgorl.view import TeamNow

KEPT = 30.0
"""Measurements are kept, as they came, this much longer [s] than the history."""

WAITING = 20_000
"""So many measurements wait for one clock to be placed, the newest."""


def team_on(configuration: Configuration, home: ClockKey) -> Team:
    """The team as the configuration's ``clock`` has it; ``home``: the own clock."""
    return ClockedTeam(configuration, home) if configuration.clock == "estimated" else Team(configuration)


class ClockedTeam(Team):
    """A Team whose measurements are on their authors' clocks. ``update`` takes team time: see ``team_now``.

    home: the own clock. rewinds: how often the team was rewound because a map changed; restarts: how often because
    another clock became the reference.
    """

    def __init__(self, configuration: Configuration | None, home: ClockKey) -> None:
        super().__init__(configuration)
        self.clocks = Clocks(home, self.configuration.history)
        self.clocks.rejected = self.history.rejected
        self.rewinds = self.restarts = 0
        self._known: defaultdict[ClockKey, set[Measurement]] = defaultdict(set)
        self._waiting: defaultdict[ClockKey, list[Measurement]] = defaultdict(list)
        self._given: defaultdict[ClockKey, list[tuple[Measurement, Measurement | None]]] = defaultdict(list)
        self._pieces: Mapping[ClockKey, list[Piece]] = {}

    def add(self, measurement: Measurement, clock: ClockKey | None = None) -> None:
        """Take a measurement, in any order, twice without harm; without ``clock`` its stamps are in team time."""
        if clock is None:
            super().add(measurement)
        elif measurement not in self._known[clock]:
            self._known[clock].add(measurement)
            bisect.insort(self._waiting[clock], measurement, key=known_at)

    def add_reading(self, reading: ClockReading) -> None:
        """Take a clock reading, in any order, twice without harm."""
        self.clocks.add(reading)

    def add_birth(self, clock: ClockKey, stamp: float) -> None:
        """Say when a clock began, on that clock [s]: the oldest is the reference, and who comes late knows it so."""
        self.clocks.add_birth(clock, stamp)

    def team_now(self, robot: str, epoch: int, local_now: float) -> float | None:
        """Team time when that clock shows ``local_now`` [s], None while it is not placed."""
        key = robot, epoch
        if key == self.clocks.home:
            self._advance(local_now)
        else:
            home = self._home(self.clocks.chain.team(key, local_now))
            if home is not None:
                self._advance(home)
        return self.clocks.chain.team(key, local_now)

    def prepare(self, now: float) -> bool:
        """A part of ``update(now)``: one node."""
        return super().prepare(self._placed(now))

    def update(self, now: float) -> TeamNow:
        """Alg. 3 at ``now`` [s] of team time. Raises ValueError when ``now`` is not a time."""
        now = self._placed(now)
        return replace(super().update(now), clocks=self._states(now), unplaced=self._unplaced())

    def _placed(self, now: float) -> float:
        """Bring the maps up to ``now`` [s] and give the team what is known by then; now on the maps as they are."""
        home = self._home(now) if now == now else None
        if home is not None:
            reference = self.clocks.chain.reference
            self._advance(home)
            team = self.clocks.chain.team(self.clocks.home, home)
            if self.clocks.chain.reference != reference and team is not None:
                now = team
            self._give(now)
        return now

    def _home(self, team: float | None) -> float | None:
        """What the own clock shows at a team time [s]; before anything is known, the same."""
        if team is None or not self.clocks.chain.pieces:
            return team
        return self.clocks.chain.local(self.clocks.home, team)

    def _advance(self, home: float) -> None:
        """Bring the maps up to when the own clock shows ``home`` [s], and take back what they have given otherwise."""
        chain = self.clocks.chain
        if not self.clocks.advance(home):
            return
        now = self.clocks.chain.team(self.clocks.home, home)
        if self.clocks.chain is not chain:
            self._restart()
        elif now is not None:
            self._take_back(now)
        self._pieces = self.clocks.chain.pieces
        if now is not None:
            self._forget(now - self.configuration.history - KEPT)

    def _restart(self) -> None:
        """Another clock became the reference: team time is another, and everything is given anew."""
        rejected = self.history.rejected
        Team.__init__(self, self.configuration)
        self.history.rejected = rejected
        self.restarts += any(self._given.values())
        self._return(-inf)

    def _take_back(self, now: float) -> None:
        """Rewind to before what the maps as they are now would have given otherwise."""
        earliest = inf
        for clock, given in self._given.items():
            if _changed(self._pieces.get(clock, []), self.clocks.chain.pieces.get(clock, [])):
                for raw, before in given:
                    mapped = self._mapped(clock, raw)
                    if mapped != before:
                        earliest = min(earliest, *(_begin(m) for m in (mapped, before) if m is not None))
        if earliest < inf:
            since = max(floor(earliest / SPACING), ceil((now - self.configuration.history) / SPACING)) * SPACING
            self._rewind(since)
            self._return(since)
            self.rewinds += 1

    def _return(self, since: float) -> None:
        """What was given after ``since`` [s] waits again."""
        for clock, given in self._given.items():
            back = [raw for raw, mapped in given if mapped is None or known_at(mapped) > since]
            self._given[clock] = [item for item in given if item[1] is not None and known_at(item[1]) <= since]
            self._waiting[clock] = sorted([*back, *self._waiting[clock]], key=known_at)

    def _give(self, now: float) -> None:
        """Give the team what is known by ``now`` [s]."""
        for clock, waiting in self._waiting.items():
            local = self.clocks.chain.local(clock, now)
            if local is None:
                for dropped in waiting[:-WAITING]:
                    self._known[clock].discard(dropped)
                del waiting[:-WAITING]
                continue
            ready = bisect.bisect_right(waiting, local, key=known_at)
            for raw in waiting[:ready]:
                mapped = self._mapped(clock, raw)
                self._given[clock].append((raw, mapped))
                if mapped is None:
                    self.history.rejected["the clock jumped"] += 1
                else:
                    super().add(mapped)
            del waiting[:ready]

    def _mapped(self, clock: ClockKey, m: Measurement) -> Measurement | None:
        """A measurement with its stamps in team time; None where they have none."""
        chain = self.clocks.chain
        try:
            if not isinstance(m, Odometry | Displacement):
                stamp = chain.team(clock, m.stamp)
                return None if stamp is None else m if stamp == m.stamp else replace(m, stamp=stamp)
            start, end = chain.team(clock, m.start), chain.team(clock, m.end)
            if start is None or end is None or not end > start:
                return None
            if (start, end) == (m.start, m.end):
                return m
            if isinstance(m, Displacement):
                return replace(m, start=start, end=end)
            rate = (m.end - m.start) / (end - start)  # the way is what the wheels measured
            return replace(m, start=start, end=end, v=m.v * rate, omega=m.omega * rate)
        except MeasurementError:
            return None

    def _forget(self, before: float) -> None:
        """Drop what was given and is older than ``before`` [s]."""
        for clock, given in self._given.items():
            local = self.clocks.chain.local(clock, before)
            if local is not None and given and known_at(given[0][0]) < local:
                self._known[clock].difference_update(raw for raw, _ in given if known_at(raw) < local)
                self._given[clock] = [item for item in given if known_at(item[0]) >= local]

    def _states(self, now: float) -> dict[str, ClockState]:
        newest: dict[str, ClockKey] = {}
        pieces = self.clocks.chain.pieces
        for key in sorted(pieces, key=lambda key: (pieces[key][-1][1].entered, key)):
            newest[key[0]] = key
        states = {}
        for robot, key in sorted(newest.items()):
            local, placed = self.clocks.chain.local(key, now), pieces[key][-1][1]
            if local is not None:
                states[robot] = ClockState(key[1], now - local, placed.drift, placed.sigma)
        return states

    def _unplaced(self) -> frozenset[str]:
        """Robots heard of, none of whose clocks is placed."""
        pieces = self.clocks.chain.pieces
        placed = {robot for robot, _ in pieces} or {self.clocks.home[0]}
        return frozenset(robot for (robot, _), waiting in self._waiting.items() if waiting) - placed


def _changed(before: list[Piece], after: list[Piece]) -> bool:
    """Whether maps that have served are others now: the same nodes', all before the first, all since a jump."""
    old = dict(before)
    jumped = any(placed.since > -inf and g not in old for g, placed in after)
    return (
        jumped or any(old.get(g) not in (None, placed) for g, placed in after) or not {g for g, _ in after} & set(old)
    )


def _begin(m: Measurement) -> float:
    return m.start if isinstance(m, Odometry | Displacement) else m.stamp
