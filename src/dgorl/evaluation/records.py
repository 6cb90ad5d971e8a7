"""What a replay estimated, tick by tick, beside what was true: the only place where the two meet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dgorl.estimate import Estimate, PeerEstimate, PeerHypothesis, Status
from dgorl.measurements import WORLD
from dgorl.replay import Tick
from dgorl.se2 import Array, between, wrap

LOCATED = (Status.POSITION, Status.TRACKED)
MAXIMUM_GAP = 1.0
"""truth is not interpolated across a longer gap than this [s]"""

_UNHEARD = PeerEstimate(None, None, Status.ISOLATED, 0.0, np.inf, "nothing heard yet")


@dataclass(frozen=True)
class PairRecord:
    """``peer`` as ``ego`` saw it, one row a tick.

    t (T,) [s]; pose (T, 3) of the peer in the ego's body frame [m, m, rad], NaN where there is none;
    covariance (T, 3, 3) of it, in the ego's frame; probability (T,); age (T,) [s]; truth (T, 3) the true
    pose, NaN where unknown; hypotheses: row → all that were alive at that tick, most probable first; rows without
    any are left out. data (T,): the bundles each row was made of, for a live robot. tangent (T, 3, 3): covariance in
    the tangent space of the pose, NaN where there is none.
    """

    ego: str
    peer: str
    t: Array
    pose: Array
    covariance: Array
    status: tuple[Status, ...]
    probability: Array
    age: Array
    reason: tuple[str, ...]
    resolve_by: tuple[str, ...]
    truth: Array
    hypotheses: Mapping[int, tuple[PeerHypothesis, ...]] = field(default_factory=dict)
    data: tuple[str, ...] | None = None
    tangent: Array | None = None

    @property
    def located(self) -> NDArray[np.bool_]:
        """(T,) status `position` or `tracked`."""
        return self.having(*LOCATED)

    def having(self, *statuses: Status) -> NDArray[np.bool_]:
        """(T,) status one of these."""
        return np.array([s in statuses for s in self.status], dtype=bool)


@dataclass(frozen=True)
class Records:
    """A whole replay.

    pairs: (ego, peer) → record, sorted, the pseudo-peer ``world`` among them; stamps (T,) [s]; tick_s: ego →
    (T,) CPU seconds each tick takes that robot; truth: robot → (N, 4); last: ego → its last estimate.
    """

    egos: tuple[str, ...]
    stamps: Array
    tick_s: Mapping[str, Array]
    pairs: Mapping[tuple[str, str], PairRecord]
    truth: Mapping[str, Array] = field(default_factory=dict)
    last: Mapping[str, Estimate] = field(default_factory=dict)

    def of(self, ego: str) -> dict[str, PairRecord]:
        """Peer → record of one ego, the world left out."""
        return {b: record for (a, b), record in self.pairs.items() if a == ego and b != WORLD}

    def between_robots(self) -> list[PairRecord]:
        """Every record but those of the world."""
        return [record for (_, peer), record in self.pairs.items() if peer != WORLD]


def collect(ticks: Iterable[Tick], truth: Mapping[str, Array]) -> Records:
    """Run through a replay and keep what it estimated; a peer not heard of yet is isolated.

    truth: robot → (N, 4) of t, x, y, theta in a common frame; may be empty or lack robots.
    """
    rows: dict[tuple[str, str], dict[int, PeerEstimate]] = {}
    stamps: list[float] = []
    tick_s: dict[str, list[float]] = {}
    last: Mapping[str, Estimate] = {}
    for tick in ticks:
        stamps.append(tick.stamp)
        last = tick.estimates
        for ego, estimate in tick.estimates.items():
            tick_s.setdefault(ego, []).append(tick.cpu_s[ego])
            for peer, seen in estimate.items():
                rows.setdefault((ego, peer), {})[len(stamps) - 1] = seen
    t = np.array(stamps)
    pairs = {
        (a, b): _record(a, b, t, [seen.get(k, _UNHEARD) for k in range(len(t))], truth)
        for (a, b), seen in sorted(rows.items())
    }
    cpu = {ego: np.array(seconds) for ego, seconds in sorted(tick_s.items())}
    return Records(tuple(cpu), t, cpu, pairs, truth, last)


def truth_at(truth: Mapping[str, Array], robot: str, t: Array) -> Array:
    """True pose T_log_robot at stamps t (T,), interpolated, the heading along the shorter arc: (T, 3).

    NaN where there is no truth, before its first and after its last row, and inside gaps above
    ``MAXIMUM_GAP``. The world stands at the origin of the log's frame.
    """
    if robot == WORLD:
        return np.zeros((len(t), 3))
    known = truth.get(robot)
    if known is None or len(known) == 0:
        return np.full((len(t), 3), np.nan)
    stamps = known[:, 0]
    after = np.clip(np.searchsorted(stamps, t, side="left"), 0, len(stamps) - 1)
    before = np.clip(after - 1, 0, None)
    gap = stamps[after] - stamps[before]
    share = np.clip(np.divide(t - stamps[before], gap, out=np.ones(len(t)), where=gap > 0), 0.0, 1.0)
    step = known[after, 1:] - known[before, 1:]
    step[:, 2] = wrap(step[:, 2])
    pose = known[before, 1:] + share[:, None] * step
    pose[:, 2] = wrap(pose[:, 2])
    exact = np.minimum(np.abs(t - stamps[before]), np.abs(t - stamps[after])) < 1e-6
    inside = (t >= stamps[0]) & (t <= stamps[-1]) & (gap <= MAXIMUM_GAP)
    pose[~(exact | inside)] = np.nan
    return np.asarray(pose)


def _record(ego: str, peer: str, t: Array, seen: Sequence[PeerEstimate], truth: Mapping[str, Array]) -> PairRecord:
    none, no_covariance = np.full(3, np.nan), np.full((3, 3), np.nan)
    return PairRecord(
        ego=ego,
        peer=peer,
        t=t,
        pose=np.array([none if e.pose is None else e.pose for e in seen]),
        covariance=np.array([no_covariance if e.covariance is None else e.covariance for e in seen]),
        status=tuple(e.status for e in seen),
        probability=np.array([e.probability for e in seen], dtype=float),
        age=np.array([e.age for e in seen], dtype=float),
        reason=tuple(e.reason for e in seen),
        resolve_by=tuple(e.resolve_by for e in seen),
        truth=between(truth_at(truth, ego, t), truth_at(truth, peer, t)),
        hypotheses={k: e.hypotheses for k, e in enumerate(seen) if e.hypotheses},
        tangent=np.array([no_covariance if e.tangent_covariance is None else e.tangent_covariance for e in seen]),
    )
