"""Does a robot still fit its team? Three tests of a settled window, for who was carried or whose readings lie.

METHOD §4, break. A robot that was carried shows as an odometry step the rest of the window contradicts: twice the cost
falls by T ~ χ²(3) when the step is left out, and T follows from the step's residual u, its covariance Q and its
posterior covariance C as uᵀ(Q − C)⁻¹u. Where robust kernels reject its readings instead, these no longer sum up as χ²
does, or do not since a moment (``contradictions``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from dgorl import se2
from dgorl.configuration import Kernel
from dgorl.contradictions import BEGINS, contradictions, readings, without_worst
from dgorl.graph import losses, residuals
from dgorl.marginal import TOLERANCE
from dgorl.optimization import native
from dgorl.optimization.problem import Indices, Loss, Problem
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Window

INTERVALS = (5.0, 10.0)
"""Between these ages of theirs [s] at the node, the odometry steps bent most are tested."""

BENT = 30.0
"""Who is placed anew has to fit without being bent over this last time [s], or since it is placed."""

TAIL = 1e-4
"""By chance, one node in this many finds somebody: it is shared among all that a node looks at."""

CLIP = 9.0
"""A reading's squared normalised residual counts at most this much."""

FEWEST = 3
"""Readings below which a robot's sum says nothing."""

NEAR = 0.25
"""From this share of its limit on T is computed from the cost itself."""

FREED, COARSE = 1e-9, 1e-3
"""Factor of the information of a step that is given up; the last step of the optimum without it [m, rad]."""

SAME_STEP = 2
"""Keyframes up to which two nodes mean the same step."""

PRECISION = float(np.finfo(float).eps)
"""Relative rounding error of one operation."""


FIRM: Mapping[str, Kernel] = {"cauchy": "huber", "cauchy_negative": "huber_negative"}
"""Kernels that redescend, and what stands for them where contradictions are looked for."""


@dataclass(frozen=True)
class Suspect:
    """A member that fits badly since keyframe ``since``; excess: of its statistic over the tail's, 1 at the limit.

    carried: by a step of its odometry, at ``since``, not by its readings.
    """

    key: TrackKey
    since: int
    excess: float
    carried: bool
    nodes: int = 1
    """for how many nodes in a row"""

    def after(self, before: Suspect | None) -> Suspect:
        """The same, at the node that follows ``before``; two different steps of its odometry are two stories."""
        if before is None or (self.carried and before.carried and abs(self.since - before.since) > SAME_STEP):
            return self
        since = self.since if self.carried else min(self.since, before.since)
        return replace(self, since=since, nodes=before.nodes + 1)


def chi2_limit(dof: float, tail: float = TAIL) -> float:
    """What χ² with ``dof`` degrees of freedom exceeds with probability ``tail`` (Wilson–Hilferty)."""
    spread = 2.0 / (9.0 * dof)
    return float(dof * (1.0 - spread + NormalDist().inv_cdf(1.0 - tail) * np.sqrt(spread)) ** 3)


def suspects(window: Window, poses: Array, g: float, before: Mapping[TrackKey, Suspect]) -> list[Suspect]:
    """The members that fit badly at node g [s], the worst first; poses (N, 3) are the window's optimum.

    before: those of the node before. Who is one of them is not picked out of many, and answers for this test alone.
    """
    steps = int(INTERVALS[-1] * KEYFRAMES_PER_SECOND)
    looks = len(window.layout) * (steps + BEGINS + 1)  # every step of all, every beginning, and every sum
    worst: dict[TrackKey, Suspect] = {}
    sums = (*_carried(window, poses, g, TAIL / looks), *_rejected(window, poses, g))
    tests = [
        *((*found, TAIL) for found in sums),
        *((*found, TAIL / BEGINS) for found in _contradicted(window, poses, g)),
    ]
    for found, dof, alone in tests:
        again = found.key in before and found.after(before[found.key]).nodes > 1
        found = replace(found, excess=found.excess / chi2_limit(dof, alone if again else TAIL / looks))
        if found.excess > max(worst[found.key].excess if found.key in worst else 1.0, 1.0):
            worst[found.key] = found
    return sorted(worst.values(), key=lambda s: (-s.excess, s.key))


