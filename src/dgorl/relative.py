"""A peer's pose with two covariances: in the tangent space, and of (x, y) as a user sees it. METHOD §1.

The joint covariance of a team is one of right perturbations, to first order. To first order an error δ of the peer's
bearing moves it along a straight line; truly it moves it on an arc, which lies d δ²/2 inside the tangent. That is more
than the σ of a good range as soon as σ_δ² d exceeds it: 0.15 m for a peer at 30 m known to 0.1 rad.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dgorl import _core, se2
from dgorl.se2 import Array

TAIL = 3.0
"""The bend's second moment is published this many times.

The bend is a square: its tail is longer than that of a Gaussian of the same second moment. At this factor a bearing
that errs by 3σ puts the peer 3σ inside. Where the range is exact, 95.7 % then lie inside the ellipse of 95 % and 0.08 %
beyond 5σ; with the second moment alone it is 91.7 and 0.7 %. docs/decisions/ellipse.md.
"""


class Relative(NamedTuple):
    """T_ego_peer (3,).

    covariance: (3, 3) of (x, y, theta) in the ego's frame, the bend included: what is published. tangent: (3, 3) of the
    right perturbation ξ, T_ego_peer · Exp(ξ), to first order.
    """

    pose: Array
    covariance: Array
    tangent: Array


def relative_to(poses: Array, covariance: Array, ego: int) -> list[Relative]:
    """Every member of a team as one of them sees it: poses (N, 3), joint covariance (3N, 3N) of right perturbations."""
    seen, covariances = _core.relative(poses, covariance, ego)
    tangent = turned(-seen[:, 2], covariances)
    return [Relative(*row) for row in zip(seen, bent(seen, covariances), tangent, strict=True)]


def turned(angle: Array, covariance: Array) -> Array:
    """Covariances (..., 3, 3) of (x, y, theta) with axes turned by angle (...) [rad]."""
    turn = np.zeros((*np.shape(angle), 3, 3))
    turn[..., :2, :2], turn[..., 2, 2] = se2.rotation(angle), 1.0
    return np.asarray(turn @ covariance @ turn.swapaxes(-1, -2))


def first_order(pose: Array, tangent: Array) -> Array:
    """The covariance (..., 3, 3) of (x, y, theta) in the ego's frame to first order."""
    return turned(pose[..., 2], tangent)


def bent(poses: Array, covariance: Array) -> Array:
    """Covariances (..., 3, 3) of peers at poses (..., 3), of first order, with the bend of the arcs on which they lie.

    Range and bearing count as Gaussian: E d² (1 − cos δ)², δ the bearing's error, along the line of sight.
    """
    place = poses[..., :2]
    square = np.maximum(np.sum(place**2, axis=-1), 1e-12)
    across = np.stack([-place[..., 1], place[..., 0]], axis=-1)
    spread = np.einsum("...i,...ij,...j->...", across, covariance[..., :2, :2], across)
    bearing = np.maximum(spread, 0.0) / square**2  # variance [rad²]
    share = np.maximum(0.5 * np.expm1(-2.0 * bearing) - 2.0 * np.expm1(-0.5 * bearing), 0.0)
    out = np.array(covariance)
    out[..., :2, :2] += TAIL * share[..., None, None] * place[..., :, None] * place[..., None, :]
    return out
