"""Who is contradicted since when: carried robots since they were, honest ones never, walls or not. METHOD §4, break."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import t as student

from dgorl.consistency import TAIL, chi2_limit
from dgorl.contradictions import BEGINS, COMPARED, Contradiction, contradictions, tail, without_worst
from dgorl.optimization.problem import Loss, Problem, Scalars
from dgorl.tracks import TrackKey
from dgorl.window import Window

PLACES = np.array([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0], [8.0, 9.0], [4.0, 15.0]])
KEYFRAMES = 60
NOW = KEYFRAMES / 2
NAMES = [TrackKey(f"r{k + 1}", 0, 0.0) for k in range(len(PLACES))]
SIGMA = 0.2


def standing(rng: np.random.Generator, off: np.ndarray, robots: int = 5) -> tuple[Window, np.ndarray]:
    """Robots that stand still; every pair measures once in 0.5 s; off (pairs, KEYFRAMES): by how much too long [m]."""
    poses = np.zeros((robots * KEYFRAMES, 3))
    poses[:, :2] = np.repeat(PLACES[:robots], KEYFRAMES, axis=0)
    rows = []
    for row, (a, b) in zip(off, combinations(range(robots), 2), strict=True):
        true = np.hypot(*(PLACES[a] - PLACES[b]))
        for k, excess in enumerate(row):
            stamp = (k + rng.uniform(0.1, 0.9)) / 2
            rows.append((stamp, a * KEYFRAMES + k, b * KEYFRAMES + k, true + excess + SIGMA * rng.normal()))
    stamp, i, j, value = np.array(sorted(rows)).T
    still = np.zeros((len(i), 3))
    ends = (i.astype(np.int64), j.astype(np.int64), still, still)
    ranges = Scalars("range", *ends, np.zeros(len(i)), value, np.full(len(i), SIGMA), Loss("cauchy", 2.0))
    none = np.zeros(0, np.int64)
    odometry = (none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    slots = np.tile(np.arange(KEYFRAMES), robots)
    problem = Problem(slots, np.zeros(len(slots), bool), poses, odometry, (ranges,))
    layout = {key: (k * KEYFRAMES, 0, KEYFRAMES) for k, key in enumerate(NAMES[:robots])}
    return Window(problem, layout, None, 0, (stamp,)), poses


def accused(window: Window, poses: np.ndarray) -> list[Contradiction]:
    """Beyond what chance exceeds at one node in 10⁴, the worst first."""
    limit = TAIL / len(window.layout) / BEGINS
    excess = [(c.total / chi2_limit(c.dof, limit), c) for c in contradictions(window, poses, NOW)]
    return [c for e, c in sorted(excess, key=lambda found: -found[0]) if e > 1.0]


def carried_by(motion: tuple[float, float], since: int, robots: int) -> np.ndarray:
    """By how much the ranges of the last robot are off after it was carried, if it still counts where it was."""
    pairs = list(combinations(range(robots), 2))
    off = np.zeros((len(pairs), KEYFRAMES))
    for row, (a, b) in zip(off, pairs, strict=True):
        if b == robots - 1:
            apart = PLACES[b] - PLACES[a]
            row[since:] = np.hypot(*(apart + motion)) - np.hypot(*apart)
    return off


@pytest.mark.parametrize("ago", [1, 2, 5, 9, 16])
@pytest.mark.parametrize(("motion", "robots"), [((9.0, 8.0), 5), ((-12.0, 9.0), 5), ((6.0, 9.0), 4), ((9.0, 12.0), 3)])
def test_who_was_carried_is_contradicted_since_then(motion, robots, ago):
    """Also half a second before the node, by two or three readings."""
    since = KEYFRAMES - ago
    for seed in range(5):
        found = accused(*standing(np.random.default_rng(seed), carried_by(motion, since, robots), robots))
        assert found[0].since == since
        if robots > 3:  # of three, both others fit as badly: who leaves the others well off is asked then
            assert {c.key for c in found} == {NAMES[robots - 1]}


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.3])
def test_walls_accuse_nobody(share):
    """Readings too long at random times, by 5 m on average."""
    named = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        off = np.where(rng.uniform(size=(10, KEYFRAMES)) < share, rng.exponential(5.0, (10, KEYFRAMES)), 0.0)
        named += bool(accused(*standing(rng, off)))
    assert named == 0


def test_a_wall_between_two_robots_accuses_neither():
    for seed in range(10):
        off = np.zeros((10, KEYFRAMES))
        off[3, -8:] = 4.0
        assert not accused(*standing(np.random.default_rng(seed), off))


def test_one_reading_says_nothing():
    off = np.zeros((1, KEYFRAMES))
    off[0, -1] = 20.0
    assert not accused(*standing(np.random.default_rng(0), off, 2))


def test_a_sighting_is_one_reading_whatever_it_measures():
    """A camera that takes one robot for another is wrong about its range and its bearing at once."""
    off = np.zeros((3, KEYFRAMES))
    off[0, -1] = 20.0
    window, poses = standing(np.random.default_rng(0), off, 3)
    (ranges,) = window.problem.scalars
    twice = replace(window.problem, scalars=(ranges, ranges))
    both = replace(window, problem=twice, stamps=2 * window.stamps)
    assert [c.dof for c in contradictions(both, poses, NOW)] == [c.dof for c in contradictions(window, poses, NOW)]
    assert not accused(both, poses)


def test_too_little_to_compare_with_says_nothing():
    """How often readings of this team are off nobody knows yet."""
    rng = np.random.default_rng(0)
    off = carried_by((5.0, 6.0), KEYFRAMES - 4, 3)
    window, poses = standing(rng, off, 3)
    (ranges,) = window.problem.scalars
    assert accused(window, poses)
    last = np.argsort(window.stamps[0])[-(COMPARED // 2) :]
    few = {name: getattr(ranges, name)[last] for name in ("i", "j", "at_i", "at_j", "height", "value", "sigma")}
    problem = Problem(
        window.problem.slots,
        window.problem.fixed,
        poses,
        window.problem.odometry,
        (Scalars("range", loss=ranges.loss, **few),),
    )
    assert not list(contradictions(Window(problem, window.layout, None, 0, (window.stamps[0][last],)), poses, NOW))


def test_no_readings():
    window, poses = standing(np.random.default_rng(0), np.zeros((1, KEYFRAMES)), 2)
    empty = Problem(window.problem.slots, window.problem.fixed, poses, window.problem.odometry)
    assert not list(contradictions(Window(empty, window.layout, None, 0), poses, NOW))


def test_the_tail_is_that_of_the_kernel():
    """The density exp(−ρ) of a Cauchy kernel of width 2σ is Student's t of 3, stretched."""
    size = np.array([0.0, 0.3, 1.0, 3.0, 20.0, 100.0, 5e3])
    np.testing.assert_allclose(tail(size), 2 * student.sf(size * np.sqrt(3) / 2, 3), rtol=1e-3, atol=1e-12)
    assert 0 <= tail(np.array([np.inf]))[0] < 1e-11


@pytest.mark.parametrize(("count", "kept"), [(0, 0), (1, 1), (2, 2), (3, 2), (4, 3), (9, 6)])
def test_the_worst_third_is_left_out(count, kept):
    values = np.random.default_rng(count).permutation(np.arange(count, dtype=float))
    assert without_worst(values) == (sum(range(kept)), kept)
