"""Candidate graphs, best first: one candidate per member, scored by members and pairs of members. METHOD §4.

score = Σ_j U_j[a_j] + Σ_{i<j} θ_ij[a_i, a_j], log scores: higher is better, −inf is impossible. Of the k^(n−1)
graphs A* looks at few: it assigns member after member, and bounds what is left by the best each member could do.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from dgorl.se2 import Array

Pairwise = Mapping[tuple[int, int], Array]
Graph = tuple[float, tuple[int, ...]]


class BestGraphs(Iterator[Graph]):
    """(score, candidate of each member), best first, equal scores in order of the candidates; lazily by A*.

    unary: one (k_j,) per member, k_j ≥ 1. pairwise: (i, j) → (k_i, k_j), i < j; pairs left out score 0.
    Impossible graphs (−inf) are left out. Scores are rounded to 2⁻⁵² of the largest total, about 1e-9 for
    totals of a few millions; then sums are exact, and the order is that of :func:`brute_force`, ties included.
    Raises ValueError naming the table that is not one.
    """

    def __init__(self, unary: Sequence[Array], pairwise: Pairwise) -> None:
        self.expanded = 0
        """partial graphs expanded so far"""
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
        self._open: list[tuple[float, tuple[int, ...], float, Array]] = []
        if bound > -np.inf:
            self._open.append((-bound, (), 0.0, own))

    def __next__(self) -> Graph:
        while self._open:
            bound, chosen, score, own = heapq.heappop(self._open)
            if len(chosen) == len(self._sizes):
                return -bound, chosen
            self._expand(chosen, score, own)
        raise StopIteration

    def _expand(self, chosen: tuple[int, ...], score: float, own: Array) -> None:
        """Push the graphs with one member more; own (n − j, k): scores of the free ones with the chosen ones.

        The bound is consistent and exact for whole graphs, so they are popped in order. Equal bounds pop in order
        of ``chosen``, where a graph comes before its extensions.
        """
        self.expanded += 1
        j = len(chosen)
        scores = score + own[0]
        after = own[1:] + self._theta[j, :, j + 1 :]
        bounds = scores + (after + self._left[j + 1 :]).max(axis=2).sum(axis=1)
        for a in range(self._sizes[j]):
            if bounds[a] > -np.inf:
                heapq.heappush(self._open, (-float(bounds[a]), (*chosen, a), float(scores[a]), after[a]))


def best_graphs(unary: Sequence[Array], pairwise: Pairwise) -> BestGraphs:
    """Candidate graphs best first, see :class:`BestGraphs`; ``.expanded`` counts the work."""
    return BestGraphs(unary, pairwise)


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
