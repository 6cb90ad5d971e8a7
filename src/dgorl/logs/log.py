"""What every reader returns and every writer takes: one team's log, whatever its format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dgorl.measurements import Measurement
from dgorl.se2 import Array


@dataclass(frozen=True)
class Start:
    """Where a robot stood at ``stamp`` [s] in the log's frame: pose (3,) [m, m, rad]."""

    stamp: float
    pose: tuple[float, float, float]


@dataclass(frozen=True)
class Log:
    """A team's recording: measurements in the order they became known, and truth kept apart from them.

    truth: robot → (T, 4) of t, x, y, theta, rising t; empty where the log has none. Only :mod:`dgorl.evaluation`
    reads it. starts: the log's start poses, used by ``--initial known`` alone. configuration: nested settings the log
    itself states (radio, antennas, ...), over the defaults and under the user's. skipped: rows left out, by reason.
    """

    path: Path
    robots: tuple[str, ...]
    measurements: tuple[Measurement, ...]
    truth: Mapping[str, Array] = field(default_factory=lambda: MappingProxyType({}))
    starts: Mapping[str, Start] = field(default_factory=lambda: MappingProxyType({}))
    configuration: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    skipped: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
