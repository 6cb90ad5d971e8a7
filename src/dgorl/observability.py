"""Observability of relative poses (Alg. 2): the paper's spectral test, and T1 (geometry) for ranges. METHOD §3.

T0 (structure) is in ``observability_structure``; T2, which weighs noise as well, in ``observability_information``; what
to say and do about it in ``observability_motion``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dgorl import se2
from dgorl.optimization.problem import Indices, Problem, Scalars
from dgorl.se2 import Array

EXACT = 1e-9
"""Eigenvalues below this share of their sum are zero, where trajectories are exact."""


def quarter_turn(v: Array) -> Array:
    """J v, J = [[0, −1], [1, 0]], of vectors (..., 2)."""
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


# ---- the paper's spectral test, for measured relative positions ----


def spectral_matrix(edges: Indices, positions: Array, velocities: Array) -> Array:
    """C(G_E) = [[A⊗I_p, *], [0, W(A⊗1_p)]] of measured relative positions, (2mp, np + n). METHOD §0, §3; Alg. 2.

    edges: (m, 2) observer i and observed j; positions, velocities: (n, p) in one frame, p = 2, or p = 3 with yaw as
    the only rotation. d = p + 1 degrees of freedom a robot; columns: n positions, then n headings.

    Derivation: robot i sees z = R_iᵀ(p_j − p_i) and knows its twist, ṗ = R V. Up to R_i, which changes no rank, the
    gradient of z is δp_j − δp_i − J(p_j − p_i) δθ_i: the rows [A⊗I_p, *], A signed, * = −J(p_j − p_i) in the column
    of θ_i. The time derivative of z adds R_iᵀR_jV_j and what is known, whose gradient is J R_jV_j (δθ_j − δθ_i): the
    rows [0, W(A⊗1_p)], W the diagonal matrix of the entries of J R_jV_j. J has rank 2 also in space: vertical
    motion tells no heading.
    """
    n, p = positions.shape
    i, j = edges.T
    m, row = len(edges), np.arange(len(edges))
    incidence = np.zeros((m, n))
    incidence[row, i], incidence[row, j] = -1.0, 1.0
    turn = np.zeros((p, p))
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    star = np.zeros((m, p, n))
    star[row, :, i] = -(positions[j] - positions[i]) @ turn.T
    below = (velocities[j] @ turn.T)[:, :, None] * incidence[:, None, :]
    top = np.hstack([np.kron(incidence, np.eye(p)), star.reshape(m * p, n)])
    return np.vstack([top, np.hstack([np.zeros((m * p, n * p)), below.reshape(m * p, n)])])


def spectrally_observable(edges: Indices, positions: Array, velocities: Array, components: int = 1) -> bool:
    """Alg. 2: rank C(G_E) = d (n − components), d = p + 1: all that a common motion of a component leaves.

    True when every edge passes the motion constraint: both diagonal blocks then have the rank of the incidence matrix,
    and * only adds. Not necessary: two robots that stand still and see one another are observable through * alone.
    """
    n, p = positions.shape
    if not len(edges):
        return bool(n == components)
    matrix = spectral_matrix(edges, positions, velocities)
    scale = np.linalg.norm(matrix, axis=0)  # metres and radians: ranks do not depend on units, rounding does
    singular = np.linalg.svd(matrix / np.where(scale > 0, scale, 1.0), compute_uv=False)
    rank = int((singular > EXACT * singular[0]).sum())
    return bool(rank == (p + 1) * (n - components))


# ---- ranges as bars between bodies ----


def median(values: Array) -> float:
    """numpy's own, which imports its masked arrays for it (2 MB of a robot's memory)."""
    ordered = np.sort(values)
    return float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


@dataclass(frozen=True)
class Bars:
    """K ranges of a window, as bars between the rigid bodies that odometry makes of n robots. METHOD §3.

    i, j: (K,) bodies. a, b: (K, 2) their ends in one frame [m]. weight: (K,) 1/σ² of the range [1/m²]. origin: (n, 2)
    the robots' current positions, about which their twists turn. height: (K,) difference of the ends' [m].
    """

    i: Indices
    j: Indices
    a: Array
    b: Array
    weight: Array
    origin: Array
    height: Array

    @property
    def distance(self) -> Array:
        """(K,) [m]."""
        return np.asarray(np.sqrt(((self.a - self.b) ** 2).sum(axis=1) + self.height**2))

    @property
    def scale(self) -> float:
        """Median range [m]: what a radian of heading counts as."""
        return median(self.distance) if len(self.i) else 1.0

    def rows(self) -> tuple[Array, Array]:
        """ℓ of bodies i and j, (K, 3) each: how a bar grows when a body moves about its origin, heading in metres.

        With both twists about one point these are (u, uᵀJa) and its negative.
        """
        u = (self.a - self.b) / np.maximum(self.distance, 1e-9)[:, None]
        scale = self.scale
        arm_i, arm_j = quarter_turn(self.a - self.origin[self.i]), quarter_turn(self.b - self.origin[self.j])
        row_i = np.column_stack([u, (u * arm_i).sum(axis=1) / scale])
        row_j = -np.column_stack([u, (u * arm_j).sum(axis=1) / scale])
        return row_i, row_j


def bars(problem: Problem, poses: Array, current: Indices) -> Bars:
    """The ranges and RSSI of a window at poses (N, 3); current: (n,) the newest pose of each robot."""
    body = bodies(problem, current)
    parts = [
        (body[s.i], body[s.j], *_ends(s, poses), _weight(s, poses, problem), s.height)
        for s in problem.scalars
        if s.kind != "bearing"
    ]
    none = np.zeros(0)
    parts.append((none.astype(int), none.astype(int), none.reshape(0, 2), none.reshape(0, 2), none, none))
    i, j, a, b, weight, height = (np.concatenate(column) for column in zip(*parts, strict=True))
    on = (i >= 0) & (j >= 0)
    return Bars(i[on], j[on], a[on], b[on], weight[on], poses[current, :2], height[on])


def bodies(problem: Problem, current: Indices) -> NDArray[np.int64]:
    """(N,) which robot, by its place in ``current``, each pose belongs to; −1 for none, as the world."""
    before = np.full(len(problem.slots), -1)
    before[problem.odometry[1]] = problem.odometry[0]
    body = np.full(len(problem.slots), -1)
    at, robot = np.asarray(current), np.arange(len(current))
    while len(at):
        body[at] = robot
        at = before[at]
        on = at >= 0
        at, robot = at[on], robot[on]
    return body


def _ends(s: Scalars, poses: Array) -> tuple[Array, Array]:
    return se2.transform(poses[s.i], s.at_i[:, :2]), se2.transform(poses[s.j], s.at_j[:, :2])


def _weight(s: Scalars, poses: Array, problem: Problem) -> Array:
    if s.kind == "range":
        return s.sigma**-2.0
    a, b = _ends(s, poses)
    squared = np.maximum(((a - b) ** 2).sum(axis=1) + s.height**2, 1e-2)
    return np.asarray((10 * problem.radio[1] / (np.log(10) * s.sigma)) ** 2 / squared)


def edge_information(b: Bars, pair: tuple[int, int]) -> Array:
    """W_e = Σ w ℓℓᵀ (3, 3) of the second body's pose, the first held still; heading in metres."""
    return _edge_information(b, pair, *b.rows())


