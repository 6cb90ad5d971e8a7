"""T2, ``excited``: what a window's measurements alone tell of relative poses, noise accounted for. METHOD §3.

S is the Fisher information of the newest poses, odometry the only structure between them: no prior, no known start.
Poses known by noisy odometry make it too large, for noise bends trajectories as if they were driven. So bend them once
more, by odometry noise drawn anew: what that adds is what the noise had added already, about. Lengths are in median
ranges, so that teams near and far compare.

What blunt readings say of a weak motion is spread over the whole window, where the slow drift of odometry bends most.
Whether a motion was *driven* shows in its quick turns, which stand out of the noise. ``margin`` therefore looks at it
as if readings were as sharp as a step of odometry, where the Schur complement discounts drift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dgorl import _core, se2
from dgorl.observability import Bars, bars, median
from dgorl.optimization import native
from dgorl.optimization.problem import Indices, Loss, Problem, RelativePoses
from dgorl.se2 import Array

RESAMPLES = 6
"""How often the odometry is drawn anew."""

FLOOR = 1e-4
"""Information below this counts as none: σ of a hundred median ranges."""

ROUNDING = 1e-10
"""Information below this share of the largest is rounding."""

STIFF = 1e6
"""Information of a link that only carries a pose on to the window's end [1/m², 1/rad²]; no reading is sharper."""


@dataclass(frozen=True)
class Weakness:
    """A motion of the team its measurements do not resolve.

    information: along it, debiased, ≤ 0 where noise explains all there is. motion: (3,) a robot, along x and y of its
    own current body frame [``scale``] and heading [rad], of unit norm together; the reference stands still.
    """

    information: float
    motion: Mapping[str, Array]

    @property
    def robots(self) -> tuple[str, ...]:
        """Who takes part in it, most first."""
        size = {name: float(np.linalg.norm(v)) for name, v in self.motion.items()}
        taking = [name for name in size if size[name] >= 0.3 * max(size.values())]
        return tuple(sorted(taking, key=lambda name: (-round(size[name], 6), name)))


@dataclass(frozen=True)
class Excitation:
    """Whether the measurements of a window alone determine the relative poses of a team.

    information: S_bc (3(n−1), 3(n−1)) of the others' poses seen from ``names[0]``, right perturbations, lengths in
    ``scale`` [m], the median range. smallest: λ_min(S_bc), 1 for σ of a median range and a radian. margin: λ_min of
    S_bc relative to the mean S of the resamplings, both with readings as sharp as a step of odometry: below 1, the
    share of the weakest information that is no artefact. It asks whether the motion was driven, ``smallest`` what the
    measurements make of it: their signs can differ.
    """

    names: tuple[str, ...]
    information: Array
    scale: float
    smallest: float
    margin: float
    weak: tuple[Weakness, ...]

    @property
    def excited(self) -> bool:
        """λ_min(S_bc) > 0."""
        return self.smallest > FLOOR


def excited(
    problem: Problem,
    poses: Array,
    current: Indices,
    names: Sequence[str],
    *,
    seed: int | Sequence[int] = 0,
    resamples: int = RESAMPLES,
) -> Excitation:
    """T2: λ_min of S_bc = 2 S(X̂) − mean_m S(X̂^(m)), and the motions that are weak.

    poses: (N, 3) the window's solution X̂. current: (n,) each robot's newest pose in it; the first is the reference.
    names: (n,) of the robots. seed: of the resampled odometry; the same gives the same result. Priors and what refers
    to the world are left out, kernels as well: these weigh by residuals, which resampling changes.
    """
    current = np.asarray(current, dtype=np.int64)
    free = measured(problem)
    count = 3 * (len(current) - 1)
    if count <= 0:
        return Excitation(tuple(names), np.zeros((0, 0)), 1.0, np.inf, 1.0, ())
    ranges = bars(free, poses, current)
    units = np.tile([ranges.scale, ranges.scale, 1.0], len(current) - 1)
    heads = Heads(free, current), Heads(free, current, sharper(free, ranges))
    chains = Chains(free, poses, current, np.random.default_rng(seed))
    drawn = [chains.draw() for _ in range(resamples)]
    (debiased, _), (sharp, noisy) = (_debiased(head, poses, drawn, np.outer(units, units)) for head in heads)
    values, vectors = np.linalg.eigh(debiased)
    total, axes = np.linalg.eigh(noisy)
    unit = axes / np.sqrt(np.maximum(total, 0.0) + FLOOR + ROUNDING * total[-1])
    margin = float(np.linalg.eigvalsh(unit.T @ sharp @ unit)[0])
    weak = tuple(
        Weakness(float(values[k]), dict(zip(names[1:], vectors[:, k].reshape(-1, 3), strict=True)))
        for k in range(count)
        if values[k] <= FLOOR
    )
    return Excitation(tuple(names), debiased, ranges.scale, float(values[0]), margin, weak)


