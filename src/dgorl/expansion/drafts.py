"""Candidate graphs: which places of all bodies go together. METHOD §4.

A draft is a place T (m, 3) of every body. Cold, the bodies linked to the reference get their candidates, A* finds
the best graphs of them, and bodies farther off are placed one after another. Warm, each body of a hypothesis in turn
is placed anew, given the others: conditional re-seeding.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import numpy as np

from dgorl import se2
from dgorl.expansion.bodies import Drift, Sightings
from dgorl.expansion.candidates import Candidates, candidates
from dgorl.expansion.cluster_graph import ClusterGraph, Optima
from dgorl.expansion.compatibility import compatibility
from dgorl.expansion.folds import anchored, other_side
from dgorl.expansion.search import best_graphs
from dgorl.se2 import Array

GRAPHS = 20
"""Candidate graphs that A* hands over."""

MODES = 3
"""Places tried for a body that is re-seeded."""


@dataclass(frozen=True)
class Shapes:
    """The bodies as rigid shapes: poses (N, 3) in their body's frame, sightings between all of them."""

    cluster: ClusterGraph
    poses: Array
    noise: Drift
    seed: tuple[int, ...]
    found: list[Sightings]

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
    """Shapes of poses (N, 3) and what they have seen of one another."""
    return Shapes(cluster, poses, noise, seed, cluster.sightings(cluster.body, poses, noise))


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
        (x, y): compatibility(shapes.found, (a, b), places[a], places[b], shapes.radio)
        for y, b in enumerate(members) for x, a in enumerate(members[:y])
    }  # fmt: skip
    drafts, scores = [], []
    for score, chosen in islice(best_graphs(unary, pairwise), GRAPHS):
        draft = np.zeros((shapes.size, 3))
        for j, c in zip(members, chosen, strict=True):
            draft[j] = places[j].poses[c]
        drafts.append(draft)
        scores.append(score)
    return complete(shapes, np.array(drafts), np.array(scores), [reference, *members], k)


def complete(shapes: Shapes, drafts: Array, scores: Array, placed: list[int], k: int) -> Array:
    """Drafts with the bodies not yet placed put where the others see them, each as often as it has places; best first.

    scores: (B,) log masses of the drafts so far.
    """
    placed = list(placed)
    waiting = [j for j in range(shapes.size) if j not in placed]
    while waiting:
        seen = {j: _links(shapes.found, j, placed) for j in waiting}
        j = max(waiting, key=lambda j: (seen[j], -j))
        waiting.remove(j)
        grown: list[tuple[float, Array]] = []
        for draft, score in zip(drafts[: max(GRAPHS // k, 1)], scores, strict=False):
            found = place(shapes, draft, placed, j, k)
            for pose, mass in zip(found.poses, found.mass.tolist(), strict=True):
                grown.append((score + mass, draft.copy()))
                grown[-1][1][j] = pose
        placed.append(j)
        if grown:
            grown.sort(key=lambda item: -item[0])
            scores, drafts = np.array([score for score, _ in grown]), np.array([draft for _, draft in grown])
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
    drafts: list[tuple[float, Array]] = []
    for j in range(shapes.size):
        others = [b for b in range(shapes.size) if b != j]
        found = place(shapes, here, others, j, MODES, other_side(shapes, j))
        for pose, mass in zip(found.poses, found.mass - found.mass[:1], strict=True):
            draft = here.copy()
            draft[j] = pose
            drafts.append((float(mass), anchored(draft)))
    drafts.sort(key=lambda item: -item[0])
    return np.array([draft for _, draft in drafts]).reshape(-1, shapes.size, 3)


def regrown(shapes: Shapes, placed: list[int]) -> Array:
    """Drafts (B, m, 3) in which all bodies but those placed stand elsewhere; shapes in one common frame."""
    if len(placed) < 2:
        return np.zeros((0, shapes.size, 3))
    found = complete(shapes, np.zeros((1, shapes.size, 3)), np.zeros(1), placed, MODES)
    return np.array([anchored(draft) for draft in found[:GRAPHS]]).reshape(-1, shapes.size, 3)


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
