"""Candidate graphs: which places of all bodies go together. METHOD §4.

A draft is a place T (m, 3) of every body. Cold, the bodies linked to the reference get their candidates, A* finds
the best graphs of them, and bodies farther off are placed one after another. Warm, each body of a hypothesis in turn
is placed anew, given the others: conditional re-seeding.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from dgorl import _core, se2
from dgorl.expansion.bodies import Drift, Sightings, body_graph
from dgorl.expansion.candidates import Candidates, candidates
from dgorl.expansion.cluster_graph import ClusterGraph, Optima
from dgorl.expansion.apart import apart
from dgorl.expansion.compatibility import compatibility
from dgorl.expansion.search import best_graphs
from dgorl.optimization.problem import Indices
from dgorl.se2 import Array

GRAPHS = 60
"""Candidate graphs that A* hands over to be fitted coarsely."""

MODES = 4
"""Places tried for a body that is re-seeded."""

COMPARED = 60
"""Drafts that are compared with one another."""

BEHIND = 40.0
"""Drafts whose coarse log mass is this much below the best are not worth a full optimisation."""


@dataclass(frozen=True)
class Shapes:
    """The bodies as rigid shapes: poses (N, 3) in their body's frame, sightings between all of them."""

    cluster: ClusterGraph
    poses: Array
    noise: Drift
    seed: tuple[int, ...]
    found: list[Sightings] = field(default_factory=list)
    graph: _core.Graph | None = None

    @property
    def radio(self) -> tuple[float, float]:
        return self.cluster.window.problem.radio

    @property
    def size(self) -> int:
        return len(self.cluster.bodies)

    def starts(self, drafts: Array) -> Array:
        """Starts (B, N, 3) of the window graph from drafts (B, m, 3)."""
        world = self.cluster.window.world
        if world is not None:  # the world stays where it is
            own = drafts[:, self.cluster.body[world]][:, None]
            drafts = se2.between(np.broadcast_to(own, drafts.shape), drafts)
        return se2.compose(drafts[:, self.cluster.body], self.poses[None])


def shapes_of(cluster: ClusterGraph, poses: Array, noise: Drift, seed: tuple[int, ...]) -> Shapes:
    """Shapes of poses (N, 3), with the graph that fits their places."""
    found = cluster.sightings(cluster.body, poses, noise)
    graph = body_graph(found, len(cluster.bodies), cluster.window.problem.radio)
    return Shapes(cluster, poses, noise, seed, found, graph)


def cold(shapes: Shapes, k: int) -> Array:
    """Drafts (B, m, 3) from nothing, best first, without those that lead to the ``known`` ones (K, m, 3)."""
    linked = np.zeros((shapes.size, shapes.size), bool)
    for s in shapes.found:
        linked[s.i, s.j] = linked[s.j, s.i] = True
    best = np.flatnonzero(linked.sum(axis=1) == linked.sum(axis=1).max())
    reference = int(best[shapes.seed[-1] % len(best)])
    members = [j for j in range(shapes.size) if linked[reference, j]]
    places = {j: place(shapes, np.zeros((shapes.size, 3)), [reference], j, k) for j in members}
    members = [j for j in members if len(places[j])]
    unary = [places[j].mass for j in members]
    pairwise = {
        (a, b): compatibility(shapes.found, (members[a], members[b]), places[members[a]], places[members[b]], shapes.radio)
        for b in range(len(members)) for a in range(b)
    }  # fmt: skip
    drafts = []
    for _, chosen in islice(best_graphs(unary, pairwise), GRAPHS):
        draft = np.zeros((shapes.size, 3))
        for j, c in zip(members, chosen, strict=True):
            draft[j] = places[j].poses[c]
        drafts.append(draft)
    return complete(shapes, np.array(drafts), [reference, *members], k)


