"""The core's places of a body, batched costs and evidence, against NumPy. METHOD §4."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import pytest

from dgorl import _core, se2
from tests.unit.reference import HUBER, NONE, rho, rows, team

Array = np.ndarray
seeds = pytest.mark.parametrize("seed", range(3))
PI = np.array([0.01, 0.01, 0.1])
TRUTH = np.array([4.0, -3.0, 2.0])
WIDTH = 2.0

# ---- the reference, written to be read ----

BEARINGS, HEADINGS, FITS = 32, 24, 24
QUANTILES = [NormalDist().inv_cdf((k + 0.5) / 7) for k in (3, 1, 5, 0, 6, 2, 4)]


def cold(anchor: Array) -> Array:
    """Particles T_a_b on the ring d·e^(sN) round the anchor: bearing and heading uniform, distance stratified."""
    a, b, (distance, relative, jitter_bearing, jitter_heading) = anchor[:2], anchor[2:4], anchor[4:]
    found = []
    for k in range(BEARINGS):
        beta = 2 * np.pi * (k + jitter_bearing) / BEARINGS
        for h in range(HEADINGS):
            d = distance * np.exp(relative * round(QUANTILES[(k + 3 * h) % 7], 3))
            theta = se2.wrap(2 * np.pi * (h + jitter_heading) / HEADINGS)
            x, y = a + d * np.array([np.cos(beta), np.sin(beta)]) - se2.rotation(theta) @ b
            found.append([x, y, theta])
    return np.array(found)


def inside(particles: Array, annuli: Array) -> Array:
    """Those in every annulus or, where fewer than an eighth are, those that miss the fewest."""
    hits = np.zeros(len(particles), int)
    for ax, ay, bx, by, height, low, high in annuli:
        d = np.hypot(np.linalg.norm(se2.transform(particles, [bx, by]) - [ax, ay], axis=1), height)
        hits += (d >= low) & (d <= high)
    order = np.argsort(-hits, kind="stable")
    return particles[order[: max(int(np.sum(hits == hits.max())), len(particles) // 8)]]


def diverse(particles: Array, cost: Array, radius: float) -> Array:
    """The cheapest particles, none in the neighbourhood of a cheaper one."""
    kept: list[Array] = []
    for p in particles[np.argsort(cost, kind="stable")[: 8 * FITS]]:
        near = [np.hypot(*(q - p)[:2]) < radius and abs(se2.wrap(q[2] - p[2])) < 0.4 for q in kept]
        if len(kept) < FITS and not any(near):
            kept.append(p)
    return np.array(kept)


def information(residuals: Callable[[Array], Array], pose: Array, kernel: int, width: float) -> Array:
    """H = Jᵀ ρ' J of normalised residuals (M,), Jacobian by differences, right perturbations."""
    steps = 1e-5 * np.eye(3)
    jacobian = [(residuals(se2.compose(pose, d)) - residuals(se2.compose(pose, -d))) / 2e-5 for d in steps]
    weight = np.array([rho(e * e, kernel, width)[1] for e in residuals(pose)])
    return np.einsum("im,m,jm->ij", jacobian, weight, jacobian)


def reference_places(case: Pair, limit: int, warm: Array) -> list[tuple[float, Array, Array]]:
    """Log mass, pose and covariance of the places, best first."""
    particles = inside(np.concatenate([cold(anchor) for anchor in case.anchors]), case.annuli)
    cost = np.array([case.spread.cost([np.zeros(3), p]) for p in particles])
    starts = np.concatenate([warm, diverse(particles, cost, 0.3 * case.anchors[-1][4])])
    both = np.stack([np.zeros_like(starts), starts], axis=1)
    fitted = case.graph.optimize(both, max_iterations=15, step_tolerance=1e-2)
    modes = []
    for pose in fitted.poses[:, 1]:
        cost = sum(rho(e * e, case.kernel, WIDTH)[0] / 2 for e in case.residuals(pose))
        h = information(case.residuals, pose, case.kernel, WIDTH) + np.diag(PI)
        modes.append((-cost - np.linalg.slogdet(h)[1] / 2, pose, np.linalg.inv(h)))
    modes.sort(key=lambda mode: -mode[0])
    kept: list[tuple[float, Array, Array]] = []
    for mass, pose, covariance in modes:
        apart = [se2.between(other, pose) @ np.linalg.solve(c, se2.between(other, pose)) > 9 for _, other, c in kept]
        if all(apart) and mass >= modes[0][0] - 40 and len(kept) < limit:
            kept.append((mass, pose, covariance))
    return kept


