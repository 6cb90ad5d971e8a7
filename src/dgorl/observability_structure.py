"""T0: what the graph's structure alone says of observability, by packing spanning trees. METHOD §3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Structure:
    """What the graph's ranks alone say: ``rigid`` for sure, ``generic`` (unless the geometry is special) or not."""

    rigid: bool
    generic: bool


def structure(nodes: int, ranks: Mapping[tuple[int, int], int]) -> Structure:
    """T0: a spanning tree of edges of rank 3 is enough; else three edge-disjoint spanning trees are needed.

    ranks: of the edges between nodes 0…nodes−1; an edge counts for at most its rank in trees, each in another one.
    Failing is final, passing only generic (body-and-bar frameworks: Tay).
    """
    rigid = _forest_size(nodes, [edge for edge, rank in ranks.items() if rank >= 3]) == nodes - 1
    copies = [edge for edge, rank in sorted(ranks.items()) for _ in range(min(rank, 3))]
    return Structure(rigid, rigid or spanning_trees(nodes, copies, 3))


def spanning_trees(nodes: int, edges: Sequence[tuple[int, int]], count: int) -> bool:
    """Whether ``count`` edge-disjoint spanning trees fit into a multigraph: exact, by matroid partition.

    Forests grow by one edge at a time along shortest exchange sequences (Edmonds; Roskind and Tarjan).
    """
    need = count * (nodes - 1)
    if len(edges) < need:
        return False
    forests: list[set[int]] = [set() for _ in range(count)]
    packed = sum(_augment(edges, forests, edge) for edge in range(len(edges)))
    return packed == need


def _augment(edges: Sequence[tuple[int, int]], forests: list[set[int]], new: int) -> bool:
    """Add an edge, moving others between forests if need be; False when no such exchange exists."""
    came: dict[int, tuple[int, int]] = {new: (-1, -1)}
    queue = [new]
    for edge in queue:
        for k, forest in enumerate(forests):
            if edge in forest:
                continue
            path = _path(edges, forest, *edges[edge])
            if path is None:
                while edge >= 0:  # edge enters forest k, what it replaces enters the forest it came from, …
                    source, home = came[edge]
                    forests[k].add(edge)
                    if source >= 0:
                        forests[home].remove(edge)
                    edge, k = source, home
                return True
            for other in path:
                if other not in came:
                    came[other] = (edge, k)
                    queue.append(other)
    return False


def _path(edges: Sequence[tuple[int, int]], forest: set[int], start: int, goal: int) -> list[int] | None:
    """Edges of the forest's path between two nodes, None if it does not join them."""
    near: dict[int, list[tuple[int, int]]] = {}
    for edge in forest:
        a, b = edges[edge]
        near.setdefault(a, []).append((edge, b))
        near.setdefault(b, []).append((edge, a))
    reached: dict[int, tuple[int, int]] = {start: (-1, -1)}
    queue = [start]
    for node in queue:
        if node == goal:
            path = []
            while node != start:
                edge, node = reached[node]
                path.append(edge)
            return path
        for edge, other in near.get(node, ()):
            if other not in reached:
                reached[other] = (edge, node)
                queue.append(other)
    return None


def _forest_size(nodes: int, edges: Sequence[tuple[int, int]]) -> int:
    """Edges of a spanning forest."""
    home = list(range(nodes))
    for a, b in edges:
        home = [home[a] if part == home[b] else part for part in home]
    return nodes - len(set(home))
