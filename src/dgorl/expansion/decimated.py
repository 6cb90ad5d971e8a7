"""A cluster's graph with a pose every 5 s: a tenth of the work, nearly the same optima. METHOD §4.

Between two of its poses a trajectory keeps the shape that odometry gives it; readings hang on the pose before them.
Candidate graphs are compared here, and only the best, distinct ones go on to the whole graph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dgorl import se2
from dgorl.expansion.bodies import slopes
from dgorl.expansion.cluster_graph import ClusterGraph, Optima, cluster_graph
from dgorl.expansion.step import Step, internal_links
from dgorl.marginal import stretches
from dgorl.optimization import native
from dgorl.optimization.problem import DensePrior, Indices, Problem, RelativePoses, Scalars
from dgorl.radio import distances
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Component

SPACING = 10
"""Keyframes from one pose to the next."""

TOLERANCE, ITERATIONS = 1e-2, 20
"""Largest last step [m, rad], and most linear systems solved for one optimum."""

SMOOTHED = 100
"""The same for the one start of a large component."""


@dataclass(frozen=True)
class Decimated:
    """``graph``: the coarse one. Pose k of the whole graph is pose anchor[k] (N,) of it, times offset[k] (N, 3).

    convex: the same where no reading's pull fades, which leads from starts far off; its masses are not compared, as
    readings without line of sight would decide.
    """

    graph: ClusterGraph
    convex: ClusterGraph
    anchor: Indices
    offset: Array
    first: Indices
    """index in the whole graph of every coarse pose"""

    def coarse(self, poses: Array) -> Array:
        """Coarse poses (B, M, 3) of whole ones (B, N, 3)."""
        return poses[:, self.first]

    def whole(self, poses: Array) -> Array:
        """Whole poses (B, N, 3) of coarse ones (B, M, 3)."""
        return se2.compose(poses[:, self.anchor], self.offset)

    def optimize(self, starts: Array) -> Optima:
        """Optima of the convex coarse graph from whole starts (B, N, 3)."""
        return self.convex.optimize(self.coarse(starts), TOLERANCE, ITERATIONS)

    def improve(self, found: Optima) -> Optima:
        """Coarse optima taken further, each reading with the kernel it has."""
        return self.graph.optimize(found.poses, TOLERANCE, 2 * ITERATIONS)


def decimated(graph: ClusterGraph, poses: Array) -> Decimated:
    """The coarse graph of a cluster whose trajectories have the shapes of ``poses`` (N, 3)."""
    window = graph.window
    size = len(poses)
    anchor, keyframe = np.zeros(size, np.int64), np.zeros(size, np.int64)
    firsts: list[int] = []
    for start, first, count in window.layout.values():
        frames = np.arange(first, first + count)
        begins = np.flatnonzero((frames % SPACING == 0) | (np.arange(count) == 0))
        anchor[start : start + count] = len(firsts) + np.searchsorted(begins, np.arange(count), "right") - 1
        keyframe[start : start + count] = frames
        firsts += (start + begins).tolist()
    if window.world is not None:
        anchor[window.world] = len(firsts)
        firsts.append(window.world)
    first_of = np.array(firsts, np.int64)
    offset = se2.between(poses[first_of][anchor], poses)
    offset[first_of] = 0.0
    slots = np.where(window.problem.slots[first_of] < 0, -1, keyframe[first_of] // SPACING - window.base // SPACING)
    fixed = np.zeros(len(first_of), bool)
    fixed[anchor[np.flatnonzero(window.problem.fixed)]] = True
    p = window.problem
    variance = _since_anchor(p, anchor, first_of)
    problem = Problem(
        slots=slots,
        fixed=fixed,
        initial=poses[first_of],
        odometry=_odometry(p, anchor, first_of),
        scalars=tuple(_readings(_widened(s, variance, p.radio), anchor, offset) for s in p.scalars if len(s.i)),
        relative_poses=_relative(p.relative_poses, anchor, offset),
        priors=tuple(_prior(prior, anchor) for prior in p.priors if _stands(prior, first_of)),
        radio=p.radio,
    )
    convex = replace(problem, scalars=tuple(replace(s, loss=s.loss.convex) for s in problem.scalars))
    coarse, far = (
        replace(
            graph,
            window=replace(window, problem=p),
            graph=native.graph(p),
            body=graph.body[first_of],
            newest=anchor[graph.newest],
            soft=anchor[graph.soft],
        )
        for p in (problem, convex)
    )
    return Decimated(coarse, far, anchor, offset, first_of)


def smoothed(step: Step, component: Component) -> Component:
    """A large component at the optimum of its coarse graph: from there the whole one takes a third of the steps."""
    first = min(component.stretches[key].first for key in component.tracks)
    inside = internal_links(step, component, first / KEYFRAMES_PER_SECOND)
    unit = Component(component.stretches, component.priors, inside)
    graph = cluster_graph(step.history, unit, [tuple(unit.stretches)], first, step.g)
    start = graph.start(unit)
    coarse = decimated(graph, start)
    found = coarse.graph.optimize(coarse.coarse(start[None]), TOLERANCE, SMOOTHED)
    moved = coarse.whole(found.poses)[0]
    return Component(stretches(graph.window, moved, None), component.priors, component.links)


def _odometry(p: Problem, anchor: Indices, first_of: Indices) -> tuple[Indices, Indices, Array, Array]:
    """Odometry composed from one coarse pose to the next, with its covariance."""
    i, j, delta, information = p.odometry
    where = np.full(len(anchor), -1)
    where[i] = np.arange(len(i))
    ends = np.flatnonzero(anchor[i] != anchor[j])
    into = anchor[i[ends]]
    begin, count = first_of[into], i[ends] - first_of[into] + 1
    motion, covariance = np.zeros((len(ends), 3)), np.zeros((len(ends), 3, 3))
    noise = np.linalg.inv(information) if len(i) else np.zeros((0, 3, 3))
    for step in range(int(count.max(initial=0))):
        rows = np.flatnonzero(count > step)
        edge = where[begin[rows] + step]
        back = se2.adjoint(se2.inverse(delta[edge]))
        covariance[rows] = back @ covariance[rows] @ back.swapaxes(-1, -2) + noise[edge]
        motion[rows] = se2.compose(motion[rows], delta[edge])
    weight = np.linalg.inv(covariance) if len(ends) else np.zeros((0, 3, 3))
    return into, anchor[j[ends]], motion, (weight + weight.swapaxes(-1, -2)) / 2


def _since_anchor(p: Problem, anchor: Indices, first_of: Indices) -> Array:
    """Variance of every whole pose's position (N,) that odometry has gathered since the coarse one [m²]."""
    _, j, _, information = p.odometry
    gathered = np.zeros(len(anchor))
    if len(j):
        gathered[j] = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)[:, :2].mean(axis=1)
    total = np.cumsum(gathered)
    return np.asarray(total - total[first_of][anchor])