def _debiased(head: Heads, poses: Array, drawn: Sequence[Array], units: Array) -> tuple[Array, Array]:
    """S_bc, and the mean S of the trajectories drawn."""
    mean = np.mean([head.information(x) for x in drawn], axis=0)
    return (2 * head.information(poses) - mean) * units, mean * units


def sharper(problem: Problem, ranges: Bars) -> float:
    """How many times more a range as sharp as a step of odometry would tell than the median one; at least once."""
    if not len(ranges.i) or not len(problem.odometry[0]):
        return 1.0
    steps = np.linalg.inv(problem.odometry[3])[:, :2, :2].trace(axis1=1, axis2=2) / 2
    sharp = min(1.0 / median(steps), STIFF)
    return max(1.0, sharp / median(ranges.weight))


def measured(problem: Problem) -> Problem:
    """The problem without priors, the world and kernels: odometry and what robots measured of one another."""
    poses = problem.relative_poses
    if poses is not None:
        on = (problem.slots[poses.i] >= 0) & (problem.slots[poses.j] >= 0)
        at_i, at_j = poses.at_i[on], poses.at_j[on]
        poses = RelativePoses(poses.i[on], poses.j[on], at_i, at_j, poses.delta[on], poses.information[on])
    scalars = tuple(replace(s, loss=Loss()) for s in problem.scalars if len(s.i))
    return replace(problem, scalars=scalars, relative_poses=poses, priors=())


class Heads:
    """Every robot's newest pose carried on, unchanged, to a slot after the window, where the Schur complement ends.

    sharper: counts what was measured as this many times the information. S scales with all there is, so that blunting
    odometry instead serves every sensor.
    """

    def __init__(self, problem: Problem, current: Indices, sharper: float = 1.0) -> None:
        i, j, _, information = problem.odometry
        self._sharper = sharper
        slot = problem.slots[current]
        end = int(slot.max()) + 1
        self._problem, size = problem, len(problem.slots)
        slots, links = [problem.slots], []
        copied: list[int] = []
        last = np.array(current)
        for step in range(int(slot.min()) + 1, end + 1):  # poses are numbered by slot, the heads come last
            late = np.flatnonzero(slot < step)
            fresh = size + len(copied) + np.arange(len(late))
            links.append(np.stack([last[late], fresh]))
            slots.append(np.full(len(late), step))
            copied.extend(current[late].tolist())
            last[late] = fresh
        self._copied, self._end = np.array(copied), end
        extra = np.concatenate(links, axis=1)
        self._slots, self._fixed = np.concatenate(slots), np.zeros(size + len(copied), dtype=bool)
        self._fixed[:size] = problem.slots < 0
        self._i, self._j = np.concatenate([i, extra[0]]), np.concatenate([j, extra[1]])
        stiff = np.broadcast_to(STIFF * np.eye(3), (extra.shape[1], 3, 3))
        self._information = np.concatenate([information, stiff]) / sharper

    def information(self, poses: Array) -> Array:
        """S (3(n−1), 3(n−1)) at poses (N, 3): of all robots but the first, which is held still."""
        at = np.concatenate([poses, poses[self._copied]])
        delta = se2.between(at[self._i], at[self._j])  # linearised where odometry fits
        problem = replace(
            self._problem,
            slots=self._slots,
            fixed=self._fixed,
            odometry=(self._i, self._j, delta, self._information),
        )
        _, information, _ = native.graph(problem).marginalize(at, self._end)
        information = self._sharper * np.asarray(information)[3:, 3:]
        return (information + information.T) / 2


class Chains:
    """Trajectories drawn from odometry noise round a solution, newest poses kept."""

    def __init__(self, problem: Problem, poses: Array, current: Indices, rng: np.random.Generator) -> None:
        i, j, _, information = problem.odometry
        self._poses, self._rng = poses, rng
        self._back = se2.between(poses[j], poses[i])
        self._root = np.linalg.cholesky(np.linalg.inv(information))
        edge_to = np.full(len(poses), -1)
        edge_to[j] = np.arange(len(j))
        self._walks = []
        for newest in np.asarray(current).tolist():
            walk, at = [], newest
            while edge_to[at] >= 0:
                walk.append(edge_to[at])
                at = i[edge_to[at]]
            edges = np.array(walk, dtype=np.int64)
            self._walks.append((newest, edges, i[edges]))

    def draw(self) -> Array:
        """Poses (N, 3); X_t = X_{t+1} · (δ Exp(noise))⁻¹ backwards from every robot's newest."""
        noise = np.einsum("kij,kj->ki", self._root, self._rng.normal(size=(len(self._root), 3)))
        back = se2.compose(se2.exp(-noise), self._back)
        drawn = self._poses.copy()
        for newest, edges, earlier in self._walks:
            if len(edges):
                drawn[earlier] = _core.chain(self._poses[newest], back[edges])[1:]
        return drawn
