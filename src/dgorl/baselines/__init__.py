"""The estimators DGORL is compared with, behind the interface it has itself. METHOD §7; docs/baselines.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol, get_args

from dgorl.baselines.filters import FilterTeam
from dgorl.baselines.intersection import IntersectionTeam, NaiveTeam, SplitIntersectionTeam
from dgorl.baselines.navigation import TerrainTeam
from dgorl.baselines.unknown import AfterTracking
from dgorl.configuration import Configuration, nearest
from dgorl.errors import DgorlError, LogError
from dgorl.estimate import Estimate
from dgorl.localizer import Team
from dgorl.logs.log import Log
from dgorl.measurements import Measurement
from dgorl.terrain import Altitude, Terrain

Name = Literal["dgorl", "dead-reckoning", "naive", "ci", "split-ci", "trn", "gtsam-fixed-lag"]
NAMES: tuple[Name, ...] = get_args(Name)
"""What ``--estimator`` knows: DGORL itself, then its baselines."""


class TeamEstimator(Protocol):
    """What localises a whole team: measurements in, at each tick a state, and the state as each robot sees it.

    ``update`` is called with rising ``now`` [s], ``view`` with what it returned for that ``now``.
    """

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of any robot, in the order in which they become known."""

    def update(self, now: float) -> Any:
        """The team at ``now`` [s]."""

    def view(self, robot: str, state: Any, now: float) -> Estimate:
        """What ``robot`` knows of its peers at ``now`` [s]."""


def make(name: str, log: Log, configuration: Configuration, *, initial: str = "known") -> TeamEstimator:
    """The estimator of a name for the robots of a log; its measurements are not added yet.

    initial: ``unknown`` starts a baseline where DGORL, running beside it, first tracks everybody (AfterTracking).
    Raises DgorlError for an unknown name, MissingExtraError for a package, LogError for inputs the log lacks.
    """
    if name == "dgorl":
        return Team(configuration)
    baseline = _baseline(name, log, configuration, initial)
    return baseline if initial == "known" else AfterTracking(baseline, log.robots, configuration)


def _baseline(name: str, log: Log, configuration: Configuration, initial: str) -> TeamEstimator:
    match name:
        case "dead-reckoning":
            return FilterTeam(configuration)
        case "naive":
            return NaiveTeam(configuration)
        case "ci":
            return IntersectionTeam(configuration)
        case "split-ci":
            return SplitIntersectionTeam(configuration)
        case "trn":
            return TerrainTeam(configuration, *_terrain_of(log, initial))
        case "gtsam-fixed-lag":
            from dgorl.baselines.fixed_lag import FixedLagTeam

            return FixedLagTeam(configuration)
    raise DgorlError(f"no estimator is called `{name}`{nearest(name, NAMES)}; known are {', '.join(NAMES)}")


def _terrain_of(log: Log, initial: str) -> tuple[Terrain, Sequence[Altitude]]:
    """What terrain relative navigation needs besides. Raises LogError for what a log lacks."""
    if initial != "known":
        raise DgorlError("trn needs `--initial known`: the elevation map is in the frame of the starts")
    if log.terrain is None:
        raise LogError(log.path, None, "trn needs an elevation map, terrain.npz; `dgorl simulate --terrain` makes one")
    if not log.altitudes:
        raise LogError(log.path, None, "trn needs altitudes, altitude.csv; `dgorl simulate --terrain` makes them")
    return log.terrain, log.altitudes