# ---- pairs of robots ----


def path(count: int, turn: float) -> Array:
    """Positions (count, 2) of a robot that starts at the origin and turns by ``turn`` [rad] each 0.5 m."""
    x, found = np.zeros(3), []
    for _ in range(count):
        x = se2.compose(x, [0.5, 0.0, turn])
        found.append(x[:2])
    return np.array(found)


@dataclass
class Pair:
    """Ranges between two bodies, TRUTH apart: the core's graph, the same with wide σ, and where to look."""

    graph: _core.Graph
    spread: _core.Graph
    anchors: Array
    annuli: Array
    kernel: int
    residuals: Callable[[Array], Array]

    def find(self, limit: int, warm: Array, **changes: object) -> tuple[Array, Array, Array]:
        parts = {"graph": self.graph, "spread": self.spread, "anchors": self.anchors, "annuli": self.annuli}
        return _core.find_places(**{**parts, "warm": warm, "pi": PI, "limit": limit, **changes})


def pair(turns: tuple[float, float], seed: int, noise: float = 0.1, height: float = 0.0, kernel: int = NONE) -> Pair:
    rng = np.random.default_rng(seed)
    count, sigma = 20, 0.1
    a, b = path(count, turns[0]), path(count, turns[1])

    def distance(T_a_b: Array) -> Array:
        return np.hypot(np.linalg.norm(se2.transform(T_a_b, b) - a, axis=1), height)

    measured = distance(TRUTH) + noise * rng.normal(size=count)
    graphs = []
    for wide in (0.0, 0.5):
        graph = _core.Graph([0, 0], [True, False])
        ends = (np.zeros(count, int), np.ones(count, int), a, b, np.full(count, height))
        graph.add_ranges(*ends, measured, np.full(count, np.hypot(sigma, wide)), kernel, WIDTH)
        graphs.append(graph)
    anchors = [[*a[k], *b[k], measured[k], sigma / measured[k], *rng.uniform(size=2)] for k in (count // 2, count - 1)]
    width = np.exp(3 * (sigma / measured[::3] + 0.15))
    rings = (a[::3], b[::3], np.full(len(width), height), measured[::3] / width, measured[::3] * width)
    return Pair(*graphs, np.array(anchors), np.column_stack(rings), kernel, lambda T: (distance(T) - measured) / sigma)


NOWHERE = np.zeros((0, 3))


@seeds
@pytest.mark.parametrize(
    ("turns", "height", "kernel"),
    [((0.2, -0.1), 0.0, NONE), ((0.0, 0.0), 0.0, NONE), ((0.15, 0.3), 1.5, HUBER), ((0.0, 0.2), 0.0, HUBER)],
    ids=["curved", "straight", "antennas at heights, huber", "one straight"],
)
def test_places_are_those_of_the_reference(turns, height, kernel, seed):
    case = pair(turns, seed, height=height, kernel=kernel)
    warm = np.array([[1.0, 1.0, 1.0], TRUTH])
    poses, mass, covariance = case.find(6, warm)
    expected = reference_places(case, 6, warm)
    assert len(poses) == len(expected) > 0
    for pose, m, c, (mass_expected, pose_expected, c_expected) in zip(poses, mass, covariance, expected, strict=True):
        np.testing.assert_allclose(se2.between(pose_expected, pose), 0, atol=1e-6)
        assert m == pytest.approx(mass_expected, abs=1e-5)
        np.testing.assert_allclose(c, c_expected, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_particles_outside_the_annuli_are_not_tried(side):
    """One reading leaves a ring; an annulus as wide as a half plane the half of it on that side."""
    graph = _core.Graph([0, 0], [True, False])
    graph.add_ranges([0], [1], [[0.0, 0.0]], [[0.0, 0.0]], [0.0], [5.0], [0.1], NONE, 1.0)
    anchors = np.array([[0.0, 0.0, 0.0, 0.0, 5.0, 0.02, 0.5, 0.5]])
    half_plane = np.array([[0.0, 1e4 * side, 0.0, 0.0, 0.0, 0.0, 1e4]])
    pi = np.array([4.0, 4.0, 4.0])
    poses, *_ = _core.find_places(graph, graph, anchors, half_plane, NOWHERE, pi, 20)
    assert len(poses) > 1
    assert (poses[:, 1] * side > 0).all()


@seeds
def test_exact_ranges_of_curved_paths_tell_the_place(seed):
    case = pair((0.2, -0.1), seed, noise=0.0)
    poses, mass, _ = case.find(5, NOWHERE)
    np.testing.assert_allclose(se2.between(TRUTH, poses[0]), 0, atol=1e-3)
    assert len(mass) == 1 or mass[0] - mass[1] > 5
    assert (np.diff(mass) <= 0).all()


@seeds
def test_exact_ranges_of_straight_paths_leave_every_mirror_image(seed):
    """Two robots straight at constant speed: four places, two of them the mirror images of the others. METHOD §3."""
    case = pair((0.0, 0.0), seed, noise=0.0)
    poses, mass, _ = case.find(8, NOWHERE)
    assert len(poses) >= 4
    assert np.abs(se2.between(TRUTH, poses[:4])).max(axis=1).min() < 1e-2
    for place, m in zip(poses[:4], mass[:4], strict=True):
        images = np.abs(se2.between(place * [1.0, -1.0, -1.0], poses)).max(axis=1)
        assert images.min() < 1e-2
        assert mass[np.argmin(images)] == pytest.approx(m, abs=1e-3)


def test_no_more_than_the_limit_and_no_place_twice():
    case = pair((0.0, 0.0), 1)
    poses, _, covariance = case.find(20, NOWHERE)
    for k, (pose, c) in enumerate(zip(poses, covariance, strict=True)):
        difference = se2.between(pose, poses[k + 1 :])
        assert (np.einsum("ki,ij,kj->k", difference, np.linalg.inv(c), difference) > 9).all()
    for limit in range(1, len(poses) + 1):
        fewer, *_ = case.find(limit, NOWHERE)
        np.testing.assert_array_equal(fewer, poses[:limit])


def test_warm_starts_alone_are_fitted_and_merged():
    case = pair((0.2, -0.1), 0, noise=0.0)
    warm = se2.compose(TRUTH, np.random.default_rng(0).normal(size=(5, 3)) * 0.05)
    poses, _, _ = case.find(5, warm, anchors=np.zeros((0, 8)))
    assert poses.shape == (1, 3)
    np.testing.assert_allclose(se2.between(TRUTH, poses[0]), 0, atol=1e-3)


def test_nothing_to_start_from_finds_nothing():
    case = pair((0.2, -0.1), 0)
    found = case.find(5, NOWHERE, anchors=np.zeros((0, 8)), annuli=np.zeros((0, 7)))
    assert [part.shape for part in found] == [(0, 3), (0,), (0, 3, 3)]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("graph", _core.Graph([0, 0, 0], [True, False, False])),
        ("graph", _core.Graph([0, 0], [False, True])),
        ("spread", _core.Graph([0, 0], [True, True])),
        ("anchors", np.zeros((1, 7))),
        ("anchors", np.full((1, 8), np.nan)),
        ("annuli", np.zeros((2, 8))),
        ("annuli", np.full((1, 7), np.inf)),
        ("warm", np.zeros(3)),
        ("warm", np.array([[0.0, np.nan, 0.0]])),
        ("pi", np.zeros(2)),
        ("limit", 0),
    ],
)
def test_errors_name_the_argument(name, value):
    case = pair((0.2, -0.1), 0)
    with pytest.raises(ValueError, match=name):
        case.find(**{"limit": 5, "warm": NOWHERE, name: value})


# ---- costs and evidence ----


@seeds
def test_costs_are_the_cost_of_each(seed):
    rng = np.random.default_rng(seed)
    twin = team(rng, robots=2, steps=3)
    starts = twin.poses + 0.2 * rng.normal(size=(5, *twin.poses.shape))
    np.testing.assert_array_equal(twin.core.costs(starts), [twin.core.cost(start) for start in starts])
    np.testing.assert_allclose(twin.core.costs(starts), [twin.reference.cost(start) for start in starts], rtol=1e-9)
    assert twin.core.costs(starts[:0]).shape == (0,)
    with pytest.raises(ValueError, match="poses"):
        twin.core.costs(starts[0])


@pytest.mark.parametrize(("gauge", "seed"), [("pose", 0), ("world", 1), ("none", 2)])
def test_evidence_is_that_of_dense_algebra(gauge, seed):
    """log det(H + Π) and the joint covariance; Π on a fixed pose has no effect, in no gauge it makes H proper."""
    rng = np.random.default_rng(seed)
    twin = team(rng, robots=2, steps=3, gauge=gauge)
    soft = rng.permutation(len(twin.poses))[:4]
    if twin.reference.fixed.any() and not twin.reference.fixed[soft].any():
        soft[0] = int(np.flatnonzero(twin.reference.fixed)[0])
    pi = rng.uniform(0.5, 2.0, (len(soft), 3))
    select = rng.permutation(len(twin.poses))[:3]
    starts = twin.poses + 0.1 * rng.normal(size=(2, *twin.poses.shape)) * ~twin.reference.fixed[:, None]
    logdet, covariance = twin.core.evidence(starts, select, soft, pi)
    assert logdet.shape == (2,)
    assert covariance.shape == (2, 9, 9)
    for poses, found, joint in zip(starts, logdet, covariance, strict=True):
        h, _ = twin.reference.all_normal_equations(poses, twin.reference.factors)
        h[rows(soft), rows(soft)] += pi.ravel()
        free = twin.reference.free
        inverse = np.zeros_like(h)
        inverse[np.ix_(free, free)] = np.linalg.inv(h[np.ix_(free, free)])
        sign, expected = np.linalg.slogdet(h[np.ix_(free, free)])
        assert sign > 0
        assert found == pytest.approx(expected, rel=1e-8)
        np.testing.assert_allclose(joint, inverse[np.ix_(rows(select), rows(select))], rtol=1e-5, atol=1e-8)


def test_a_pose_that_nothing_determines_has_no_evidence():
    graph = _core.Graph([0, 0, 0], [True, False, False])
    graph.add_odometry([], [], np.zeros((0, 3)), np.zeros((0, 3, 3)))
    graph.add_relative_poses([0], [1], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3)[None])
    poses = np.zeros((1, 3, 3))
    with pytest.raises(ValueError, match="pose 2"):
        graph.evidence(poses, [1], [1], np.ones((1, 3)))
    logdet, covariance = graph.evidence(poses, [1, 2], [2], np.full((1, 3), 4.0))
    assert logdet[0] == pytest.approx(3 * np.log(4.0))
    np.testing.assert_allclose(covariance[0], np.diag([1, 1, 1, 0.25, 0.25, 0.25]), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("poses", np.zeros((3, 3))),
        ("poses", np.full((1, 3, 3), np.nan)),
        ("select", [7]),
        ("soft", [-1]),
        ("information", np.ones((2, 3))),
    ],
)
def test_errors_of_evidence_name_the_argument(name, value):
    graph = _core.Graph([0, 0, 0], [True, False, False])
    good = {"poses": np.zeros((1, 3, 3)), "select": [1], "soft": [1], "information": np.ones((1, 3))}
    with pytest.raises(ValueError, match=name):
        graph.evidence(**{**good, name: value})
