"""The numerical core (C++): window graphs of SE(2) poses, their optimum and marginals. METHOD §1, §2, §5.

Poses are (x, y, θ) [m, m, rad] in one common frame; perturbations are on the right, X·Exp(ξ), ξ = (x, y, θ).
Arrays are float64 or int64 and C-contiguous, others are converted; each family of factors is added in one
call with one row per factor. Every argument is checked: ValueError names it, as in
``ranges.sigma: must be positive (row 3)``. Results are the same bits on every run. The heavy calls release
the GIL; a graph may be read from several threads.
"""

from collections.abc import Sequence
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Array = NDArray[np.float64]
_Indices = NDArray[np.int64]
_Reason = Literal["converged", "stalled", "max_iterations", "failed"]

NONE: int
HUBER: int
CAUCHY: int
HUBER_NEGATIVE: int
"""Huber where the residual is negative (long NLOS range, weak RSSI), else quadratic; scalar factors only."""
CAUCHY_NEGATIVE: int
"""Cauchy where the residual is negative, else quadratic; scalar factors only."""

@final
class Solution:
    """What an optimisation found, one entry per start; :meth:`Graph.solve` has B = 1."""

    @property
    def poses(self) -> _Array:
        """(B, N, 3)."""
    @property
    def cost(self) -> _Array:
        """(B,), ½ Σ ρ(eᵀΩe) + Σ priors."""
    @property
    def iterations(self) -> _Indices:
        """(B,), linear systems solved."""
    @property
    def reason(self) -> list[_Reason]:
        """(B,), why it stopped.

        ``converged``: the last step was below the tolerance, or Newton's quadratic convergence says that the
        next one would be, a thousand times over. ``stalled``: no step lowers the cost any more.
        ``failed``: the cost is not finite, or no damping makes the system regular.
        """
    @property
    def covariance(self) -> _Array | None:
        """(3m, 3m) of :meth:`Graph.solve`; None from :meth:`Graph.optimize`."""

