"""Where a body may stand relative to another: particles, the region where the ranges meet, local fits. METHOD §4."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from dgorl import se2
from dgorl.expansion.bodies import Sightings, body_graph
from dgorl.optimization.problem import Indices
from dgorl.se2 import Array

BEARINGS, HEADINGS = 32, 24
"""Cold particles on the ring round an anchor reading."""

ANNULI, ANNULUS = 8, 3.0
"""The region of interest is where this many annuli d̂·e^(∓cs) meet, c."""

FITS = 24
"""Particles that are fitted."""

CELL = 0.15
"""Relative width that the grid of particles adds to an annulus."""

SAME = 3.0
"""Modes nearer than this Mahalanobis distance are one."""

HOPELESS = 20.0
"""Modes whose log mass is this much below the best are dropped."""

_QUANTILES = np.array([NormalDist().inv_cdf((k + 0.5) / 7) for k in (3, 1, 5, 0, 6, 2, 4)])


@dataclass(frozen=True)
class Candidates:
    """Distinct places of a body, best first: T_a_b (k, 3), log mass (k,), covariance (k, 3, 3) of right perturbations."""

    poses: Array
    mass: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.poses)


def candidates(
    found: list[Sightings], radio: tuple[float, float], pi: Array, k: int, rng: np.random.Generator, warm: Array
) -> Candidates:
    """At most k places T_a_b of body b (1) relative to body a (0) that the sightings between them allow.

    pi (3,): information of the weak prior on them. warm (W, 3): places known before, fitted anew besides.
    """
    graph = body_graph(found, 2, radio)
    anchors = _anchors(found)
    starts = [warm]
    if anchors:
        particles = np.concatenate([_cold(anchor, rng) for anchor in anchors])
        particles = particles[_inside(particles, found)]
        cost = body_graph(found, 2, radio, _inflation(found, anchors[-1])).costs(_starts(particles))
        starts.append(_diverse(particles, cost, anchors[-1][2]))
    start = np.concatenate(starts)
    if not len(start):
        return Candidates(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3, 3)))
    fitted = graph.optimize(_starts(start), max_iterations=25, step_tolerance=1e-3)
    logdet, covariance = graph.evidence(fitted.poses, [1], [1], pi[None])
    return distinct(Candidates(fitted.poses[:, 1], -fitted.cost - logdet / 2, covariance), k)


def distinct(modes: Candidates, k: int) -> Candidates:
    """At most k modes, best first, no two nearer than Mahalanobis distance 3 under the better one's H + Π."""
    order = np.argsort(-modes.mass, kind="stable")
    order = order[modes.mass[order] >= modes.mass[order[:1]] - HOPELESS]
    poses, covariance = modes.poses[order], modes.covariance[order]
    difference = se2.between(poses[:, None], poses[None])
    square = np.einsum("abi,aij,abj->ab", difference, np.linalg.inv(covariance), difference)
    keep = independent(square <= SAME**2, k)
    return Candidates(poses[keep], modes.mass[order[keep]], covariance[keep])


def independent(near: NDArray[np.bool_], limit: int) -> list[int]:
    """The first rows of ``near`` (M, M) of which none is near an earlier one, at most ``limit``."""
    keep: list[int] = []
    taken = np.zeros(len(near), bool)
    for m in range(len(near)):
        if len(keep) == limit:
            break
        if not taken[m]:
            keep.append(m)
            taken |= near[m]
    return keep


Anchor = tuple[Array, Array, float, float]
"""point on a (3,), point on b (3,), distance between them [m], its relative σ"""


def _anchors(found: list[Sightings]) -> list[Anchor]:
    """Two readings of distances, near the newest and in the middle; bearings alone have none."""
    rows = [(s, m) for s in found if s.kind != "bearing" for m in range(len(s.value))]
    if not rows:
        return []
    anchors = []
    for s, m in (rows[len(rows) // 2], rows[-1]) if len(rows) > 3 else rows[-1:]:
        a, b = (s.point_i[m], s.point_j[m]) if s.i[m] == 0 else (s.point_j[m], s.point_i[m])
        distance = max(float(s.distance[m]), 0.05)
        relative = float(s.sigma[m] / (s.slope[m] * distance))
        anchors.append((a, b, distance, min(relative, 1.0)))
    return anchors


def _cold(anchor: Anchor, rng: np.random.Generator) -> Array:
    """Particles T_a_b on the ring d̂·e^(sN) round the anchor, bearing and heading uniform, stratified."""
    a, b, distance, relative = anchor
    bearing, heading = np.meshgrid(np.arange(BEARINGS), np.arange(HEADINGS), indexing="ij")
    beta = 2 * np.pi * (bearing.ravel() + rng.uniform()) / BEARINGS
    theta = se2.wrap(2 * np.pi * (heading.ravel() + rng.uniform()) / HEADINGS)
    d = distance * np.exp(relative * _QUANTILES[(bearing + 3 * heading).ravel() % 7])
    c, s = np.cos(theta), np.sin(theta)
    x = a[0] + d * np.cos(beta) - (c * b[0] - s * b[1])
    y = a[1] + d * np.sin(beta) - (s * b[0] + c * b[1])
    return np.stack([x, y, theta], axis=-1)


def _inside(particles: Array, found: list[Sightings]) -> Indices:
    """The particles where most annuli meet: all that lie in every one, or those that miss the fewest."""
    ranged = [s for s in found if s.kind != "bearing"]
    step = max(sum(len(s.value) for s in ranged) // ANNULI, 1)
    hits = np.zeros(len(particles), np.int64)
    for s in ranged:
        m = np.arange(step // 2, len(s.value), step)
        first = (s.i[m] == 0)[:, None]
        a, b = np.where(first, s.point_i[m], s.point_j[m]), np.where(first, s.point_j[m], s.point_i[m])
        delta = se2.transform(particles[:, None], b[None, :, :2]) - a[:, :2]
        distance = np.sqrt(np.sum(delta**2, axis=2) + s.height[m] ** 2)
        known = np.maximum(s.distance[m], 0.05)
        relative = s.sigma[m] / (s.slope[m] * known) + CELL
        hits += np.sum(np.abs(np.log(np.maximum(distance, 1e-3) / known)) <= ANNULUS * relative, axis=1)
    order = np.argsort(-hits, kind="stable")
    return order[: max(int(np.sum(hits == hits.max())), len(particles) // 8)]


def _inflation(found: list[Sightings], anchor: Anchor) -> Array:
    """Half a cell of the grid of particles as a variance of each reading's range [m²]."""
    _, b, distance, _ = anchor
    parts = []
    for s in found:
        on_b = np.where((s.i == 0)[:, None], s.point_j, s.point_i)
        lever = np.sum((on_b[:, :2] - b[:2]) ** 2, axis=1)
        parts.append((0.06 * distance) ** 2 + 0.08**2 * lever)
    return np.concatenate(parts)


def _diverse(particles: Array, cost: Array, distance: float) -> Array:
    """The cheapest particles, none in the immediate neighbourhood of a cheaper one."""
    best = particles[np.argsort(cost, kind="stable")[: 8 * FITS]]
    apart = best[:, None] - best[None]
    near = np.sum(apart[..., :2] ** 2, axis=2) < (0.3 * distance) ** 2
    return best[independent(near & (np.abs(se2.wrap(apart[..., 2])) < 0.4), FITS)]


def _starts(poses: Array) -> Array:
    """Starts (B, 2, 3) of the graph of two bodies."""
    starts = np.zeros((len(poses), 2, 3))
    starts[:, 1] = poses
    return starts
