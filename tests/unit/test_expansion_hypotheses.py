"""Which optima are the same, how probable they are, what they agree on, when a place counts as one. METHOD §4."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import se2
from dgorl.expansion.apart import SAME, apart
from dgorl.expansion.cluster_graph import Optima
from dgorl.expansion.hypotheses import (
    ALIVE,
    BEAM,
    BEARING,
    COARSE,
    NEAR,
    TIE,
    agreement,
    both,
    distinct,
    fresh,
    groups_of,
    pair_relative,
    probabilities,
    settled_pair,
)
from dgorl.places import EVIDENCE, MISSED, places_of, published
from dgorl.relative import Relative
from dgorl.tracks import TrackKey
from tests.unit.reference import random_information

Array = np.ndarray


def one_robot(positions: Array, sigma: Array | float, mass: Array) -> Optima:
    """Optima of two tracks, the second at ``positions`` (B, 3), with that σ of every coordinate."""
    count = len(positions)
    relative = np.zeros((count, 2, 3))
    relative[:, 1] = positions
    covariance = np.zeros((count, 6, 6))
    covariance[:, 3:, 3:] = np.asarray(sigma)[..., None, None] ** 2 * np.eye(3) * np.ones((count, 1, 1))
    mass = np.asarray(mass, dtype=float)
    return Optima(relative.copy(), -mass, mass, relative, covariance)


def along_x(*x: float) -> Array:
    return np.column_stack([x, np.zeros((len(x), 2))])


# ---- apart ----


def test_nearer_than_three_sigma_is_the_same():
    poses = along_x(0.0, SAME - 0.01, SAME + 0.01, 2 * SAME + 0.005)[:, None]
    covariance = np.broadcast_to(np.eye(3), (4, 3, 3))
    assert apart(poses, covariance, np.arange(4), 9) == [0, 2]
    assert apart(poses, covariance, np.array([1, 0, 2, 3]), 9) == [1, 3]
    assert apart(poses, covariance, np.array([1, 3]), 1) == [1]
    assert apart(poses, covariance, np.zeros(0, np.int64), 9) == []


def test_the_distance_is_under_the_better_ones_covariance():
    poses = along_x(0.0, 2.0)[:, None]
    covariance = np.array([np.eye(3), 0.01 * np.eye(3)])
    assert apart(poses, covariance, np.array([0, 1]), 9) == [0]
    assert apart(poses, covariance, np.array([1, 0]), 9) == [1, 0]


@pytest.mark.parametrize("seed", range(3))
def test_apart_is_the_greedy_choice_by_mahalanobis_distance(seed):
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(30, 2, 3)) * [1.0, 1.0, 2.0]
    covariance = np.linalg.inv(random_information(rng, 30, 6)) * 3
    order, kept = rng.permutation(30), []
    for b in order.tolist():
        inverse = [np.linalg.inv(covariance[k]) for k in kept]
        steps = [se2.between(poses[k], poses[b]).ravel() for k in kept]
        if all(d @ h @ d > SAME**2 for d, h in zip(steps, inverse, strict=True)):
            kept.append(b)
    assert 1 < len(kept) < len(order)
    assert apart(poses, covariance, order, 99) == kept
    assert apart(poses, covariance, order, 2) == kept[:2]


# ---- the beam ----


def test_distinct_keeps_the_best_that_are_different_and_alive():
    spread = along_x(*(10.0 * k for k in range(12)))
    mass = -np.arange(12.0)
    kept = distinct(one_robot(spread, 1.0, mass))
    np.testing.assert_array_equal(kept.mass, mass[:BEAM])
    doubled = distinct(one_robot(along_x(0, 50, 0.1, 50.1), 1.0, [-1.0, -5.0, 0.0, -6.0]))
    np.testing.assert_array_equal(doubled.mass, [0.0, -5.0])
    hopeless = distinct(one_robot(along_x(0, 50, 100), 1.0, [0.0, -ALIVE + 0.1, -ALIVE - 0.1]))
    np.testing.assert_array_equal(hopeless.mass, [0.0, -ALIVE + 0.1])


def test_fresh_are_those_not_known_or_better_than_the_known_one_in_their_place():
    known = one_robot(along_x(0, 50), 1.0, [-3.0, -4.0])
    places, masses = along_x(50.5, 100, 0.5, 150, 200), [-4.0 + TIE / 2, -1.0, -2.0, -0.5, -COARSE - 1]
    found = one_robot(places, 1.0, masses)
    np.testing.assert_array_equal(fresh(known, found, 9).relative[:, 1, 0], [150, 100, 0.5])
    np.testing.assert_array_equal(fresh(known, found, 1).mass, [-0.5])
    assert len(fresh(known, known, 9).mass) == 0
    assert len(both(known, found).mass) == 7


def test_probabilities_are_a_softmax_that_does_not_overflow():
    np.testing.assert_allclose(probabilities(np.log([0.2, 0.5, 0.3])), [0.2, 0.5, 0.3])
    np.testing.assert_allclose(probabilities(np.array([1e6, 1e6 - np.log(3), -1e6])), [0.75, 0.25, 0.0])
    assert probabilities(np.array([-5e5])) == [1.0]


def test_agreement_is_the_probability_of_those_that_put_a_pair_alike():
    """Three tracks: the hypotheses differ in the third; on the first two all but the last agree."""
    relative = np.zeros((4, 3, 3))
    relative[:, 1, 0] = [5.0, 5.2, 5.1, 9.0]
    relative[:, 2, 1] = [3.0, -3.0, -3.0, 3.0]
    covariance = np.zeros((4, 9, 9))
    covariance[:, 3:, 3:] = 0.01 * np.eye(6)
    optima = Optima(relative, np.zeros(4), np.zeros(4), relative, covariance)
    probability = np.array([0.4, 0.3, 0.2, 0.1])
    assert agreement(optima, probability, 0, 1) == pytest.approx(0.9)
    assert agreement(optima, probability, 0, 2) == pytest.approx(0.5)
    assert agreement(optima, probability, 1, 2) == pytest.approx(0.4)


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_of_a_pair_is_that_of_samples(seed):
    """Small right perturbations of both tracks move T_a_b as its covariance says."""
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-3, 3, (3, 3))
    covariance = np.linalg.inv(random_information(rng, 1, 9)[0]) * 1e-6
    T_a_b, spread = pair_relative(poses, covariance, 2, 1)
    draws = rng.multivariate_normal(np.zeros(9), covariance, 40000).reshape(-1, 3, 3)
    moved = se2.compose(poses, draws)
    step = se2.between(T_a_b, se2.between(moved[:, 2], moved[:, 1]))
    scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    np.testing.assert_allclose(np.cov(step.T) / scale, spread / scale, atol=0.03)


def settled(distance: float, covariance: Array) -> bool:
    optima = one_robot(along_x(distance), 1.0, [0.0])
    optima.covariance[0, 3:, 3:] = covariance
    return settled_pair(optima, 0, 1)


def test_a_place_settles_when_one_sees_the_other():
    d = 20.0
    assert settled(d, np.diag([0.1, (0.9 * BEARING * d) ** 2, 0.01]))
    # A robot that stands: nothing says where it looks, yet its place is known.
    assert settled(d, np.diag([0.1, 0.1, np.pi**2]))
    # The other way round: the place seen from a robot whose own heading nothing tells.
    arm = np.array([0.0, d, 1.0])  # b's frame turns about a
    assert settled(d, 0.01 * np.eye(3) + np.pi**2 * np.outer(arm, arm))
    # Near ones are measured by NEAR metres.
    assert settled(0.5, np.diag([1.0, 1.0, 0.1]) * (0.9 * BEARING * NEAR) ** 2)
    assert not settled(0.5, np.diag([1.0, 1.0, 0.1]) * (1.1 * BEARING * NEAR) ** 2)


def test_a_ring_of_places_does_not_settle():
    """Ranges alone leave a ring: wide across the line of sight, seen from either end, with a heading of its own."""
    d = 20.0
    across = np.array([0.0, d, 0.0])
    assert not settled(d, 0.01 * np.eye(3) + np.outer(across, across) + np.diag([0, 0, np.pi**2]))
    assert not settled(d, np.diag([0.01, (1.1 * BEARING * d) ** 2, np.pi**2]))


def test_groups_are_what_pairs_connect():
    keys = [TrackKey(f"r{k}", 0, 0.0) for k in range(7)]
    members = {key: k for k, key in enumerate(keys)}
    members[keys[6]] = 5  # one component of two tracks
    pairs = [(0, 1), (2, 3), (1, 4), (4, 0), (3, 6)]
    groups = groups_of([(keys[a], keys[b]) for a, b in pairs], members)
    assert sorted(map(sorted, groups)) == [[0, 1, 4], [2, 3, 5]]
    assert groups_of([], members) == []


# ---- places of a peer ----

PEER, OTHER = TrackKey("r2", 0, 0.0), TrackKey("r3", 0, 0.0)


def hypothesis(probability: float, x: float, theta: float = 0.0):
    covariance = np.diag([0.04, 0.04, 0.01])
    return probability, {PEER: Relative(np.array([x, 0.0, theta]), covariance, covariance)}


def test_hypotheses_that_put_a_peer_at_one_place_count_together():
    possible = [hypothesis(0.4, 1.0), hypothesis(0.3, 5.0), hypothesis(0.2, 5.3), hypothesis(0.1, 1.2)]
    places = places_of(PEER, possible)
    assert [place.probability for place in places] == pytest.approx([0.495, 0.495])
    assert sorted(place.pose[0] for place in places) == [1.0, 5.0]
    assert places_of(OTHER, possible) == ()


def test_places_are_ordered_and_headings_wrap():
    possible = [hypothesis(0.4, 1.0), hypothesis(0.35, 5.0, np.pi - 0.05), hypothesis(0.25, 5.0, -np.pi + 0.05)]
    places = places_of(PEER, possible)
    assert [place.probability for place in places] == pytest.approx(published(np.array([0.6, 0.4])))
    assert places[0].pose[0] == 5.0
    assert possible[1][1][PEER][0][2] == np.pi - 0.05


def test_published_probabilities_promise_less_and_leave_something_to_no_place():
    for p in (0.6, 0.9, 0.98, 0.999, 1.0):
        best, other = published(np.array([p, 1 - p]))
        assert best + other == pytest.approx(1 - MISSED)
        assert other <= best < p
    # Log odds of 4, known to ±2: the mean of the logistic function over that error, less what may be missed.
    odds = 4.0 + EVIDENCE * np.random.default_rng(0).normal(size=200_000)
    p = 1 / (1 + np.exp(-4.0))
    assert published(np.array([p, 1 - p]))[0] == pytest.approx(
        (1 - MISSED) * np.mean(1 / (1 + np.exp(-odds))), abs=0.02
    )
