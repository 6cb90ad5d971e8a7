"""Group axioms of SE(2), over shapes and near the identity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dgorl import se2

Array = np.ndarray
SMALL = [0.0, 1e-300, 1e-12, -1e-8, 1e-5, 1e-4, 9.99e-5, -1.001e-4, 1e-3, 1e-2]
lengths = st.floats(-100, 100) | st.sampled_from(SMALL)
angles = st.floats(-10, 10) | st.sampled_from(SMALL) | st.sampled_from([np.pi, -np.pi, np.pi - 1e-9, 3 * np.pi])


@st.composite
def several(draw: st.DrawFn, count: int) -> list[Array]:
    """Arrays of poses (..., 3) of one shape."""
    shape = draw(hnp.array_shapes(min_dims=0, max_dims=2, max_side=3))
    return [
        np.stack([draw(hnp.arrays(float, shape, elements=e)) for e in (lengths, lengths, angles)], axis=-1)
        for _ in range(count)
    ]


def assert_same(a: Array, b: Array, tolerance: float = 1e-9) -> None:
    """Equal poses; headings modulo a turn."""
    np.testing.assert_allclose(a[..., :2], b[..., :2], atol=tolerance, rtol=tolerance)
    np.testing.assert_allclose(se2.wrap(a[..., 2] - b[..., 2]), 0, atol=tolerance)


@given(st.floats(-1e6, 1e6) | angles)
def test_wrap(angle: float) -> None:
    wrapped = se2.wrap(angle)
    assert -np.pi < wrapped <= np.pi
    assert np.isclose(np.cos(wrapped), np.cos(angle), atol=1e-9)
    assert np.isclose(np.sin(wrapped), np.sin(angle), atol=1e-9)
    assert se2.wrap(wrapped) == wrapped


@pytest.mark.parametrize(("angle", "wrapped"), [(np.pi, np.pi), (-np.pi, np.pi), (3 * np.pi, np.pi), (0.1, 0.1)])
def test_wrap_at_the_seam(angle: float, wrapped: float) -> None:
    assert se2.wrap(angle) == wrapped


@given(several(3))
def test_composition_is_associative(poses: list[Array]) -> None:
    a, b, c = poses
    assert_same(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))


@given(several(1))
def test_identity_and_inverse(poses: list[Array]) -> None:
    [a] = poses
    identity = np.zeros(3)
    assert_same(se2.compose(a, identity), a)
    assert_same(se2.compose(identity, a), a)
    assert_same(se2.compose(a, se2.inverse(a)), np.zeros_like(a))
    assert_same(se2.compose(se2.inverse(a), a), np.zeros_like(a))
    assert_same(se2.inverse(se2.inverse(a)), a)


@given(several(2))
def test_between_undoes_compose(poses: list[Array]) -> None:
    a, b = poses
    assert_same(se2.between(a, se2.compose(a, b)), b)


@given(several(3))
def test_transform_acts_as_compose(poses: list[Array]) -> None:
    a, b, p = poses
    point = p[..., :2]
    np.testing.assert_allclose(
        se2.transform(a, se2.transform(b, point)), se2.transform(se2.compose(a, b), point), atol=1e-9
    )
    np.testing.assert_allclose(se2.transform(a, np.zeros(2)), a[..., :2])
    rotated = np.einsum("...ij,...j->...i", se2.rotation(a[..., 2]), point)
    np.testing.assert_allclose(se2.transform(a, point) - a[..., :2], rotated, atol=1e-9)


@given(several(1))
def test_log_undoes_exp_and_back(poses: list[Array]) -> None:
    [a] = poses
    principal = np.concatenate([a[..., :2], 0.999 * se2.wrap(a[..., 2:])], axis=-1)
    assert_same(se2.exp(se2.log(a)), a)
    np.testing.assert_allclose(se2.log(se2.exp(principal)), principal, atol=1e-9, rtol=1e-9)


@given(several(1), st.floats(-1, 1), st.floats(-1, 1))
def test_exp_of_one_twist_is_a_one_parameter_group(poses: list[Array], s: float, t: float) -> None:
    [xi] = poses
    assert_same(se2.compose(se2.exp(s * xi), se2.exp(t * xi)), se2.exp((s + t) * xi))


@given(several(2))
def test_adjoint_moves_perturbations_to_the_left(poses: list[Array]) -> None:
    a, xi = poses
    moved = np.einsum("...ij,...j->...i", se2.adjoint(a), xi)
    assert_same(se2.compose(a, se2.exp(xi)), se2.compose(se2.exp(moved), a), tolerance=1e-8)


@given(several(2))
def test_adjoint_is_a_homomorphism(poses: list[Array]) -> None:
    a, b = poses
    np.testing.assert_allclose(se2.adjoint(a) @ se2.adjoint(b), se2.adjoint(se2.compose(a, b)), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("theta", [1e-9, 1e-6, 9e-5, 1.1e-4, 1e-3, 1e-2])
def test_exp_near_identity_is_accurate_to_rounding(theta: float) -> None:
    """Against the series sin θ / θ and (1 − cos θ) / θ: 1 − cos would cancel."""
    sine, versine, term = 0.0, 0.0, 1.0
    for k in range(0, 12, 2):
        sine += term / (k + 1)
        versine += term * theta / ((k + 1) * (k + 2))
        term *= -(theta**2) / ((k + 1) * (k + 2))
    np.testing.assert_allclose(se2.exp([1.0, 0.0, theta])[:2], [sine, versine], rtol=4e-16)
