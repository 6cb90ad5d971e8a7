"""Readings between rigid bodies, thinned, their σ with odometry noise; the mirror image of bodies. METHOD §4."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dgorl import se2
from dgorl.expansion import drafts, folds
from dgorl.expansion.bodies import BINS, CORRELATED, SHORTEST_BIN, Drift, body_graph, drift, sightings, slopes
from dgorl.optimization.problem import Loss, Problem, Scalars

Array = np.ndarray
RADIO = (-38.0, 2.7)
COUNT = 40
"""Poses of each of two tracks."""


def problem(*scalars: Scalars, sigma: float = 0.0) -> Problem:
    """Two tracks, straight along x and along y; odometry σ of position and heading per step."""
    along = 0.25 * np.arange(COUNT)
    a = np.column_stack([along, np.zeros(COUNT), np.zeros(COUNT)])
    b = np.column_stack([np.zeros(COUNT), along, np.full(COUNT, np.pi / 2)])
    i = np.concatenate([np.arange(COUNT - 1), COUNT + np.arange(COUNT - 1)])
    information = np.broadcast_to(np.eye(3) / max(sigma, 1e-9) ** 2, (len(i), 3, 3))
    odometry = (i, i + 1, np.tile([0.25, 0.0, 0.0], (len(i), 1)), information)
    fixed = np.arange(2 * COUNT) == 0
    slots = np.tile(np.arange(COUNT), 2)
    return Problem(slots, fixed, np.concatenate([a, b]), odometry, tuple(scalars), radio=RADIO)


def readings(rng: np.random.Generator, kind: str, per_pose: int = 1, swap: float = 0.5) -> tuple[Scalars, Array]:
    """Readings between the tracks in either direction, at offsets of their own; and their stamps."""
    k = np.repeat(np.arange(COUNT), per_pose)
    turned = rng.random(len(k)) < swap
    i, j = np.where(turned, COUNT + k, k), np.where(turned, k, COUNT + k)
    at_i, at_j = 0.1 * rng.normal(size=(2, len(k), 3))
    low, high = {"range": (3, 9), "rssi": (-65, -50), "bearing": (-3, 3)}[kind]
    value, sigma = rng.uniform(low, high, len(k)), rng.uniform(0.1, 0.3, len(k))
    height = np.zeros(len(k)) if kind == "bearing" else rng.normal(size=len(k))
    return Scalars(kind, i, j, at_i, at_j, height, value, sigma, Loss("none", 1.0)), k / 2


BODY = np.repeat([0, 1], COUNT)
TRACKS = [(0, COUNT), (COUNT, COUNT)]


@pytest.mark.parametrize("kind", ["range", "rssi"])
def test_readings_of_a_bin_are_averaged(kind):
    """Means of points, heights and values; σ falls with the root of their number; i is the lower body."""
    rng = np.random.default_rng(0)
    s, stamps = readings(rng, kind, per_pose=2)
    p = problem(s)
    (found,) = sightings(p, (stamps,), BODY, p.initial, drift(p, TRACKS))
    assert (found.i == 0).all()
    assert (found.j == 1).all()
    width = max(np.ptp(stamps) / BINS, SHORTEST_BIN)
    bins = np.floor(stamps / width).astype(int)
    assert len(found.value) == len(set(bins)) < len(stamps)
    end_i, end_j = se2.compose(p.initial[s.i], s.at_i), se2.compose(p.initial[s.j], s.at_j)
    forward = (s.i < s.j)[:, None]
    on_a, on_b = np.where(forward, end_i, end_j), np.where(forward, end_j, end_i)
    for row, b in enumerate(sorted(set(bins))):
        of = bins == b
        np.testing.assert_allclose(found.value[row], s.value[of].mean())
        np.testing.assert_allclose(found.point_i[row], on_a[of].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(found.point_j[row], on_b[of].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(found.height[row], s.height[of].mean())
        np.testing.assert_allclose(found.sigma[row], np.sqrt(np.sum(s.sigma[of] ** 2)) / of.sum(), rtol=1e-6)
    meant = found.value if kind == "range" else 10 ** ((RADIO[0] - found.value) / (10 * RADIO[1]))
    np.testing.assert_allclose(found.distance, meant)
    expected = 1.0 if kind == "range" else 10 * RADIO[1] / np.log(10) / meant
    np.testing.assert_allclose(found.slope, np.broadcast_to(expected, len(meant)))


def test_bearings_keep_one_a_bin_and_their_observer():
    rng = np.random.default_rng(1)
    s, stamps = readings(rng, "bearing")
    p = problem(s)
    (found,) = sightings(p, (stamps,), BODY, p.initial, drift(p, TRACKS))
    assert {(0, 1), (1, 0)} == set(zip(found.i.tolist(), found.j.tolist(), strict=True))
    for i, value, sigma, point in zip(found.i, found.value, found.sigma, found.point_i, strict=True):
        (of,) = np.flatnonzero((s.value == value) & (BODY[s.i] == i))
        assert sigma == pytest.approx(s.sigma[of])
        np.testing.assert_allclose(point, se2.compose(p.initial[s.i[of]], s.at_i[of]))
    assert np.isnan(found.distance).all()


def test_readings_inside_a_body_or_of_none_do_not_count():
    rng = np.random.default_rng(2)
    s, stamps = readings(rng, "range")
    p = problem(s)
    noise = drift(p, TRACKS)
    assert sightings(p, (stamps,), np.zeros_like(BODY), p.initial, noise) == []
    assert sightings(p, (stamps,), np.where(BODY == 0, 0, -1), p.initial, noise) == []


def test_drift_adds_up_along_each_track():
    p = problem(sigma=0.1)
    found = drift(p, TRACKS)
    for first, count in TRACKS:
        np.testing.assert_allclose(found.position[first : first + count], 0.01 * np.arange(count), atol=1e-12)
        np.testing.assert_allclose(found.heading[first : first + count], 0.01 * np.arange(count), atol=1e-12)
        assert (found.middle[first : first + count] == first + count // 2).all()


@pytest.mark.parametrize("kind", ["range", "rssi"])
def test_odometry_noise_is_in_the_sigma(kind):
    """Least where both tracks are in their middle, growing outwards; of RSSI in dB."""
    rng = np.random.default_rng(3)
    s, stamps = readings(rng, kind, swap=0.0)
    p = problem(s)
    quiet = drift(p, TRACKS)
    growth = 0.01 * np.arange(COUNT)
    noisy = Drift(np.tile(growth, 2), np.zeros(2 * COUNT), quiet.middle)
    (plain,) = sightings(p, (stamps,), BODY, p.initial, quiet)
    (wide,) = sightings(p, (stamps,), BODY, p.initial, noisy)
    more = (wide.sigma**2 - plain.sigma**2) / plain.slope**2
    width = max(np.ptp(stamps) / BINS, SHORTEST_BIN)
    bins = np.floor(stamps / width).astype(int)
    from_middle = np.abs(growth - growth[COUNT // 2])
    expected = [2 * CORRELATED * from_middle[bins == b].mean() for b in sorted(set(bins))]
    np.testing.assert_allclose(more, expected, atol=1e-9)


def test_heading_noise_swings_what_is_far_from_the_middle():
    rng = np.random.default_rng(4)
    s, stamps = readings(rng, "range", swap=0.0)
    p = problem(s)
    quiet = drift(p, TRACKS)
    turning = Drift(quiet.position, np.tile(0.01 * np.arange(COUNT), 2), quiet.middle)
    (plain,) = sightings(p, (stamps,), BODY, p.initial, quiet)
    (wide,) = sightings(p, (stamps,), BODY, p.initial, turning)
    more = wide.sigma**2 - plain.sigma**2
    assert more[len(more) // 2] < 0.01 * more[0]
    assert more[0] == pytest.approx(2 * CORRELATED * 0.2 * (0.25 * COUNT / 2) ** 2 / 2, rel=0.1)


@pytest.mark.parametrize("kind", ["range", "rssi", "bearing"])
def test_slopes_are_derivatives(kind):
    distance = np.array([2.0, 5.0, 8.0])
    if kind == "bearing":
        expected = np.full(3, 1 / 5)
    else:
        value = (lambda d: d) if kind == "range" else (lambda d: -RADIO[0] + 10 * RADIO[1] * np.log10(d))
        expected = (value(distance + 1e-6) - value(distance - 1e-6)) / 2e-6
    np.testing.assert_allclose(slopes(kind, distance, RADIO), expected, rtol=1e-6)


@pytest.mark.parametrize("kind", ["range", "rssi", "bearing"])
def test_the_graph_of_bodies_weighs_sightings_by_their_sigma(kind):
    """½ Σ (e/σ)² of the sightings at given places, and inflation [m²] widens σ by the slope."""
    rng = np.random.default_rng(5)
    s, stamps = readings(rng, kind)
    p = problem(s)
    (found,) = sightings(p, (stamps,), BODY, p.initial, drift(p, TRACKS))
    places = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 0.7]])
    end_i, end_j = se2.compose(places[found.i], found.point_i), se2.compose(places[found.j], found.point_j)
    d = np.hypot(np.linalg.norm((end_i - end_j)[:, :2], axis=1), found.height)
    if kind == "bearing":
        seen = se2.between(end_i, end_j)
        e = se2.wrap(np.arctan2(seen[:, 1], seen[:, 0]) - found.value)
    else:
        e = (d if kind == "range" else RADIO[0] - 10 * RADIO[1] * np.log10(d)) - found.value
    inflate = rng.uniform(0, 2, len(e))
    for more in (None, inflate):
        sigma = np.sqrt(found.sigma**2 + (0 if more is None else found.slope**2 * more))
        cost = body_graph([found], 2, RADIO, more).cost(places)
        assert cost == pytest.approx(np.sum((e / sigma) ** 2) / 2, rel=1e-9)


# ---- the mirror image ----


def shapes_of(starts: Array, reverse: tuple[bool, ...], curve: float = 0.0) -> drafts.Shapes:
    """Straight paths of 10 poses from ``starts`` (m, 3), driven forwards or backwards."""
    poses = []
    for start, back in zip(starts, reverse, strict=True):
        step = [-0.5 if back else 0.5, 0.0, curve]
        path = [start]
        for _ in range(9):
            path.append(se2.compose(path[-1], step))
        poses += path
    body = np.repeat(np.arange(len(starts)), 10)
    cluster = SimpleNamespace(
        body=body, bodies=tuple((k,) for k in range(len(starts))), window=SimpleNamespace(world=None)
    )
    return drafts.Shapes(cluster, np.array(poses), None, (0, 0), [])


@pytest.mark.parametrize("reverse", [(False,) * 3, (True, False, True)])
@pytest.mark.parametrize("seed", range(4))
def test_the_mirror_image_is_one_in_the_references_line(seed, reverse):
    rng = np.random.default_rng(seed)
    starts = np.column_stack([rng.uniform(-9, 9, (3, 2)), rng.uniform(-np.pi, np.pi, 3)])
    shapes = shapes_of(starts, reverse)
    (image,) = shapes.starts(folds.mirrored(shapes))
    own = shapes.cluster.body == 0
    np.testing.assert_allclose(se2.between(shapes.poses[own], image[own]), 0, atol=1e-9)
    before, after = se2.between(starts[0], shapes.poses), se2.between(starts[0], image)
    np.testing.assert_allclose(after[:, :2], before[:, :2] * [1, -1], atol=1e-9)
    np.testing.assert_allclose(se2.wrap(after[:, 2] + before[:, 2]), 0, atol=1e-9)
    assert np.abs(before[~own, 1]).max() > 0.5


def test_curved_bodies_keep_their_curve():
    """Odometry tells left from right: a body in the mirror image's place is not mirrored itself."""
    starts = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0]])
    shapes = shapes_of(starts, (False, False), curve=0.1)
    (image,) = shapes.starts(folds.mirrored(shapes))
    motion = se2.between(image[10:19], image[11:20])
    np.testing.assert_allclose(motion, np.tile([0.5, 0.0, 0.1], (9, 1)), atol=1e-9)
    # The middle of its path is where the mirror image has it: on the other side of the reference's line.
    axis = np.linalg.svd(shapes.poses[:10, :2] - shapes.poses[:10, :2].mean(axis=0))[2][0]
    normal, middle = np.array([-axis[1], axis[0]]), shapes.poses[:10, :2].mean(axis=0)
    sides = [(path[10:, :2].mean(axis=0) - middle) @ normal for path in (shapes.poses, image)]
    assert sides[1] == pytest.approx(-sides[0], abs=1e-9)


def test_drafts_leave_the_world_where_it_is():
    """Starts of a window with the world are seen from the world's body."""
    starts = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0]])
    shapes = shapes_of(starts, (False, False))
    shapes.cluster.window.world = 10  # the first pose of body 1 stands for it
    draft = np.array([[[1.0, 2.0, 0.3], [-4.0, 5.0, -1.0]]])
    (found,) = shapes.starts(draft)
    np.testing.assert_allclose(found[10:], shapes.poses[10:], atol=1e-12)
    expected = se2.compose(se2.between(draft[0, 1], draft[0, 0]), shapes.poses[:10])
    np.testing.assert_allclose(found[:10], expected, atol=1e-12)