@final
class Graph:
    """N poses on time slots and the factors between them. METHOD §1.

    slots: (N,) int64, time slot of each pose, ≥ 0, any unit; −1 is for fixed poses only (the ``world``).
    fixed: (N,) bool, constants. Several poses may share a slot, in any order.
    Factors between free poses have to stay within a slot or between adjacent occupied ones.

    Kernels act on the normalised residual (the Mahalanobis norm of relative poses); ``width`` is in σ.
    """

    def __init__(self, slots: ArrayLike, fixed: ArrayLike) -> None: ...
    def add_relative_poses(
        self,
        i: ArrayLike,
        j: ArrayLike,
        at_i: ArrayLike,
        at_j: ArrayLike,
        delta: ArrayLike,
        information: ArrayLike,
        kernel: int = 0,
        width: float = 1.0,
    ) -> None:
        """Measured relative poses: e = vec(δ⁻¹ (X_i·B_i)⁻¹ (X_j·B_j)).

        i, j: (M,) poses. at_i, at_j: (M, 3) the B, pose at the measurement's time in the keyframe's frame.
        delta: (M, 3). information: (M, 3, 3) symmetric positive semi-definite.
        """
    def add_odometry(self, i: ArrayLike, j: ArrayLike, delta: ArrayLike, information: ArrayLike) -> None:
        """As :meth:`add_relative_poses` without offsets and kernel."""
    def add_ranges(
        self,
        i: ArrayLike,
        j: ArrayLike,
        at_i: ArrayLike,
        at_j: ArrayLike,
        height: ArrayLike,
        range: ArrayLike,
        sigma: ArrayLike,
        kernel: int = 0,
        width: float = 1.0,
    ) -> None:
        """Metric ranges: e = (d − range)/σ, d = √(|a − b|² + height²). METHOD §2.

        at_i, at_j: (M, 2) antennas in the frames of poses i and j [m]. height: (M,) difference of theirs [m].
        range, sigma: (M,) [m].
        """
    def add_rssi(
        self,
        i: ArrayLike,
        j: ArrayLike,
        at_i: ArrayLike,
        at_j: ArrayLike,
        height: ArrayLike,
        rssi: ArrayLike,
        rssi_at_1m: ArrayLike,
        exponent: ArrayLike,
        sigma: ArrayLike,
        kernel: int = 0,
        width: float = 1.0,
    ) -> None:
        """Signal strengths: e = (RSSI − (A − 10 η log₁₀ max(d, 0.1)))/σ. METHOD §2.

        at_i, at_j, height: as in :meth:`add_ranges`. rssi, rssi_at_1m: (M,) [dBm]. exponent: (M,) η.
        sigma: (M,) [dB].
        """
    def add_bearings(
        self,
        observer: ArrayLike,
        target: ArrayLike,
        at_observer: ArrayLike,
        at_target: ArrayLike,
        bearing: ArrayLike,
        sigma: ArrayLike,
        kernel: int = 0,
        width: float = 1.0,
    ) -> None:
        """Bearings: e = wrap(angle of the target's point in the frame X_observer·B − bearing)/σ.

        observer, target: (M,) poses. at_observer: (M, 3) the B. at_target: (M, 2) [m] in the target's frame.
        bearing, sigma: (M,) [rad].
        """
    def add_prior(
        self,
        reference: int,
        members: ArrayLike,
        relative: ArrayLike,
        information: ArrayLike,
        gradient: ArrayLike,
    ) -> None:
        """Dense prior, as marginalisation leaves it: ½ δᵀHδ + gᵀδ, δ_j = vec(Z_j⁻¹ X_ref⁻¹ X_j). METHOD §1.

        reference: pose, or −1 for a prior on the members' own poses. members: (m,) poses.
        relative: (m, 3), Z. information: (3m, 3m) symmetric. gradient: (3m,).
        """
    def optimize(
        self,
        initial: ArrayLike,
        max_iterations: int = 50,
        step_tolerance: float = 1e-9,
        initial_damping: float = 1e-6,
    ) -> Solution:
        """Levenberg–Marquardt from each of B starts (B, N, 3), independently. METHOD §5.

        step_tolerance: largest component of the last step [m, rad]. A graph without a gauge is fine.
        """
    def solve(
        self,
        initial: ArrayLike,
        select: ArrayLike,
        max_iterations: int = 50,
        step_tolerance: float = 1e-9,
        initial_damping: float = 1e-6,
    ) -> Solution:
        """Optimise from one start (N, 3), with the joint covariance of the selected poses (m,) there.

        The cheapest way to have both. Raises ValueError when the graph leaves a pose undetermined.
        """
    def cost(self, poses: ArrayLike) -> float:
        """½ Σ ρ(eᵀΩe) + Σ priors at the poses (N, 3)."""
    def costs(self, poses: ArrayLike) -> _Array:
        """:meth:`cost` of each of a batch (B, N, 3): (B,)."""
    def evidence(
        self, poses: ArrayLike, select: ArrayLike, soft: ArrayLike, information: ArrayLike
    ) -> tuple[_Array, _Array]:
        """log det(H + Π) (B,) and joint covariance (B, 3m, 3m) of the selected poses (m,) under H + Π. METHOD §4.

        poses: (B, N, 3). H as in :meth:`covariance`; Π has diag(information (k, 3)) on the poses soft (k,).
        Raises ValueError when even so a pose is undetermined.
        """
    def residuals(self, poses: ArrayLike) -> list[tuple[str, _Array]]:
        """Per call of ``add_*``, in order: kind and normalised residuals before the kernel.

        ``range``, ``rssi``, ``bearing``: (M, 1), e/σ. ``relative_pose``: (M, 3), Lᵀe with Ω = LLᵀ.
        ``prior``: (m, 3), the displacement δ itself [m, m, rad].
        """
    def covariance(self, poses: ArrayLike, select: ArrayLike) -> _Array:
        """Joint covariance (3m, 3m) of the selected poses (m,) in their right tangents.

        Linearised at the poses (N, 3); robust factors count with their weights ρ'. Fixed poses have zero
        blocks. Cheap for poses of the last slots.
        Raises ValueError when the graph leaves a pose undetermined.
        """
    def marginalize(self, poses: ArrayLike, slot: int) -> tuple[_Indices, _Array, _Array]:
        """Schur complement of the free poses before ``slot``, from the factors that touch them. METHOD §1.

        Linearised at the poses (N, 3), robust weights frozen. Returns the kept poses (k,), ascending: the
        free ones those factors touch in ``slot`` or later; information (3k, 3k) and gradient (3k,) by their
        right perturbations. Raises ValueError when an eliminated pose is undetermined.
        """
    def gauss_newton_step(self, poses: ArrayLike) -> _Array:
        """The undamped step (N, 3) as tangents, zero for fixed poses; weights as in :meth:`covariance`."""
    def hessian(self, poses: ArrayLike, exact: bool = False) -> tuple[_Array, _Array]:
        """Hessian (3F, 3F) and gradient (3F,) over the F free poses by index.

        Gauss–Newton with robust weights, as in :meth:`covariance`; ``exact``: with all second derivatives of
        the cost along x += R ξ_xy, θ += ξ_θ.
        """

