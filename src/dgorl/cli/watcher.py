"""A team's network as ``monitor`` and ``doctor`` listen to it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from dgorl.errors import DgorlError
from dgorl.team.snapshot import snapshot
from dgorl.team.team_file import TeamFile
from dgorl.team.watch import Watch
from dgorl.team.zenoh_transport import ZenohTransport

LOOK = 0.05
"""The network is looked at this often [s]."""


class Watcher:
    """A team's network and what was heard on it. Raises NetworkError, ConfigurationError."""

    def __init__(self, team: TeamFile, name: str) -> None:
        self.team, self.watch = team, Watch(team.roster)
        self._wall = time.time() - time.monotonic()
        self.network = ZenohTransport(
            team.team, name, team.transport, self.now, team.path.parent, team.roster.robots, watching=True
        )

    def now(self) -> float:
        """The wall clock as it was at the beginning, whatever happens to it [s]."""
        return time.monotonic() + self._wall

    def close(self) -> None:
        """Leave the network."""
        self.network.close()

    def state(self) -> dict[str, Any]:
        """What is known now."""
        return snapshot(self.team, self.watch, self.network.present(), self.now(), self.network.nameless)

    def listen(self, seconds: float) -> Iterator[None]:
        """Take what comes for so long; yields now and then."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            time.sleep(min(LOOK, left))
            self.watch.take(self.network.poll())
            yield

    def meet(self, seconds: float) -> None:
        """Listen until all who are there told of themselves, ``seconds`` at most. Raises DgorlError if nobody did."""
        began = time.monotonic()
        for _ in self.listen(seconds):
            told = {robot for robot, seen in self.watch.robots.items() if seen.bulletin is not None}
            there = self.network.present() & set(self.team.robots)
            if len(told) == len(self.team.robots) or (told >= there and told and time.monotonic() - began > 1.5):
                return
        if not any(seen.bulletin is not None for seen in self.watch.robots.values()):
            advice = f"`dgorl doctor --team {self.team.path}` looks for the reason"
            raise DgorlError(f"team {self.team.team}: nobody was heard for {seconds:g} s; {advice}")