def complete(shapes: Shapes, drafts: Array, placed: list[int], k: int) -> Array:
    """Drafts with the bodies not yet placed put where the others see them, each as often as it has places."""
    placed = list(placed)
    waiting = [j for j in range(shapes.size) if j not in placed]
    drafts = fitted(shapes, drafts, placed) if len(placed) > 1 else drafts
    while waiting:
        seen = {j: _links(shapes.found, j, placed) for j in waiting}
        j = max(waiting, key=lambda j: (seen[j], -j))
        waiting.remove(j)
        grown = []
        for draft in drafts[: max(GRAPHS // k, 1)]:
            for pose in place(shapes, draft, placed, j, k).poses:
                grown.append(draft.copy())
                grown[-1][j] = pose
        placed.append(j)
        if grown:
            drafts = fitted(shapes, np.array(grown), placed)
    return drafts


def _links(found: Iterable[Sightings], j: int, placed: list[int]) -> int:
    return sum(
        int(np.sum(np.isin(s.i, placed) & (s.j == j)) + np.sum(np.isin(s.j, placed) & (s.i == j))) for s in found
    )


def place(shapes: Shapes, draft: Array, placed: list[int], j: int, k: int, warm: Array | None = None) -> Candidates:
    """Where body j may stand given the places of others in ``draft`` (m, 3)."""
    role = np.full(shapes.size, -1)
    role[placed] = 0
    role[j] = 1
    at = draft.copy()
    at[j] = 0.0
    poses = se2.compose(at[shapes.cluster.body], shapes.poses)
    found = shapes.cluster.sightings(role[shapes.cluster.body], poses, shapes.noise)
    rng = np.random.default_rng([*shapes.seed, j])
    return candidates(found, shapes.radio, shapes.cluster.pi, k, rng, np.zeros((0, 3)) if warm is None else warm)


def reseeded(shapes: Shapes) -> Array:
    """Drafts (B, m, 3) in which one body at a time stands elsewhere, given the others; shapes in one common frame."""
    here = np.zeros((shapes.size, 3))
    drafts = [here]
    for j in range(shapes.size):
        others = [b for b in range(shapes.size) if b != j]
        for pose in place(shapes, here, others, j, MODES).poses:
            draft = here.copy()
            draft[j] = pose
            if j == 0:  # body 0 is the gauge: the others move instead
                draft = se2.between(np.broadcast_to(pose, draft.shape), here)
                draft[0] = 0.0
            drafts.append(draft)
    return fitted(shapes, np.array(drafts), list(range(shapes.size)), known=1)


def warm(shapes: Shapes, best: Optima, count: int) -> Array:
    """Drafts (count, m, 3) near a hypothesis, whose shapes these are: drawn from its covariance, twice as wide."""
    cluster = shapes.cluster
    rng = np.random.default_rng([*shapes.seed, shapes.size])
    rows = [int(np.argmax(cluster.body[cluster.newest] == b)) for b in range(shapes.size)]
    pick = (3 * np.array(rows)[:, None] + np.arange(3)).ravel()
    values, vectors = np.linalg.eigh(best.covariance[0][np.ix_(pick, pick)])
    draws = rng.normal(size=(count, len(pick))) * 2.0 * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    newest = best.poses[0][cluster.newest[rows]]
    moved = se2.compose(newest, draws.reshape(count, shapes.size, 3))
    at = se2.compose(moved, se2.inverse(newest))
    return se2.between(at[:, :1], at)


def mirrored(shapes: Shapes) -> Array:
    """The draft (1, m, 3) of a hypothesis' mirror image, as well as bodies that are not mirrored can make it.

    Ranges tell a team from its mirror image by the curves of its paths alone: straight paths by nothing. METHOD §3.
    """
    middle, angle = np.zeros((shapes.size, 2)), np.zeros(shapes.size)
    for b in range(shapes.size):
        path = shapes.poses[shapes.cluster.body == b]
        middle[b] = path[:, :2].mean(axis=0)
        axis = np.linalg.svd(path[:, :2] - middle[b], full_matrices=False)[2][0]
        heading = np.array([np.cos(path[:, 2]).mean(), np.sin(path[:, 2]).mean()])
        angle[b] = np.arctan2(axis[1], axis[0]) + (np.pi if axis @ heading < 0 else 0.0)
    turn = se2.rotation(angle[0])
    image = (middle - middle[0]) @ turn * np.array([1.0, -1.0]) @ turn.T + middle[0]
    theta = se2.wrap(2 * (angle[0] - angle))
    moved = image - np.einsum("bij,bj->bi", se2.rotation(theta), middle)
    return np.column_stack([moved, theta])[None]


def fitted(shapes: Shapes, drafts: Array, placed: list[int], known: int = 0) -> Array:
    """Drafts improved coarsely, distinct ones alone, best first; bodies not placed stay where they are.

    What the first ``known`` drafts lead to is left out.
    """
    role = np.full(shapes.size, -1)
    role[placed] = np.arange(len(placed))
    graph = shapes.graph
    if len(placed) < shapes.size or graph is None:
        graph = body_graph([_among(s, role) for s in shapes.found], len(placed), shapes.radio)
    found = graph.optimize(drafts[:, placed], max_iterations=25, step_tolerance=1e-3)
    free = np.arange(1, len(placed))
    logdet, covariance = graph.evidence(found.poses, free, free, np.tile(shapes.cluster.pi, (len(free), 1)))
    mass = -np.asarray(found.cost) - logdet / 2
    order = np.argsort(-mass[known:], kind="stable") + known
    order = order[mass[order] >= np.max(mass) - BEHIND][:COMPARED]
    keep = apart(found.poses[:, 1:], covariance, np.arange(known), order, len(order))
    better = drafts[keep].copy()
    better[:, placed] = found.poses[keep]
    return better


def _among(s: Sightings, role: Indices) -> Sightings:
    return s.renumbered(role[s.i], role[s.j], (role[s.i] >= 0) & (role[s.j] >= 0))
