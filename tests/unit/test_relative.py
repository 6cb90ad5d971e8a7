"""What is published of a position: moments and tails against sampling, and what they are without a bend."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from dgorl import se2
from dgorl.evaluation.metrics import CHI2_95_2DOF
from dgorl.relative import TAIL, bent, first_order, relative_to, turned
from dgorl.se2 import Array

DRAWS = 200_000


class Team(NamedTuple):
    """Poses (2, 3) of an ego and a peer, and the root of their joint covariance."""

    poses: Array
    root: Array


def team(rng: np.random.Generator, distance: float, heading: float, position: float) -> Team:
    """An ego whose heading is uncertain [rad], and correlated position errors of both [m]."""
    way, turn = rng.uniform(-np.pi, np.pi, 2)
    ego = np.array([4.0, -1.0, rng.uniform(-np.pi, np.pi)])
    peer = np.array([*ego[:2] + distance * np.array([np.cos(way), np.sin(way)]), turn])
    root = position * rng.normal(size=(6, 6)) / np.sqrt(6)
    root[2] = root[5] = 0.0
    root[2, 2] = heading
    root[5, 2], root[5, 5] = 0.3 * heading, 0.1
    return Team(np.stack([ego, peer]), root)


def sampled(found: Team, seed: int) -> Array:
    """T_ego_peer (DRAWS, 3) of jointly perturbed poses."""
    xi = (np.random.default_rng(seed).normal(size=(DRAWS, 6)) @ found.root.T).reshape(-1, 2, 3)
    moved = se2.compose(found.poses, se2.exp(xi))
    return np.asarray(se2.between(moved[:, 0], moved[:, 1]))


def along(pose: Array, covariance: Array) -> float:
    """Variance along the line of sight."""
    sight = pose[:2] / np.hypot(*pose[:2])
    return float(sight @ covariance[:2, :2] @ sight)


@pytest.mark.parametrize(("distance", "heading"), [(2.5, 0.3), (17.0, 0.12), (64.0, 0.07)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_bend_is_the_second_moment_of_the_arc(distance: float, heading: float, seed: int) -> None:
    """About the published pose, so that the shift of the mean is in it; TAIL times, for its tail."""
    found = team(np.random.default_rng(seed), distance, heading, 0.0)
    seen = relative_to(*_joint(found), 0)[1]
    error = sampled(found, seed) - seen.pose
    moment = error[:, :2].T @ error[:, :2] / DRAWS
    straight = first_order(seen.pose, seen.tangent)
    assert along(seen.pose, straight) == pytest.approx(0.0, abs=1e-9)
    assert along(seen.pose, seen.covariance) == pytest.approx(TAIL * along(seen.pose, moment), rel=0.05)
    assert np.linalg.eigvalsh(seen.covariance[:2, :2] - moment)[0] > -1e-3 * np.trace(moment)
    assert seen.covariance[2] == pytest.approx(straight[2])


@pytest.mark.parametrize("position", [1e-3, 0.1, 1.0])
@pytest.mark.parametrize(("distance", "heading"), [(8.0, 0.2), (20.0, 0.15), (90.0, 0.1)])
def test_ellipses_hold_what_they_promise(distance: float, heading: float, position: float) -> None:
    """Inside the 95 % ellipse and beyond 5σ, from sharp ranges to none."""
    found = team(np.random.default_rng(7), distance, heading, position)
    seen = relative_to(*_joint(found), 0)[1]
    error = (sampled(found, 7) - seen.pose)[:, :2]
    square = np.einsum("ni,ij,nj->n", error, np.linalg.inv(seen.covariance[:2, :2]), error)
    assert 0.945 < np.mean(square <= CHI2_95_2DOF) < 0.965
    assert np.mean(square > 25.0) < 1.2e-3


@pytest.mark.parametrize("seed", range(5))
def test_the_tangent_covariance_is_that_of_right_perturbations(seed: int) -> None:
    found = team(np.random.default_rng(seed), 5.0, 0.01, 0.05)
    seen = relative_to(*_joint(found), 0)[1]
    xi = se2.log(se2.between(seen.pose, sampled(found, seed)))
    assert xi.T @ xi / DRAWS == pytest.approx(seen.tangent, abs=0.02 * np.abs(seen.tangent).max())
    assert turned(-seen.pose[2], first_order(seen.pose, seen.tangent)) == pytest.approx(seen.tangent, abs=1e-15)


def test_what_is_sure_is_not_bent_and_what_is_unknown_stays_finite() -> None:
    poses = np.array([[30.0, 1.0, 0.5], [0.0, 0.0, 2.0], [1e-9, 0.0, 0.0], [5.0, 5.0, 1.0]])
    sharp = np.tile(1e-12 * np.eye(3), (4, 1, 1))
    assert bent(poses, sharp) == pytest.approx(sharp, abs=1e-20)
    vague = np.tile(1e10 * np.eye(3), (4, 1, 1))
    assert np.isfinite(bent(poses, vague)).all()
    assert (np.linalg.eigvalsh(bent(poses, vague)) >= 1e10 * (1 - 1e-9)).all()


def _joint(found: Team) -> tuple[Array, Array]:
    return found.poses, found.root @ found.root.T
