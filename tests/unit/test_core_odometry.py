"""Preintegration of odometry sub-steps. METHOD §1, keyframes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dgorl import _core, se2
from tests.unit.reference import random_information

UPPER = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


def steps(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-2, 2, (count, 3)), random_information(rng, count) * 1e-3


def test_preintegration_matches_composition_group_by_group() -> None:
    deltas, covariances = steps(9)
    counts = np.array([0, 2, 1, 0, 6, 0])
    sums, spreads = _core.preintegrate(deltas, covariances[:, *UPPER], counts)
    at = 0
    for count, total, spread in zip(counts, sums, spreads, strict=True):
        expected, covariance = np.zeros(3), np.zeros((3, 3))
        for delta, noise in zip(deltas[at : at + count], covariances[at : at + count], strict=True):
            expected = se2.compose(expected, delta)
            ad = se2.adjoint(se2.inverse(delta))
            covariance = ad @ covariance @ ad.T + noise
        np.testing.assert_allclose(se2.between(expected, total), 0, atol=1e-12)
        np.testing.assert_allclose(spread, covariance, rtol=1e-12, atol=1e-15)
        np.testing.assert_array_equal(spread, spread.T)
        at += count


def test_covariance_is_that_of_sampled_motion() -> None:
    deltas, covariances = steps(5, seed=3)
    covariances *= 1e-2
    total, spread = _core.preintegrate(deltas, covariances[:, *UPPER], [5])
    rng, x = np.random.default_rng(1), np.zeros((200_000, 3))
    for delta, noise in zip(deltas, covariances, strict=True):
        x = se2.compose(se2.compose(x, delta), se2.exp(rng.multivariate_normal(np.zeros(3), noise, len(x))))
    sampled = np.cov(se2.log(se2.between(total[0], x)).T)
    np.testing.assert_allclose(sampled, spread[0], atol=0.02 * np.abs(spread).max())


def test_preintegrated_in_parts_equals_at_once() -> None:
    deltas, covariances = steps(8, seed=4)
    upper = covariances[:, *UPPER]
    parts, part_covariances = _core.preintegrate(deltas, upper, [3, 5])
    whole = _core.preintegrate(deltas, upper, [8])
    twice = _core.preintegrate(parts, part_covariances[:, *UPPER], [2])
    for a, b in zip(whole, twice, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_chain_composes() -> None:
    deltas, _ = steps(6, seed=5)
    start = np.array([1.0, -2.0, 3.0])
    poses = _core.chain(start, deltas)
    np.testing.assert_allclose(se2.between(poses[:-1], poses[1:]), [*deltas], atol=1e-12)
    np.testing.assert_array_equal(poses[0], start)
    np.testing.assert_array_equal(_core.chain(start, np.zeros((0, 3))), start[None])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"deltas": np.zeros((3, 2))}, "deltas: must have shape"),
        ({"deltas": np.full((3, 3), np.nan)}, "deltas: must be finite"),
        ({"covariances": np.zeros((3, 3, 3))}, "covariances: must have shape"),
        ({"covariances": np.zeros((2, 6))}, "covariances: must have one row per delta, 3"),
        ({"covariances": np.full((3, 6), np.inf)}, "covariances: must be finite"),
        ({"counts": [1, 1]}, "counts: must sum to the number of deltas, 3"),
        ({"counts": [4, 0]}, "counts: must sum to the number of deltas, 3"),
        ({"counts": [4, -1]}, "counts: must not be negative"),
        ({"counts": [1.5, 1.5]}, "counts: must be convertible to int64"),
    ],
)
def test_wrong_steps_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"deltas": np.zeros((3, 3)), "covariances": np.zeros((3, 6)), "counts": [1, 2], **changes}
    with pytest.raises(ValueError, match=f"^{message}"):
        _core.preintegrate(**arguments)


def test_wrong_chains_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^start: must have shape"):
        _core.chain(np.zeros(2), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"^start: must be finite"):
        _core.chain(np.full(3, np.nan), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"^deltas: must be finite"):
        _core.chain(np.zeros(3), np.full((1, 3), np.inf))
