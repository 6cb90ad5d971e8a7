"""Large sets in parts, and what a component knows of some of its tracks. METHOD §6."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import se2
from dgorl.expansion.hypotheses import Cluster, Hypothesis
from dgorl.expansion.parts import ENOUGH, EXCERPT, PATIENCE, Parts
from dgorl.expansion.step import LARGEST
from dgorl.marginal import excerpt
from dgorl.tracks import TrackKey
from dgorl.window import Component, Prior, Stretch
from tests.unit.reference import random_information


def key(k: int) -> TrackKey:
    return TrackKey(f"r{k:03d}", 0, 0.0)


def component(*robots: int) -> Component:
    return Component({key(k): Stretch(0, np.zeros((2, 3))) for k in robots})


@st.composite
def sets(draw):
    """Components of 1 to 20 tracks and a connected graph of readings between them."""
    sizes = draw(st.lists(st.one_of(st.just(1), st.integers(1, 20)), min_size=2, max_size=30))
    ends = np.cumsum([0, *sizes])
    components = [component(*range(a, b)) for a, b in pairwise(ends)]
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    pairs = [(int(rng.integers(0, b)), b) for b in range(1, len(sizes))]
    pairs += [tuple(sorted(rng.choice(len(sizes), 2, replace=False))) for _ in range(draw(st.integers(0, 60)))]
    heard = {}
    for a, b in pairs:
        on_a, on_b = (key(int(rng.integers(ends[k], ends[k + 1]))) for k in (a, b))
        heard[on_a, on_b] = int(rng.integers(ENOUGH, 30))
    return components, heard


def chosen(components, heard, previous=(), node=0, stands=lambda cluster, tracks: tracks):
    parts = Parts(components, range(len(components)), heard)
    return list(parts.chosen(previous, node, stands))


@settings(max_examples=200, deadline=None)
@given(sets())
def test_parts_are_small_disjoint_in_singles_and_reach_as_far_as_singles_allow(case):
    components, heard = case
    found = [part for part, _ in chosen(components, heard)]
    assert found
    alone = {k for k, c in enumerate(components) if len(c.tracks) == 1}
    met: list[int] = [k for part in found for k in part if k in alone]
    assert len(met) == len(set(met))
    home = {t: k for k, c in enumerate(components) for t in c.tracks}
    readings: dict[frozenset[int], int] = {}
    for (a, b), count in heard.items():
        pair = frozenset((home[a], home[b]))
        readings[pair] = readings.get(pair, 0) + count
    for part in found:
        assert len(part) >= 2
        assert sum(map(len, part.values())) <= LARGEST
        assert all(keys <= set(components[k].tracks) for k, keys in part.items())
        assert all(len(keys) <= EXCERPT for keys in part.values())
        reached = {min(part)}
        while grown := {k for k in part if any(frozenset((k, o)) in readings for o in reached)} - reached:
            reached |= grown
        assert reached == part.keys()
    # whom nobody's part holds has heard only such as are alone and in a part already
    for pair in readings:
        left = pair - {k for part in found for k in part}
        assert not left or pair - left <= alone
        assert len(left) < 2


@settings(max_examples=50, deadline=None)
@given(sets(), st.integers(0, 2**32))
def test_parts_depend_on_what_was_heard_alone(case, seed):
    components, heard = case
    rows = list(heard.items())
    order = np.random.default_rng(seed).permutation(len(rows))
    assert chosen(components, dict(rows[k] for k in order)) == chosen(components, heard)


def cluster(tracks: list[int], begun: int) -> Cluster:
    whole = component(*tracks)
    return Cluster(0, (), (Hypothesis(whole, 0.0, 1.0, whole, 0.0),), begun=begun)


def test_a_part_goes_on_and_takes_in_whom_it_hears_until_its_patience_ends():
    components = [component(k) for k in range(16)]
    heard = {(key(a), key(b)): 20 - b for a in range(16) for b in range(a + 1, 16)}
    known = cluster([10, 11, 12], begun=3)
    (first, before), *others = chosen(components, heard, [known], 4)
    assert before is known
    assert {10, 11, 12} < first.keys()
    assert len(first) == LARGEST
    assert all(old is None for _, old in others)
    assert all(old is None for _, old in chosen(components, heard, [known], 3 + PATIENCE))


def test_who_no_longer_stands_in_a_part_is_free_for_others():
    components = [component(k) for k in range(14)]
    heard = {(key(a), key(b)): 9 for a in range(14) for b in range(a + 1, 14)}
    known = cluster(list(range(12)), begun=0)
    (first, _), *_ = chosen(components, heard, [known], 1, lambda c, tracks: tracks - {key(0)})
    assert key(0) in {t for part, _ in chosen(components, heard, [known], 1) for keys in part.values() for t in keys}
    assert {key(k) for k in range(1, 12)} <= {t for keys in first.values() for t in keys}


@pytest.mark.parametrize("kept", [(0, 1), (0, 2, 4), (1, 3), (4, 2, 3)])
def test_an_excerpt_keeps_the_relative_poses_and_what_is_known_of_them(kept):
    """Against the dense covariance of all poses, the first one's frame and another's."""
    rng = np.random.default_rng(len(kept))
    poses = rng.normal(size=(5, 3)) * (10.0, 10.0, 1.0)
    relative = se2.between(poses[0], poses[1:])
    information = random_information(rng, 1, 12)[0]
    whole = Component(
        {key(k): Stretch(7, poses[k : k + 1]) for k in range(5)},
        (Prior(7, key(0), tuple(key(k) for k in range(1, 5)), relative, information, np.zeros(12)),),
    )
    (prior,) = excerpt(whole, {key(k) for k in kept}).priors
    order = [int(k.robot[1:]) for k in (prior.reference, *prior.members)]
    assert sorted(order) == sorted(kept)
    np.testing.assert_allclose(prior.relative, se2.between(poses[order[0]], poses[order[1:]]), atol=1e-12)
    jacobian = np.zeros(
        (3 * len(order) - 3, 12)
    )  # of the poses seen from the excerpt's reference, by those seen before
    for row, k in enumerate(order[1:]):
        rows = slice(3 * row, 3 * row + 3)
        if k:
            jacobian[rows, 3 * k - 3 : 3 * k] = np.eye(3)
        if order[0]:
            back = se2.adjoint(se2.between(poses[k], poses[order[0]]))
            jacobian[rows, 3 * order[0] - 3 : 3 * order[0]] -= back
    covariance = jacobian @ np.linalg.inv(information) @ jacobian.T
    np.testing.assert_allclose(np.linalg.inv(prior.information), covariance, rtol=1e-8, atol=1e-10)


def test_an_excerpt_keeps_the_optimum_of_a_prior_that_pulls():
    """The gradient at the linearisation point becomes that of the others at their best."""
    rng = np.random.default_rng(8)
    relative, information, gradient = rng.normal(size=(3, 3)), random_information(rng, 1, 9)[0], rng.normal(size=9)
    whole = Component(
        {key(k): Stretch(0, np.zeros((1, 3))) for k in range(4)},
        (Prior(0, key(0), (key(1), key(2), key(3)), relative, information, gradient),),
    )
    (prior,) = excerpt(whole, {key(0), key(1), key(3)}).priors
    best = -np.linalg.solve(information, gradient).reshape(3, 3)
    found = -np.linalg.solve(prior.information, prior.gradient).reshape(2, 3)
    np.testing.assert_allclose(found, best[[0, 2]], atol=1e-10)


def test_an_excerpt_of_everybody_is_the_component():
    whole = component(1, 2, 3)
    assert excerpt(whole, whole.stretches.keys()) is whole
