"""The weights A(t) robots average with, and the paper's Assumptions 1–3 about them, watched. METHOD §6.

1. A(t) is doubly stochastic. 2. A(t) has ξ or more on its diagonal and wherever it is not zero. 3. The links of any T
rounds, from sT to (s + 1)T − 1, connect the team strongly.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dgorl.se2 import Array

ROUNDING = 1e-9
"""Rows and columns may be this far from 1."""


def metropolis_weights(hears: ArrayLike) -> Array:
    """A (n, n): A_ij = 1/(1 + max(d_i, d_j)) on links up in both directions, A_ii = 1 − Σ. METHOD §6.

    hears: (n, n) bool, whether robot i hears robot j. Doubly stochastic, and as d ≤ n − 1 nothing on its diagonal or
    on a link is below 1/n. Raises ValueError for what is no square matrix.
    """
    heard = np.asarray(hears, dtype=bool)
    if heard.ndim != 2 or heard.shape[0] != heard.shape[1]:
        raise ValueError(f"hears: must be n × n, got {heard.shape}")
    links = heard & heard.T & ~np.eye(len(heard), dtype=bool)
    degree = links.sum(axis=1)
    weights = links / (1.0 + np.maximum(degree[:, None], degree))
    return np.asarray(weights + np.diag(1.0 - weights.sum(axis=1)))


def strongly_connected(links: NDArray[np.bool_]) -> bool:
    """Whether every robot reaches every other along directed links (n, n)."""
    return all(_reached(direction).all() for direction in (links, links.T))


def _reached(links: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What robot 0 reaches."""
    known = np.zeros(len(links), dtype=bool)
    if len(known):
        known[0] = True
    while (grown := known | links[known].any(axis=0)).sum() > known.sum():
        known = grown
    return known


@dataclass(frozen=True)
class Assumptions:
    """How far rows and columns were from 1, the smallest positive weight or diagonal entry, and blocks of T rounds.

    needed: ξ. broken: what does not hold, in words; empty when all three do.
    """

    rounds: int
    deviation: float
    smallest: float
    needed: float
    blocks: int
    connected: int

    @property
    def broken(self) -> tuple[str, ...]:
        found = []
        if self.deviation > ROUNDING:
            found.append(f"1: a row or column of A(t) sums to {self.deviation:.3g} more or less than 1")
        if self.smallest < self.needed - ROUNDING:
            found.append(f"2: a weight of {self.smallest:.3g} is below ξ = {self.needed:.3g}")
        if self.connected < self.blocks:
            found.append(f"3: {self.blocks - self.connected} of {self.blocks} blocks of rounds do not connect the team")
        return tuple(found)


@dataclass
class AssumptionsMonitor:
    """Takes A(t) round after round; ``report`` says which assumptions held so far.

    n: robots. block: T, rounds whose union has to be connected. xi: the ξ asked, 1/n if None.
    """

    n: int
    block: int
    xi: float | None = None
    _rounds: int = field(default=0, init=False)
    _deviation: float = field(default=0.0, init=False)
    _smallest: float = field(default=1.0, init=False)
    _blocks: int = field(default=0, init=False)
    _connected: int = field(default=0, init=False)
    _union: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        self._union = np.zeros((self.n, self.n), dtype=bool)

    def observe(self, weights: Array) -> None:
        """The weights (n, n) of the next round. Raises ValueError for another size or negative weights."""
        if weights.shape != (self.n, self.n) or not (weights >= 0).all():
            raise ValueError(f"weights: must be {self.n} × {self.n} and not negative")
        self._rounds += 1
        sums = np.concatenate([weights.sum(axis=0), weights.sum(axis=1)])
        self._deviation = max(self._deviation, float(np.abs(sums - 1).max()))
        counted = np.concatenate([weights[weights > 0], np.diag(weights)])
        self._smallest = min(self._smallest, float(counted.min()))
        self._union |= weights > 0
        if self._rounds % self.block == 0:
            self._blocks += 1
            self._connected += strongly_connected(self._union)
            self._union[:] = False

    def report(self) -> Assumptions:
        xi = 1.0 / self.n if self.xi is None else self.xi
        return Assumptions(self._rounds, self._deviation, self._smallest, xi, self._blocks, self._connected)