def _firm(window: Window, poses: Array) -> tuple[Window, Array]:
    """The window with Huber's kernel where its own redescends, and its optimum near poses (N, 3).

    A kernel that redescends explains any contradiction away: what it rejects no longer pulls. Whether a robot
    fits is asked where every reading pulls.
    """
    firm = [replace(s, loss=Loss(FIRM.get(s.loss.kernel, s.loss.kernel), s.loss.width)) for s in window.problem.scalars]
    if all(a.loss == b.loss for a, b in zip(firm, window.problem.scalars, strict=True)):
        return window, poses
    problem = replace(window.problem, initial=poses, scalars=tuple(firm))
    try:
        found = native.solve(problem, np.zeros(0, np.int64), TOLERANCE)
    except ValueError:  # a pose is undetermined: the tests see what there is
        return window, poses
    return replace(window, problem=problem), found.poses


def unfit(window: Window, poses: Array, g: float, bodies: Sequence[tuple[TrackKey, ...]]) -> frozenset[TrackKey]:
    """Members of the bodies that no place of theirs explains, one body after another, without those before it.

    bodies: the members of each component, in itself settled: readings of the last 5 s between them count. Of two that
    do not fit one another, it is the smaller one. Besides, single tracks that fit only as they are bent.
    """
    return astray(*_firm(window, poses), g, bodies)


def astray(window: Window, poses: Array, g: float, bodies: Sequence[tuple[TrackKey, ...]]) -> frozenset[TrackKey]:
    """The same with the kernels that the window has."""
    return _bent(window, poses, g, bodies) | _misfits(window, poses, g, bodies)


def _misfits(window: Window, poses: Array, g: float, bodies: Sequence[tuple[TrackKey, ...]]) -> frozenset[TrackKey]:
    """Members of the bodies whose readings of the last 5 s are off."""
    body = np.array([next(k for k, keys in enumerate(bodies) if key in keys) for key in window.layout])
    i, j, square = recent_squares(window, poses, g)
    i, j = body[i], body[j]
    between = i != j
    tail = TAIL / len(bodies)
    gone: frozenset[TrackKey] = frozenset()
    while True:
        i, j, square = i[between], j[between], square[between]
        sums = [(k, without_worst(square[(i == k) | (j == k)])) for k in range(len(bodies))]
        excess = {k: total / chi2_limit(kept, tail) for k, (total, kept) in sums if kept >= FEWEST}
        worst = max(excess, key=lambda k: (excess[k], -len(bodies[k]), bodies[k]), default=None)
        if worst is None or excess[worst] <= 1.0:
            return gone
        gone |= set(bodies[worst])
        between = (i != worst) & (j != worst)


def _bent(window: Window, poses: Array, g: float, bodies: Sequence[tuple[TrackKey, ...]]) -> frozenset[TrackKey]:
    """Single tracks whose odometry of the last 30 s the readings bend more than its noise explains.

    A robot that is yet to be joined can have any place, so that odometry that is not its own, or not of this time, may
    fit for a while: bent all along, with no step that stands out.
    """
    i, j, delta, information = window.problem.odometry
    u = se2.between(delta, se2.between(poses[i], poses[j]))
    strain = np.zeros(len(poses))
    strain[i] = np.einsum("ka,kab,kb->k", u, information, u)
    tail = TAIL / len(bodies)
    since = int(np.floor((g - BENT) * KEYFRAMES_PER_SECOND))
    found = set()
    for key in (keys[0] for keys in bodies if len(keys) == 1 and keys[0] in window.layout):
        offset, first, count = window.layout[key]
        at = np.arange(offset + max(since - first, 0), offset + count - 1)
        excess = float(strain[at].sum()) / _spread(window, poses) if len(at) else 0.0
        if excess <= chi2_limit(1.0, tail):  # the least limit: covariances cost more
            continue
        if excess > chi2_limit(max(bend(window.problem, poses, at)[1], 1.0), tail):
            found.add(key)
    return frozenset(found)