def _widened(s: Scalars, variance: Array, radio: tuple[float, float]) -> Scalars:
    """Readings whose σ includes what odometry has gathered since the coarse poses of both ends."""
    distance = s.value
    if s.kind == "rssi":
        distance = distances(s.value, *radio)
    slope = slopes(s.kind, distance, radio)
    return replace(s, sigma=np.sqrt(s.sigma**2 + slope**2 * (variance[s.i] + variance[s.j])))


def _readings(s: Scalars, anchor: Indices, offset: Array) -> Scalars:
    """Readings on coarse poses; without a robust kernel, those of one pair and half a spacing are averaged."""
    i, j = anchor[s.i], anchor[s.j]
    at_i, at_j = se2.compose(offset[s.i], s.at_i), se2.compose(offset[s.j], s.at_j)
    if s.kind == "bearing" or s.loss.kernel != "none":
        return Scalars(s.kind, i, j, at_i, at_j, s.height, s.value, s.sigma, s.loss)
    swap = (i > j)[:, None]
    a, b = np.where(swap[:, 0], j, i), np.where(swap[:, 0], i, j)
    values = np.concatenate(
        [np.where(swap, at_j, at_i), np.where(swap, at_i, at_j), s.height[:, None], s.value[:, None]], axis=1
    )
    half = np.floor(2 * (np.arange(len(offset)) - _starts(anchor)) / SPACING).astype(np.int64)
    code = (a * (len(offset) + 1) + b) * 4 + np.clip(half[np.where(swap[:, 0], s.j, s.i)], 0, 3)
    order = np.argsort(code, kind="stable")
    starts = np.flatnonzero(np.diff(code[order], prepend=-1))
    count = np.diff(starts, append=len(order))
    mean = np.add.reduceat(values[order], starts) / count[:, None]
    sigma = np.sqrt(np.add.reduceat(s.sigma[order] ** 2, starts)) / count
    head = order[starts]
    return Scalars(s.kind, a[head], b[head], mean[:, :3], mean[:, 3:6], mean[:, 6], mean[:, 7], sigma, s.loss)


def _starts(anchor: Indices) -> Indices:
    """Index of the first whole pose with the same anchor (N,)."""
    first = np.flatnonzero(np.diff(anchor, prepend=-1))
    return np.repeat(first, np.diff(first, append=len(anchor)))


def _relative(r: RelativePoses | None, anchor: Indices, offset: Array) -> RelativePoses | None:
    if r is None:
        return None
    at_i, at_j = se2.compose(offset[r.i], r.at_i), se2.compose(offset[r.j], r.at_j)
    return replace(r, i=anchor[r.i], j=anchor[r.j], at_i=at_i, at_j=at_j)


def _stands(prior: DensePrior, first_of: Indices) -> bool:
    """Whether a prior is on poses that the coarse graph has."""
    return bool(np.isin([prior.reference, *prior.members], first_of).all())


def _prior(prior: DensePrior, anchor: Indices) -> DensePrior:
    return replace(prior, reference=int(anchor[prior.reference]), members=anchor[prior.members])
