"""Links that speak against a hypothesis: most of their readings too short, or too long on many. METHOD §4."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dgorl.expansion.contradicted_links import contradicted
from dgorl.optimization.problem import Loss, Scalars

PLACES = np.array([[0.0, 0.0], [9.0, 0.0], [4.0, 1.0], [5.0, 8.0], [2.0, 6.0]])
BODIES = tuple((f"r{k}",) for k in range(len(PLACES)))
SIGMA = 0.2


def window(rng, places=PLACES, readings=16, nlos=0.0):
    """Every two of five standing robots measure their distance; a share of the readings is metres too long."""
    i, j = np.repeat(np.triu_indices(len(places), 1), readings, axis=1)
    value = np.hypot(*(places[i] - places[j]).T) + SIGMA * rng.normal(size=len(i))
    value += (rng.random(len(i)) < nlos) * rng.exponential(5.0, len(i))
    nothing = np.zeros((len(i), 3))
    found = Scalars("range", i, j, nothing, nothing, np.zeros(len(i)), value, np.full(len(i), SIGMA), Loss("cauchy", 2))
    layout = {keys[0]: (k, 0, 1) for k, keys in enumerate(BODIES)}
    return SimpleNamespace(layout=layout, problem=SimpleNamespace(scalars=(found,)))


def poses(places):
    return np.column_stack([places, np.zeros(len(places))])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("nlos", [0.0, 0.3])
def test_right_places_are_never_contradicted(seed, nlos):
    found = contradicted(window(np.random.default_rng(seed), nlos=nlos), poses(PLACES), BODIES)
    assert not found


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("nlos", [0.0, 0.3])
def test_a_folded_body_is_contradicted(seed, nlos):
    folded = PLACES.copy()
    folded[3, 1] = -8.0
    found = contradicted(window(np.random.default_rng(seed), nlos=nlos), poses(folded), BODIES)
    assert found


def test_one_link_that_is_always_too_long_is_none():
    """Something may stand between two robots all the time; nothing makes ranges shorter."""
    rng = np.random.default_rng(7)
    measured = window(rng)
    (s,) = measured.problem.scalars
    for sign, expected in ((1, False), (-1, True)):
        value = s.value + sign * 3.0 * ((s.i == 1) & (s.j == 4))
        scalars = Scalars(s.kind, s.i, s.j, s.at_i, s.at_j, s.height, value, s.sigma, s.loss)
        changed = SimpleNamespace(layout=measured.layout, problem=SimpleNamespace(scalars=(scalars,)))
        assert bool(contradicted(changed, poses(PLACES), BODIES)) == expected