def _carried(window: Window, poses: Array, g: float, tail: float) -> list[tuple[Suspect, int]]:
    """Odometry steps against the rest of the window, T as the excess, and its degrees of freedom.

    T is by how much the cost falls if the kernels' weights stay. A carry that no reading tells the moment of has those
    near it rejected, which come back without the step: where T comes near to its limit the cost is fetched itself.
    """
    rows = _strained(window, poses, int(np.floor(g * KEYFRAMES_PER_SECOND)))
    if len(window.layout) < 2 or not rows:
        return []
    problem, spread = window.problem, _spread(window, poses)
    t, dof = drop(problem, poses, np.array([index for _, _, index in rows]))
    found = []
    for (key, keyframe, index), excess, n in zip(rows, t / spread, dof, strict=True):
        if n and NEAR < excess / chi2_limit(int(n), tail) <= 1.0:
            excess = max(excess, _fall(problem, poses, index) / spread)
        if n:
            found.append((Suspect(key, keyframe, float(excess), True), int(n)))
    return found


def _fall(problem: Problem, poses: Array, at: int) -> float:
    """By how much 2 × cost falls without the odometry step from pose ``at`` to the next, downhill from ``poses``.

    A reading counts at most CLIP: a step that only one or two readings contradict is believed.
    """
    begin, end, delta, information = problem.odometry
    freed = information.copy()
    freed[np.searchsorted(begin, at)] *= FREED
    costs = []
    for weight in (information, freed):
        given = replace(problem, initial=poses, odometry=(begin, end, delta, weight))
        found = native.solve(given, np.zeros(0, np.int64), COARSE)
        cost = [losses(residuals(problem, s, found.poses), s.loss) for s in problem.scalars]
        costs.append(2 * found.cost - sum(float(np.maximum(c - CLIP, 0.0).sum()) for c in cost))
    return costs[0] - costs[1]


def _spread(window: Window, poses: Array) -> float:
    """How much more the readings pull than their σ says: Huber's E[ψ²] ÷ E[w]², 1 where none is an outlier.

    Outliers that a kernel tames still pull, each at most as its width; a step bent by many is no sign of a break.
    """
    found = list(readings(window, poses))
    if not found:
        return 1.0
    weight = np.concatenate([r.weight for r in found])
    pull = weight * np.concatenate([r.residual for r in found])
    tamed = weight < 1
    return max(float(np.mean(pull**2) / np.mean(weight) ** 2), 1.0) if tamed.any() else 1.0


def _strained(window: Window, poses: Array, now: int) -> list[tuple[TrackKey, int, int]]:
    """Each track's odometry step that the window bends most, in each interval: track, keyframe, index of its pose."""
    i, j, delta, information = window.problem.odometry
    u = se2.between(delta, se2.between(poses[i], poses[j]))
    strain = np.full(len(poses), -np.inf)
    strain[i] = np.einsum("ka,kab,kb->k", u, information, u)
    rows = []
    for key, (offset, first, count) in window.layout.items():
        until = now
        for back in INTERVALS:
            since, begin = now - int(back * KEYFRAMES_PER_SECOND), max(first, window.base + 1)
            oldest, end = max(since, begin), min(until, first + count - 1)
            if oldest < end:
                keyframe = oldest + int(np.argmax(strain[offset + oldest - first : offset + end - first]))
                rows.append((key, keyframe, offset + keyframe - first))
            until = since
    return rows


def drop(problem: Problem, poses: Array, at: Indices) -> tuple[Array, NDArray[np.int64]]:
    """T = uᵀ(Q − C)⁻¹u (K,) ~ χ²(k): by how much 2 × cost falls without the odometry step from pose at[k] to the next.

    poses (N, 3): the optimum. Also k (K,): in how many directions the rest of the problem determines the step.
    """
    share, part, inexact = _freedom(problem, poses, at)
    told = share > inexact[:, None]
    return np.sum(part**2 / np.where(told, share, np.inf), axis=1), told.sum(axis=1)


def bend(problem: Problem, poses: Array, at: Indices) -> tuple[float, float]:
    """S = Σ uᵀQ⁻¹u of the odometry steps from poses at[k] to the next, and its expectation, the sum of their shares.

    It is a sum of χ²(1), each times a share of at most 1, and thus seldomer large than χ² of as many degrees.
    """
    share, part, _ = _freedom(problem, poses, at)
    return float(np.sum(part**2)), float(share.sum())