def find_places(
    graph: Graph,
    spread: Graph,
    anchors: ArrayLike,
    annuli: ArrayLike,
    warm: ArrayLike,
    pi: ArrayLike,
    limit: int,
) -> tuple[_Array, _Array, _Array]:
    """Where pose 1 of ``graph`` may stand relative to pose 0, which is fixed at the origin. METHOD §4.

    Particles on the rings of the anchors, in the region where the annuli meet, weighted by ``spread`` (the same graph
    with the grid's width in its σ), the best and most diverse fitted, modes within Mahalanobis distance 3 merged.
    anchors: (A, 8) of point on 0 and on 1 (2 each), distance [m], its relative σ, jitter of the grid's bearings and
    headings in [0, 1). annuli: (R, 7) of point on 0 and on 1 (2 each), height, least and largest distance [m].
    warm: (W, 3) places fitted besides. pi: (3,) information of a weak prior. limit: of the modes.
    Returns poses (k, 3), log masses (k,) best first, covariances (k, 3, 3) of right perturbations.
    """

def chain(start: ArrayLike, deltas: ArrayLike) -> _Array:
    """start, start·δ₁, start·δ₁·δ₂ …: (3,) and (K, 3) to (K+1, 3)."""

@final
class Track:
    """One robot's trajectory in one epoch: keyframes k at k / 2 s, joined by preintegrated odometry. METHOD §1."""

    number: int
    """what the caller's arrays call this track"""
    @property
    def begin(self) -> float:
        """Start of its first odometry [s]."""
    @property
    def epoch(self) -> int: ...
    @property
    def first(self) -> int:
        """Its first keyframe."""
    @property
    def last(self) -> int:
        """Its newest keyframe."""
    @property
    def end(self) -> float:
        """Until when odometry is known [s]."""
    def known(self, stamp: float) -> float:
        """Until when odometry that began before ``stamp`` tells of it, at most ``stamp`` [s]; −inf if none does."""
    def next(self, stamp: float) -> float:
        """The first time from ``stamp`` on at which odometry tells more, inf if never; of a gap, its end [s]."""
    def foreseen(self, stamp: float, motion: _Array) -> _Array:
        """Covariance (3, 3) of the right perturbation of the motion up to ``stamp`` that odometry has not told of."""
    def newest(self, stamp: float) -> int:
        """The newest keyframe known from odometry that began before ``stamp`` [s]."""
    def locate(self, stamp: float) -> tuple[int, _Array]:
        """Keyframe before ``stamp`` [s] and the pose (3,) at it in the keyframe's frame."""

@final
class Trail:
    """All tracks of one robot: more than 1 s without odometry ends one. motion: (13,), dgorl.tracks.motion_values."""

    def __init__(self, motion: ArrayLike) -> None: ...
    @property
    def tracks(self) -> list[Track]: ...
    def extend(self, rows: ArrayLike) -> None:
        """Append odometry that follows on.

        rows: (S, 13) as start, end [s], epoch, 1 for a twist or 0 for a displacement, its three values (v, 0, ω) or
        (dx, dy, dθ), and the covariance of a displacement in the frame at its start, NaN where it states none.
        """
    def restart(self) -> None:
        """Forget all steps, to be built anew from rows."""
    def forget(self, before: int) -> None:
        """Drop what lies before keyframe ``before``."""

def count_jumps(rows: ArrayLike, motion: ArrayLike) -> int:
    """How many rows of odometry (S, 13) are jumps: faster than the limits of ``motion`` (13,) by far, no motion."""

def locate(trails: Sequence[Trail | None], robots: ArrayLike, stamps: ArrayLike) -> tuple[_Indices, _Indices, _Array]:
    """Where stamps (M,) [s] fall on the tracks of their robots (M,), by index into trails.

    Returns the tracks' numbers (M,), −1 where none covers the stamp, keyframes (M,) and offsets (M, 3).
    """

def odometry(tracks: Sequence[Track], first: Sequence[int], last: Sequence[int]) -> tuple[_Array, _Array]:
    """Motion (K, 3) and information (K, 3, 3) between keyframes first … last of each track, one after another."""

def carry(
    tracks: Sequence[Track], stamp: float, motion: ArrayLike, poses: ArrayLike, covariance: ArrayLike
) -> tuple[_Array, _Array]:
    """Poses (n, 3) at the newest keyframes and their joint covariance (3n, 3n) carried on to ``stamp`` [s].

    By odometry as far as it is known, then by the last twist with noise growing with age. METHOD §1, now.
    """

def relative(poses: ArrayLike, covariance: ArrayLike, ego: int) -> tuple[_Array, _Array]:
    """T_ego_j of every member (n, 3) and the covariances (n, 3, 3) of their (x, y, θ) in the ego's frame. METHOD §1."""