def _edge_information(b: Bars, pair: tuple[int, int], row_i: Array, row_j: Array) -> Array:
    i, j = pair
    ahead, back = (b.i == i) & (b.j == j), (b.i == j) & (b.j == i)
    rows = np.concatenate([row_j[ahead], row_i[back]])
    weight = np.concatenate([b.weight[ahead], b.weight[back]])
    return np.asarray((weight[:, None] * rows).T @ rows)


def rank_of(information: Array, tolerance: float = EXACT) -> int:
    """Rank of a positive semi-definite matrix: its eigenvalues above ``tolerance`` of their sum.

    Trajectories known to σ [m] at distance d make false ones of about (σ/d)²; pass that, a few times over.
    """
    values = np.linalg.eigvalsh(information)
    total = float(values.sum())
    return int((values > tolerance * total).sum()) if total > 0 else 0


def edge_ranks(b: Bars, tolerance: float = EXACT) -> dict[tuple[int, int], int]:
    """Rank of W_e, 0…3, of every pair (i < j) of bodies with a bar between them."""
    pairs = sorted({(min(i, j), max(i, j)) for i, j in zip(b.i.tolist(), b.j.tolist(), strict=True)})
    rows = b.rows()
    return {pair: rank_of(_edge_information(b, pair, *rows), tolerance) for pair in pairs}


# ---- T1: geometry ----


@dataclass(frozen=True)
class Geometry:
    """Rank of M among the relative poses of n robots, and the motions that change no range to first order.

    null: (k, n, 3), orthonormal twists (x, y [m], heading × ``scale`` [m]) of every robot about its current position,
    along the axes of the bars' frame; zero for the reference.
    """

    rank: int
    full: int
    null: Array
    scale: float

    @property
    def observable(self) -> bool:
        return self.rank == self.full


def geometry(b: Bars, reference: int = 0, tolerance: float = 1e-6) -> Geometry:
    """T1: SVD rank of M = blkdiag(ℓ_kᵀ)(A⊗I₃) with the reference held still.

    tolerance: smallest singular value that counts, as a share of the largest.
    """
    n, count = len(b.origin), len(b.i)
    matrix = np.zeros((count, n, 3))
    matrix[np.arange(count), b.i], matrix[np.arange(count), b.j] = b.rows()
    others = [k for k in range(n) if k != reference]
    free = np.linalg.qr(matrix[:, others].reshape(count, 3 * len(others)), mode="r")
    _, singular, rows = np.linalg.svd(free, full_matrices=True)
    rank = int((singular > tolerance * max(float(singular.max(initial=0.0)), 1e-12)).sum())
    null = np.zeros((len(rows) - rank, n, 3))
    null[:, others] = rows[rank:].reshape(-1, len(others), 3)
    return Geometry(rank, 3 * len(others), null, b.scale)
