"""The clock of a robot: its machine's; in a fleet on one machine a recording's time, at any rate, off and drifting."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass, field

from dgorl.clocks import SteadyClock
from dgorl.errors import ConfigurationError
from dgorl.team.lines import LinesIn

READY = "ready"
"""The event logged when only the word to begin is missing."""

log = logging.getLogger("dgorl.agent")


@dataclass(frozen=True)
class Pace:
    """The recording is at ``origin`` [s] when the machine's monotonic clock is at ``at`` [s], ``rate`` times as fast.

    The robot's clock is ahead of the recording by ``offset`` [s], and by ``drift`` [ppm] of the time since ``origin``.
    """

    origin: float
    at: float
    rate: float = 1.0
    offset: float = 0.0
    drift: float = 0.0

    def recording(self) -> float:
        """The recording's time now [s]."""
        return self.origin + (time.monotonic() - self.at) * self.rate

    def now(self) -> float:
        """The robot's clock now [s]."""
        return self.to_robot(self.recording())

    def to_robot(self, stamp: float) -> float:
        """The robot's clock [s] at a time of the recording [s]; without offset and drift the same to the bit."""
        return stamp + self.offset + 1e-6 * self.drift * (stamp - self.origin)

    def to_recording(self, stamp: float) -> float:
        """The recording's time [s] when the robot's clock is at ``stamp`` [s]; its inverse."""
        if not self.offset and not self.drift:
            return stamp
        return self.origin + (stamp - self.offset - self.origin) / (1.0 + 1e-6 * self.drift)


@dataclass
class Wall:
    """The machine's clock as an agent's: steady, whatever happens to the wall clock."""

    _steady: SteadyClock = field(default_factory=lambda: SteadyClock(time.time(), time.monotonic()))

    def now(self) -> float:
        """The robot's clock [s]."""
        return self._steady.now(time.monotonic())

    def ahead(self) -> float:
        """How far the wall clock, which sensors stamp with, has jumped ahead of it [s]."""
        jump = self._steady.look(time.time(), time.monotonic())
        if jump:
            log.warning("the wall clock jumped", extra={"fields": {"by_s": round(jump, 3)}})
        return self._steady.difference if self._steady.jumps else 0.0


def begin(lines: LinesIn) -> float:
    """The machine's monotonic clock [s] when the recording begins: the first line, said when all agents are ready.

    Raises ConfigurationError for another.
    """
    log.info(READY, extra={"fields": {"pid": os.getpid()}})
    line = next(iter(lines), b"")
    try:
        return float(line)
    except ValueError:
        raise ConfigurationError(f"stdin: the first line must be when the recording begins, got {line!r}") from None