def _freedom(problem: Problem, poses: Array, at: Indices) -> tuple[Array, Array, Array]:
    """Of each odometry step the eigenvalues of I − C (K, 3), its residual along their vectors (K, 3), their error (K,).

    All in units of Q: an eigenvalue is the share of what is known in that direction that is not the step's own.
    """
    begin, _, delta, information = problem.odometry
    step = np.searchsorted(begin, at)  # every pose but a track's last begins one step, in order
    count = len(at)
    joint = native.covariance(problem, poses, np.concatenate([at, at + 1])).reshape(2 * count, 3, 2 * count, 3)
    k = np.arange(count)
    motion = se2.between(poses[at], poses[at + 1])
    u = se2.between(delta[step], motion)
    # u and Q are in the frame that odometry reports, covariances in the estimated one, which u turns against it.
    turn = np.zeros((count, 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = se2.rotation(u[:, 2]), 1.0
    root = np.linalg.cholesky(np.linalg.inv(information[step]))
    ahead = np.linalg.solve(root, turn)
    back = ahead @ se2.adjoint(se2.inverse(motion))
    first = back @ joint[k, :, k] @ back.swapaxes(1, 2)
    second = ahead @ joint[k + count, :, k + count] @ ahead.swapaxes(1, 2)
    cross = ahead @ joint[k + count, :, k] @ back.swapaxes(1, 2)
    left = np.eye(3) - (first + second - cross - cross.swapaxes(1, 2))
    share, vectors = np.linalg.eigh((left + left.swapaxes(1, 2)) / 2)
    part = (vectors.swapaxes(1, 2) @ np.linalg.solve(root, u[..., None]))[..., 0]
    return share, part, _inexact(first, second, root, len(poses))


def _inexact(first: Array, second: Array, root: Array, size: int) -> Array:
    """Up to which eigenvalue of I − C (K,) a direction is not told from one the rest says nothing of.

    All in units of Q = root · rootᵀ (K, 3, 3), where an eigenvalue λ is the rest's share of what is known. C is a
    difference of the variances κ of the step's two ends, first and second, from a Cholesky factorisation of ``size``
    poses: it is exact to ε · size · κ (measured against extended precision: to a fiftieth of that). And the optimum
    is exact to a step of TOLERANCE, δ in these units, which makes an error of δ²/λ in T: λ has to exceed δ² too. There
    is no error of linearisation to add: u is linear in the motion's own perturbation.
    """
    kappa = np.maximum(np.trace(first, axis1=1, axis2=2), np.trace(second, axis1=1, axis2=2))
    delta = TOLERANCE / np.linalg.svd(root, compute_uv=False)[:, -1]
    return np.asarray(np.maximum(PRECISION * size * kappa, delta**2))


def _rejected(window: Window, poses: Array, g: float) -> list[tuple[Suspect, int]]:
    """Every member's sum of clipped squared residuals of the last 5 s without its worst third, and of how many."""
    i, j, square = recent_squares(window, poses, g)
    keyframe = int(np.floor((g - INTERVALS[0]) * KEYFRAMES_PER_SECOND))
    found = []
    for k, key in enumerate(window.layout):
        total, kept = without_worst(np.concatenate([square[i == k], square[j == k]]))
        if kept >= FEWEST:
            found.append((Suspect(key, keyframe, total, False), kept))
    return found


def _contradicted(window: Window, poses: Array, g: float) -> list[tuple[Suspect, int]]:
    """Every member's readings since each moment of the last 10 s."""
    return [(Suspect(c.key, c.since, c.total, False), c.dof) for c in contradictions(window, poses, g)]


def recent_squares(window: Window, poses: Array, g: float) -> tuple[Indices, Indices, Array]:
    """Both members' numbers and the clipped squared residual of every reading of the last 5 s."""
    ends: tuple[list[Indices], list[Indices]] = ([np.zeros(0, np.int64)], [np.zeros(0, np.int64)])
    square = [np.zeros(0)]
    for found in readings(window, poses):
        first = int(np.searchsorted(found.stamp, g - INTERVALS[0], "right"))
        for column, end in zip(ends, found.ends, strict=True):
            column.append(end[first:])
        square.append(np.minimum(found.residual[first:] ** 2, CLIP))
    return np.concatenate(ends[0]), np.concatenate(ends[1]), np.concatenate(square)
