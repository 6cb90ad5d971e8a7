"""Candidate graphs, best first: one candidate per member, scored by members and pairs of members. METHOD §4.

score = Σ_j U_j[a_j] + Σ_{i<j} θ_ij[a_i, a_j], log scores: higher is better, −inf is impossible. Of the k^(n−1)
graphs A* looks at few: it assigns member after member, and bounds what is left by the best each member could do.
Where the scores of large teams nearly tie it would look at most of them: after so many it goes on as a beam.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from dgorl.se2 import Array

Pairwise = Mapping[tuple[int, int], Array]
Graph = tuple[float, tuple[int, ...]]
Partial = tuple[float, tuple[int, ...], float, Array]
"""−bound, candidates chosen so far, their score, scores of the members left with the chosen ones"""

EXPANSIONS = 5000
"""Partial graphs that A* expands: the work and memory of a search has a bound."""

WIDTH = 100
"""Partial graphs of each length that the beam expands from there on."""


class BestGraphs(Iterator[Graph]):
    """(score, candidate of each member), best first, equal scores in order of the candidates; lazily.

    unary: one (k_j,) per member, k_j ≥ 1. pairwise: (i, j) → (k_i, k_j), i < j; pairs left out score 0.
    Impossible graphs (−inf) are left out. Scores are rounded to 2⁻⁵² of the largest total, about 1e-9 for
    totals of a few millions; then sums are exact, and the order is that of :func:`brute_force`, ties included.

    All this is exact while A* needs at most ``limit`` expansions. What it has yielded by then stays exact; the partial
    graphs it has open are then extended by a beam, member after member, those of the highest bounds first, at most
    ``width`` of each length. Of it come whole graphs that are distinct from those before and score no more, best first
    among themselves, at least one if any is possible along the beam; a better one may be missing. A search therefore
    expands at most limit + width · members partial graphs, and keeps at most k open ones for each.
    Raises ValueError naming the table that is not one.
    """

    def __init__(self, unary: Sequence[Array], pairwise: Pairwise, limit: int = EXPANSIONS, width: int = WIDTH) -> None:
        self.expanded = 0
        """partial graphs expanded so far"""
        self._limit, self._width = limit, width
        scores, pairs = _exact(*_checked(unary, pairwise))
        self._sizes = [len(u) for u in scores]
        n, k = len(scores), max(self._sizes, default=1)
        own = np.full((n, k), -np.inf)
        self._theta = np.zeros((n, k, n, k))
        self._left = np.zeros((n, k))
        """what a member's candidate could at best score with the members after it: the row maxima"""
        for j, u in enumerate(scores):
            own[j, : len(u)] = u
        for (i, j), theta in pairs.items():
            self._theta[i, : len(theta), j, : theta.shape[1]] = theta
            self._left[i, : len(theta)] += theta.max(axis=1)
        bound = float((own + self._left).max(axis=1).sum()) if n else 0.0
        self._open: list[Partial] = []
        if bound > -np.inf:
            self._open.append((-bound, (), 0.0, own))

    def __next__(self) -> Graph:
        while self._open:
            if self.expanded == self._limit and len(self._open[0][1]) < len(self._sizes):
                self._open = self._beam()
                continue
            partial = heapq.heappop(self._open)
            if len(partial[1]) == len(self._sizes):
                return -partial[0], partial[1]
            for extended in self._expand(partial):
                heapq.heappush(self._open, extended)
        raise StopIteration

    def _beam(self) -> list[Partial]:
        """Whole graphs, in order, that a beam makes of the open ones: of each length the best by their bounds."""
        lengths: list[list[Partial]] = [[] for _ in range(len(self._sizes) + 1)]
        for partial in self._open:
            lengths[len(partial[1])].append(partial)
        for length in range(len(self._sizes)):
            for partial in heapq.nsmallest(self._width, lengths[length]):
                lengths[length + 1] += self._expand(partial)
            lengths[length].clear()
        return sorted(lengths[-1])

    def _expand(self, partial: Partial) -> list[Partial]:
        """The graphs with one member more that are possible.

        The bound is consistent and exact for whole graphs, so they are popped in order. Equal bounds pop in order
        of what is chosen, where a graph comes before its extensions.
        """
        self.expanded += 1
        _, chosen, score, own = partial
        j = len(chosen)
        scores = score + own[0]
        after = own[1:] + self._theta[j, :, j + 1 :]
        bounds = scores + (after + self._left[j + 1 :]).max(axis=2).sum(axis=1)
        return [
            (-float(bounds[a]), (*chosen, a), float(scores[a]), after[a])
            for a in range(self._sizes[j])
            if bounds[a] > -np.inf
        ]


def best_graphs(unary: Sequence[Array], pairwise: Pairwise, limit: int = EXPANSIONS, width: int = WIDTH) -> BestGraphs:
    """Candidate graphs best first, see :class:`BestGraphs`; ``.expanded`` counts the work."""
    return BestGraphs(unary, pairwise, limit, width)


def brute_force(unary: Sequence[Array], pairwise: Pairwise) -> list[Graph]:
    """All k^(n−1) candidate graphs, best first: what :func:`best_graphs` has to yield. For small teams."""
    scores, pairs = _exact(*_checked(unary, pairwise))
    graphs = []
    for chosen in product(*(range(len(u)) for u in scores)):
        score = sum(float(u[a]) for u, a in zip(scores, chosen, strict=True))
        score += sum(float(theta[chosen[i], chosen[j]]) for (i, j), theta in pairs.items())
        if score > -np.inf:
            graphs.append((score, chosen))
    return sorted(graphs, key=lambda graph: (-graph[0], graph[1]))


def _checked(unary: Sequence[Array], pairwise: Pairwise) -> tuple[list[Array], dict[tuple[int, int], Array]]:
    scores = [np.asarray(u, dtype=float) for u in unary]
    pairs = {key: np.asarray(theta, dtype=float) for key, theta in pairwise.items()}
    for j, u in enumerate(scores):
        if u.ndim != 1 or not len(u) or not (u < np.inf).all():
            raise ValueError(f"unary[{j}]: needs one number < inf per candidate, got shape {u.shape}")
    for (i, j), theta in pairs.items():
        if not 0 <= i < j < len(scores):
            raise ValueError(f"pairwise[{i}, {j}]: needs members i < j < {len(scores)}")
        shape = (len(scores[i]), len(scores[j]))
        if theta.shape != shape or not (theta < np.inf).all():
            raise ValueError(f"pairwise[{i}, {j}]: needs numbers < inf of shape {shape}, got shape {theta.shape}")
    return scores, pairs


def _exact(
    scores: list[Array], pairs: dict[tuple[int, int], Array]
) -> tuple[list[Array], dict[tuple[int, int], Array]]:
    """Tables rounded to a power of two so coarse that no sum of their entries is rounded, in whatever order."""
    tables = [*scores, *pairs.values()]
    largest = sum(float(np.abs(t[np.isfinite(t)]).max(initial=0.0)) for t in tables)
    _, exponent = np.frexp(largest)
    unit = float(np.ldexp(1.0, int(exponent) - 52))
    return [np.round(u / unit) * unit for u in scores], {key: np.round(t / unit) * unit for key, t in pairs.items()}
