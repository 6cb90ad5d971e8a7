"""The beam: what is possible of a cluster, with probabilities. METHOD §4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from dgorl import se2
from dgorl.expansion.apart import SAME, apart
from dgorl.expansion.cluster_graph import Optima
from dgorl.se2 import Array
from dgorl.tracks import TrackKey
from dgorl.window import Component

BEAM = 8
"""Hypotheses kept about a cluster."""

ALIVE = 14.0
"""Hypotheses whose log mass is this much below the best are dropped."""

TIE = 0.02
"""A new optimum in the place of a known one is better when its log mass is higher by this."""

COARSE = 30.0
"""The same where masses are those of a coarse graph."""

BEARING, NEAR = 0.25, 5.0
"""Position σ up to which a place counts as one, as a share of the distance, taken to be at least that far [m]."""

NODES = 2
"""Nodes in a row at which a relative pose has to be certain to be accepted, and a track has not fitted to be named."""

STUBBORN = 4
"""Nodes in a row for which a track has not fitted when the others are joined without it."""

CERTAIN = 0.999
"""Probability at which a relative pose is accepted, at two nodes in a row."""


Motion = Literal["", "straight", "uncertain", "still"]
"""Every track has gone straight, or as far as its odometry can tell, which is not far, so that the mirror image fits as
well; or none has moved at all. METHOD §3."""


@dataclass(frozen=True)
class Hypothesis:
    """One optimum of a cluster's graph at a node.

    component: all tracks since the cluster's base. recent: their last seconds with all that came before as a prior,
    which ticks extend; recent_mass: its log mass at the node, so that ticks weigh by the change.
    """

    component: Component
    mass: float
    probability: float
    recent: Component
    recent_mass: float


@dataclass(frozen=True)
class Cluster:
    """Components that measurements link but that are not joined, from keyframe ``base`` on; hypotheses best first.

    groups: the tracks of each of its components. agreed: pairs of tracks on whose relative pose all probable hypotheses
    agree, and for how many nodes in a row.
    """

    base: int
    groups: tuple[tuple[TrackKey, ...], ...]
    hypotheses: tuple[Hypothesis, ...]
    agreed: Mapping[tuple[TrackKey, TrackKey], int] = field(default_factory=dict)
    motion: Motion = ""
    """what all tracks have in common that leaves them ambiguous"""
    unfit: Mapping[TrackKey, int] = field(default_factory=dict)
    """tracks that do not fit the best hypothesis, and for how many nodes in a row: nobody is joined to them"""
    passing: tuple[TrackKey, TrackKey] | None = None
    """who have passed one another so that the side they took is why they are not joined any more"""
    begun: int = 0
    """number of the node at which it was formed"""
    astray: int = 0
    """for how many nodes in a row some track has not fitted the best hypothesis, even as its kernels have it"""

    @property
    def tracks(self) -> frozenset[TrackKey]:
        return frozenset(self.hypotheses[0].component.tracks)

    @property
    def sure(self) -> list[tuple[TrackKey, TrackKey]]:
        """Pairs whose relative pose is accepted: nobody's while it is new that a track does not fit.

        It may be that the search has missed the right optimum, of which that track is a part.
        """
        if 0 < self.astray < STUBBORN:
            return []
        fit = self.tracks - self.unfit.keys()
        return [pair for pair, nodes in sorted(self.agreed.items()) if nodes >= NODES and fit.issuperset(pair)]

    @property
    def named(self) -> frozenset[TrackKey]:
        """Tracks known not to fit, as the others fit one another without them."""
        fit = self.tracks - self.unfit.keys()
        return frozenset(key for key, nodes in self.unfit.items() if nodes >= NODES and len(fit) > 1)


def distinct(optima: Optima, limit: int = BEAM, alive: float = ALIVE) -> Optima:
    """The optima worth keeping, best first: at most ``limit``, none twice, none ``alive`` below the best."""
    return optima[_apart(optima, optima.mass, limit, alive)]


def fresh(known: Optima, found: Optima, limit: int) -> Optima:
    """Those of ``found`` that are new, or better than a ``known`` one in its place: best first, at most ``limit``."""
    count = len(known.mass)
    merit = np.concatenate([known.mass + TIE, found.mass])
    everything = both(known, found)
    kept = _apart(everything, merit, len(merit), COARSE)
    return found[[b - count for b in kept if b >= count][:limit]]


def both(a: Optima, b: Optima) -> Optima:
    """All optima of both."""
    return Optima(*(np.concatenate(pair) for pair in zip(a.fields, b.fields, strict=True)))


def _apart(optima: Optima, merit: Array, limit: int, alive: float) -> list[int]:
    """Indices of distinct optima, best first by ``merit`` (B,)."""
    order = np.argsort(-merit, kind="stable")
    order = order[merit[order] >= merit.max() - alive]
    return apart(optima.relative[:, 1:], optima.covariance[:, 3:, 3:], order, limit)


def probabilities(mass: Array) -> Array:
    """softmax of log masses (B,)."""
    weight = np.exp(mass - mass.max())
    return np.asarray(weight / weight.sum())


def pair_relative(poses: Array, covariance: Array, a: int, b: int) -> tuple[Array, Array]:
    """T_a_b (3,) of two tracks and its covariance (3, 3), right perturbations; poses (n, 3), covariance (3n, 3n)."""
    T_a_b = se2.between(poses[a], poses[b])
    back = se2.adjoint(se2.inverse(T_a_b))
    rows_a, rows_b = slice(3 * a, 3 * a + 3), slice(3 * b, 3 * b + 3)
    cross = covariance[rows_b, rows_a] @ back.T
    return T_a_b, covariance[rows_b, rows_b] - cross - cross.T + back @ covariance[rows_a, rows_a] @ back.T


def agreement(optima: Optima, probability: Array, a: int, b: int) -> float:
    """Probability of the hypotheses that agree with the best one on the relative pose of tracks a and b."""
    T_best, covariance = pair_relative(optima.relative[0], optima.covariance[0], a, b)
    difference = se2.between(T_best, se2.between(optima.relative[:, a], optima.relative[:, b]))
    square = np.einsum("bi,ij,bj->b", difference, np.linalg.inv(covariance), difference)
    return float(probability[square <= SAME**2].sum())


def settled_pair(optima: Optima, a: int, b: int) -> bool:
    """Whether one of two tracks sees the other within ±BEARING of its distance (1σ), so that Laplace's method holds.

    A wider posterior is bent round the ring of the ranges: its one optimum is no proof that there is no other place.
    The other way round may stay open: a robot that stands never learns its heading.
    """
    spread = []
    for x, y in ((a, b), (b, a)):
        T_x_y, covariance = pair_relative(optima.relative[0], optima.covariance[0], x, y)
        distance = max(float(np.hypot(T_x_y[0], T_x_y[1])), NEAR)
        spread.append(float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])) / distance)
    return min(spread) <= BEARING


def groups_of(pairs: Sequence[tuple[TrackKey, TrackKey]], members: Mapping[TrackKey, int]) -> list[set[int]]:
    """Sets of components that pairs of their tracks connect; members: track → its component."""
    groups: list[set[int]] = []
    for a, b in pairs:
        joined = {members[a], members[b]}
        for group in [g for g in groups if g & joined]:
            groups.remove(group)
            joined |= group
        groups.append(joined)
    return groups
