"""SE(2): poses as arrays (..., 3) of (x, y, theta), [m, m, rad]; all functions broadcast.

``T_a_b`` maps b into a. Perturbations are on the right: X·Exp(ξ), tangent ξ = (x, y, θ). METHOD §1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def wrap(angle: ArrayLike) -> Array:
    """Angle in (−π, π] [rad]; one that is there already keeps every digit."""
    a = np.asarray(angle, dtype=float)
    return np.where((a > -np.pi) & (a <= np.pi), a, np.pi - np.mod(np.pi - a, 2 * np.pi))


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    """T_a_c = T_a_b · T_b_c, (..., 3)."""
    a, b = np.asarray(T_a_b, dtype=float), np.asarray(T_b_c, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap(a[..., 2] + b[..., 2])], axis=-1)


def inverse(T_a_b: ArrayLike) -> Array:
    """T_b_a, (..., 3)."""
    a = np.asarray(T_a_b, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -c * a[..., 0] - s * a[..., 1]
    y = s * a[..., 0] - c * a[..., 1]
    return np.stack([x, y, wrap(-a[..., 2])], axis=-1)


def between(T_w_a: ArrayLike, T_w_b: ArrayLike) -> Array:
    """T_a_b = T_w_a⁻¹ · T_w_b, (..., 3)."""
    return compose(inverse(T_w_a), T_w_b)


def transform(T_a_b: ArrayLike, p_b: ArrayLike) -> Array:
    """Points (..., 2) of frame b in frame a."""
    a, p = np.asarray(T_a_b, dtype=float), np.asarray(p_b, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * p[..., 0] - s * p[..., 1]
    y = a[..., 1] + s * p[..., 0] + c * p[..., 1]
    return np.stack([x, y], axis=-1)


def rotation(theta: ArrayLike) -> Array:
    """Rotation matrices (..., 2, 2)."""
    t = np.asarray(theta, dtype=float)
    c, s = np.cos(t), np.sin(t)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def adjoint(T_a_b: ArrayLike) -> Array:
    """Ad(T), (..., 3, 3): T · Exp(ξ) = Exp(Ad(T) ξ) · T."""
    a = np.asarray(T_a_b, dtype=float)
    ad = np.zeros((*a.shape[:-1], 3, 3))
    ad[..., :2, :2] = rotation(a[..., 2])
    ad[..., 0, 2] = a[..., 1]
    ad[..., 1, 2] = -a[..., 0]
    ad[..., 2, 2] = 1.0
    return ad


def _sinc_terms(theta: Array) -> tuple[Array, Array]:
    """sin θ / θ and (1 − cos θ) / θ = 2 sin²(θ/2) / θ, which does not cancel; by series near zero."""
    small = np.abs(theta) < 1e-4
    t = np.where(small, 1.0, theta)
    a = np.where(small, 1.0 - theta**2 / 6.0, np.sin(t) / t)
    b = np.where(small, theta / 2.0 - theta**3 / 24.0, 2.0 * np.sin(t / 2.0) ** 2 / t)
    return a, b


def exp(xi: ArrayLike) -> Array:
    """Pose after moving with constant twist xi = (v_x, v_y, ω) for one unit of time, (..., 3)."""
    x = np.asarray(xi, dtype=float)
    a, b = _sinc_terms(x[..., 2])
    px = a * x[..., 0] - b * x[..., 1]
    py = b * x[..., 0] + a * x[..., 1]
    return np.stack([px, py, wrap(x[..., 2])], axis=-1)


def log(T_a_b: ArrayLike) -> Array:
    """The constant twist that moves a to b in one unit of time, (..., 3); the inverse of :func:`exp`."""
    p = np.asarray(T_a_b, dtype=float)
    theta = wrap(p[..., 2])
    a, b = _sinc_terms(theta)
    d = a * a + b * b
    vx = (a * p[..., 0] + b * p[..., 1]) / d
    vy = (-b * p[..., 0] + a * p[..., 1]) / d
    return np.stack([vx, vy, theta], axis=-1)
