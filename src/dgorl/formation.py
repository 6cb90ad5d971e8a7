"""Formation, the paper's first stage (Alg. 1): who is in contact (RPMG), and which contacts can tell poses (ERPMG).

METHOD §3. RPMG: undirected, weighted by the range. ERPMG: its edges that satisfy the motion constraint; which that is
depends on what was measured: :func:`motion_constraint` where relative positions were (bearing and range, poses), the
rank of the window's bars (``dgorl.observability``) where only ranges were.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dgorl.history import History
from dgorl.measurements import WORLD
from dgorl.radio import rssi_to_range
from dgorl.se2 import Array
from dgorl.tracks import TrackKey

Node = TypeVar("Node", str, TrackKey)
"""What stands in a graph: robots or components by name, or tracks."""

UNWEIGHTED = 1.0
"""Weight of a contact of which no range is known [m]: positive, as a contact's has to be."""


class Contact(NamedTuple):
    """Readings between two tracks: how many, the first and last stamp [s], median range [m] if any tells one."""

    readings: int
    first: float
    last: float
    median_range: float | None


def contacts(
    history: History, low: float, high: float, since: Mapping[TrackKey, float] | None = None
) -> dict[tuple[TrackKey, TrackKey], Contact]:
    """Who measured whom with low ≤ stamp ≤ high [s], in both directions together, by pair in canonical order.

    Readings not placed on tracks do not count, nor do poses relative to the world, nor what is older than ``since`` of
    either track. RSSI counts as the range it most likely means: of a median, that is unbiased.
    """
    keys = sorted(history.numbers)
    rank = np.full(len(keys) + 1, -1)  # the last entry answers for rows without a track
    for order, key in enumerate(keys):
        rank[history.numbers[key]] = order
    begin = np.array([(since or {}).get(key, -np.inf) for key in keys] + [-np.inf])
    pairs, stamps, ranges = _poses(history, keys, low, high)
    for kind, table in history.tables.items():
        rows = table.between(low, high) if len(table) else None
        if rows is None or not len(rows.stamp):
            continue
        a, b = rank[rows.track_a], rank[rows.track_b]
        placed = (a >= 0) & (b >= 0) & (rows.stamp >= np.maximum(begin[a], begin[b]))
        pairs.append(np.where(placed, np.minimum(a, b) * len(keys) + np.maximum(a, b), -1))
        stamps.append(rows.stamp)
        match kind:
            case "rssi":
                ranges.append(rssi_to_range(rows.value, history.configuration.radio))
            case "range":
                ranges.append(rows.value)
            case _:
                ranges.append(np.full(len(rows.stamp), np.nan))
    if not pairs:
        return {}
    found = _by_pair(np.concatenate(pairs), np.concatenate(stamps), np.concatenate(ranges))
    return {(keys[pair // len(keys)], keys[pair % len(keys)]): contact for pair, contact in found}


def _poses(
    history: History, keys: list[TrackKey], low: float, high: float
) -> tuple[list[NDArray[np.int64]], list[Array], list[Array]]:
    """Measured relative poses and starts as rows: pair code, stamp, distance."""
    rows = []
    for pose in history.poses:
        if low <= pose.stamp <= high and pose.reference != WORLD:
            placed = history.placed(pose)
            if placed is not None:
                a, b = sorted(keys.index(key) for key in placed[:2])
                rows.append((a * len(keys) + b, pose.stamp, float(np.hypot(pose.x, pose.y))))
    if not rows:
        return [], [], []
    pairs, stamps, ranges = zip(*rows, strict=True)
    return [np.array(pairs)], [np.array(stamps)], [np.array(ranges)]


def _by_pair(pair: NDArray[np.int64], stamp: Array, distance: Array) -> list[tuple[int, Contact]]:
    """Count, first, last and median by pair code; negative codes and NaN distances do not count."""
    order = np.lexsort((distance, pair))  # NaN comes last within its pair
    order = order[int((pair < 0).sum()) :]
    if not len(order):
        return []
    pair, stamp, distance = pair[order], stamp[order], distance[order]
    start = np.flatnonzero(np.concatenate([[True], pair[1:] != pair[:-1]]))
    count = np.diff(np.concatenate([start, [len(pair)]]))
    told = np.add.reduceat(~np.isnan(distance), start)
    least, most = start + np.maximum(told - 1, 0) // 2, start + told // 2
    median = (distance[least] + distance[np.minimum(most, len(distance) - 1)]) / 2
    first, last = np.minimum.reduceat(stamp, start), np.maximum.reduceat(stamp, start)
    columns = (column.tolist() for column in (pair[start], count, first, last, told, median))
    return [(p, Contact(n, f, e, m if t else None)) for p, n, f, e, t, m in zip(*columns, strict=True)]


@dataclass(frozen=True, eq=False)
class Rpmg(Generic[Node]):
    """The paper's G = (V, E, A): nodes and edges (both sorted), one positive weight an edge [m].

    Rows of all matrices follow ``names`` and ``edges``.
    """

    names: tuple[Node, ...]
    edges: tuple[tuple[Node, Node], ...]
    weights: Array

    @classmethod
    def of(cls, names: Iterable[Node], weights: Mapping[tuple[Node, Node], float]) -> Rpmg[Node]:
        """From the weight of every unordered pair in contact.

        Raises ValueError for a pair given twice, of one node, of one not among ``names``, or not of positive weight.
        """
        known: set[Node] = set(names)
        found: dict[tuple[Node, Node], float] = {}
        for (a, b), weight in weights.items():
            edge = (a, b) if a < b else (b, a)
            if a == b or not {a, b} <= known or edge in found:
                raise ValueError(f"edge {a}–{b} must join two of the graph's nodes, once")
            if not weight > 0:
                raise ValueError(f"edge {a}–{b} must have a positive weight, got {weight}")
            found[edge] = weight
        return cls(
            tuple(sorted(known)), tuple(sorted(found)), np.array([found[edge] for edge in sorted(found)], dtype=float)
        )

    @cached_property
    def ends(self) -> NDArray[np.int64]:
        """Rows of each edge's two nodes among ``names``, (m, 2)."""
        row = {name: k for k, name in enumerate(self.names)}
        return np.array([(row[a], row[b]) for a, b in self.edges], dtype=np.int64).reshape(-1, 2)

    @cached_property
    def adjacency(self) -> Array:
        """A (n, n): a_ij = a_ji the weight, 0 without an edge."""
        adjacency = np.zeros((len(self.names), len(self.names)))
        i, j = self.ends.T
        adjacency[i, j] = adjacency[j, i] = self.weights
        return adjacency

    @property
    def degree(self) -> Array:
        """d(v_i) = Σ_j a_ij, (n,)."""
        return np.asarray(self.adjacency.sum(axis=1))

    @property
    def laplacian(self) -> Array:
        """L = D − A (n, n)."""
        return np.diag(self.degree) - self.adjacency

    @property
    def incidence(self) -> Array:
        """Signed, (m, n): −1 for an edge's first node, +1 for its second. METHOD §0."""
        incidence = np.zeros((len(self.edges), len(self.names)))
        rows = np.arange(len(self.edges))
        incidence[rows, self.ends[:, 0]], incidence[rows, self.ends[:, 1]] = -1.0, 1.0
        return incidence

    @cached_property
    def components(self) -> tuple[tuple[Node, ...], ...]:
        """The partition of the nodes into connected parts, everything sorted."""
        home = list(range(len(self.names)))
        for i, j in self.ends.tolist():
            old, new = sorted((home[i], home[j]), reverse=True)
            home = [new if part == old else part for part in home]
        return tuple(
            tuple(name for name, part in zip(self.names, home, strict=True) if part == k) for k in sorted(set(home))
        )


def rpmg(found: Mapping[tuple[Node, Node], Contact], names: Iterable[Node] = ()) -> Rpmg[Node]:
    """The RPMG of contacts, weighted by their median range; ``names`` adds nodes in no contact."""
    nodes: set[Node] = set(names)
    for pair in found:
        nodes.update(pair)
    weights = {pair: max(contact.median_range or UNWEIGHTED, 1e-9) for pair, contact in found.items()}
    graph: Rpmg[Node] = Rpmg.of(nodes, weights)
    return graph


def lemma_1(incidence: Array, components: int) -> bool:
    """Whether rank A(G) = n − λ for an incidence matrix (m, n) of a graph of λ components.

    Always true of the signed one. Of the paper's unsigned one it is not: a triangle has rank 3. METHOD §0.
    """
    m, n = incidence.shape
    rank = int(np.linalg.matrix_rank(incidence)) if m else 0
    return bool(rank == n - components)


def motion_constraint(velocity: ArrayLike, sigma: ArrayLike, factor: float = 3.0) -> NDArray[np.bool_]:
    """Alg. 1's J R_j V_j ≠ 0 of the observed robot, as far as noise lets one tell.

    J and R_j turn vectors in the plane and never make one vanish, so the constraint says that robot j moves
    horizontally: |V_j| > factor · σ. velocity: (..., 2) or (..., 3), of which the horizontal part counts, over an
    instant [m/s] or a window [m]; sigma: (...,) its standard deviation in the same unit.
    """
    v = np.asarray(velocity, dtype=float)
    return np.asarray(np.hypot(v[..., 0], v[..., 1]) > factor * np.asarray(sigma, dtype=float))


@dataclass(frozen=True, eq=False)
class Erpmg(Generic[Node]):
    """The paper's G_E: all nodes of the RPMG, its edges that satisfy the motion constraint, and the rank of each.

    ranks: (m,) of 1…3, how much of the three degrees of freedom between its ends an edge determines by itself.
    """

    graph: Rpmg[Node]
    ranks: NDArray[np.int64]


def erpmg(graph: Rpmg[Node], ranks: Mapping[tuple[Node, Node], int]) -> Erpmg[Node]:
    """Alg. 1: keep the edges of rank ≥ 1, named in sorted order; an edge that is not named is not kept.

    ranks: of an edge with ranges alone the rank of its W_e; of one with measured relative positions 3 where
    :func:`motion_constraint` holds of the robot observed, else 0: the paper drops it, though its position is known.
    """
    kept = [k for k, edge in enumerate(graph.edges) if ranks.get(edge, 0) >= 1]
    edges = tuple(graph.edges[k] for k in kept)
    values = np.array([ranks[edge] for edge in edges], dtype=np.int64)
    return Erpmg(Rpmg(graph.names, edges, graph.weights[kept]), values)
