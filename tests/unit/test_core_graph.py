"""The whole core against the reference: optimum, covariance, marginals, gauge, batches. METHOD §1, §5."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import _core, se2
from tests.unit.reference import retract, rows, team

Array = np.ndarray
GAUGES = ["pose", "world", "prior"]
seeds = pytest.mark.parametrize("seed", range(3))


@seeds
@pytest.mark.parametrize("gauge", GAUGES)
def test_optimum_and_covariance_match_the_reference(gauge: str, seed: int) -> None:
    # Small residuals, with which plain Gauss–Newton of the reference converges fast.
    twin = team(np.random.default_rng(seed), gauge=gauge, noise=0.3)
    select = np.random.default_rng(seed).permutation(len(twin.poses))[:5]
    found = twin.core.solve(twin.poses, select)
    best = twin.reference.optimize(twin.poses)
    assert found.reason == ["converged"]
    np.testing.assert_allclose(se2.between(best, found.poses[0]), 0, atol=1e-8)
    assert found.cost[0] == pytest.approx(twin.reference.cost(best), rel=1e-10)
    expected = twin.reference.covariance(best, select)
    np.testing.assert_allclose(found.covariance, expected, atol=1e-8 * np.abs(expected).max())
    again = twin.core.covariance(found.poses[0], select)
    np.testing.assert_allclose(found.covariance, again, atol=1e-9 * np.abs(again).max())


@seeds
@pytest.mark.parametrize("gauge", GAUGES)
def test_optimum_with_large_residuals_is_one_of_the_reference(gauge: str, seed: int) -> None:
    twin = team(np.random.default_rng(seed), gauge=gauge)
    found = twin.core.optimize(twin.poses[None])
    assert found.reason == ["converged"]
    np.testing.assert_allclose(twin.reference.step(found.poses[0]), 0, atol=1e-7)


@seeds
@pytest.mark.parametrize("gauge", GAUGES)
def test_hessian_and_step_match_the_reference(gauge: str, seed: int) -> None:
    twin = team(np.random.default_rng(seed), gauge=gauge, steps=4)
    for mine, theirs in zip(twin.core.hessian(twin.poses), twin.reference.normal_equations(twin.poses), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-9 * np.abs(theirs).max())
    hessian, gradient = twin.core.hessian(twin.poses)
    step = twin.core.gauss_newton_step(twin.poses)
    np.testing.assert_allclose(hessian @ step.ravel()[twin.reference.free], -gradient, atol=1e-7)
    assert not step[twin.reference.fixed].any()


@pytest.mark.parametrize("robots", [8, 36, 43], ids=["tiles", "large panels", "their borders"])
def test_solver_matches_dense_algebra(robots: int) -> None:
    """Blocks of 24 and of 108 variables, the second past the size from which another kernel works."""
    twin = team(np.random.default_rng(5), robots=robots, steps=4)
    hessian, gradient = twin.core.hessian(twin.poses)
    free = twin.reference.free
    inverse = np.linalg.inv(hessian)
    full = np.zeros((twin.poses.size, twin.poses.size))
    full[np.ix_(free, free)] = inverse
    everything = twin.core.covariance(twin.poses, np.arange(len(twin.poses)))
    np.testing.assert_allclose(everything, full, atol=1e-9 * np.abs(full).max())
    step = twin.core.gauss_newton_step(twin.poses).ravel()[free]
    np.testing.assert_allclose(step, -inverse @ gradient, atol=1e-9 * np.abs(step).max())


@seeds
def test_optimum_of_the_core_is_stationary_from_far_starts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    twin = team(rng, gauge="world")
    far = retract(twin.poses, rng.normal(size=(20, *twin.poses.shape)) * [2.0, 2.0, 0.8])
    far[:, twin.reference.fixed] = twin.poses[twin.reference.fixed]
    found = twin.core.optimize(far, max_iterations=300)
    converged = np.array(found.reason) == "converged"
    assert converged.sum() >= 18
    for poses, cost, start in zip(found.poses[converged], found.cost[converged], far[converged], strict=True):
        hessian, gradient = twin.core.hessian(poses, exact=True)
        assert np.abs(gradient).max() < 1e-5
        assert np.linalg.eigvalsh(hessian)[0] > -1e-6
        assert cost <= twin.core.cost(start)
        assert cost == pytest.approx(twin.core.cost(poses), rel=1e-12)


@seeds
def test_batch_equals_single_and_repeats_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    twin = team(rng)
    starts = np.where(
        twin.reference.fixed[:, None],
        twin.poses,
        retract(twin.poses, 0.3 * rng.normal(size=(6, *twin.poses.shape))),
    )
    batch, again = twin.core.optimize(starts), twin.core.optimize(starts)
    np.testing.assert_array_equal(batch.poses, again.poses)
    rebuilt = team(np.random.default_rng(seed)).core
    for k, start in enumerate(starts):
        single = rebuilt.solve(start, [0, 1])
        np.testing.assert_array_equal(single.poses[0], batch.poses[k])
        assert (single.cost[0], single.iterations[0], single.reason[0]) == (
            batch.cost[k],
            batch.iterations[k],
            batch.reason[k],
        )
        np.testing.assert_array_equal(single.covariance, twin.core.solve(start, [0, 1]).covariance)


def test_order_of_the_poses_does_not_matter() -> None:
    plain, shuffled = (team(np.random.default_rng(2), permute=p) for p in (False, True))
    assert sorted(plain.core.solve(plain.poses, []).poses[0, :, 0]) != []
    for twin in (plain, shuffled):
        best = twin.core.solve(twin.poses, [])
        assert best.reason == ["converged"]
        assert best.covariance.shape == (0, 0)


@seeds
def test_gauge_does_not_change_relative_poses(seed: int) -> None:
    """Without a gauge the optimiser finds the same relative poses, wherever the whole team stands."""
    twin = team(np.random.default_rng(seed), gauge="pose")
    loose = team(np.random.default_rng(seed), gauge="none")
    moved = se2.compose([30.0, -20.0, 2.0], twin.poses)
    pinned, free = twin.core.optimize(twin.poses[None]), loose.core.optimize(moved[None])
    assert free.reason == ["converged"]
    assert free.cost[0] == pytest.approx(pinned.cost[0], rel=1e-9)
    np.testing.assert_allclose(
        se2.between(se2.between(pinned.poses[0, 0], pinned.poses[0]), se2.between(free.poses[0, 0], free.poses[0])),
        0,
        atol=1e-7,
    )
    assert loose.core.cost(moved) == pytest.approx(loose.core.cost(twin.poses), rel=1e-10)
    with pytest.raises(ValueError, match=r"leaves pose \d+ undetermined"):
        loose.core.covariance(moved, [0])


@seeds
@pytest.mark.parametrize("steps", [5, 60])
def test_singular_graph_is_refused(steps: int, seed: int) -> None:
    loose = team(np.random.default_rng(seed), gauge="none", steps=steps)
    for call in (
        lambda: loose.core.solve(loose.poses, [0]),
        lambda: loose.core.gauss_newton_step(loose.poses),
    ):
        with pytest.raises(ValueError, match=r"leaves pose \d+ undetermined"):
            call()


def test_a_pose_without_factors_fails_clearly() -> None:
    graph = _core.Graph([0, 0], [True, False])
    assert graph.optimize(np.zeros((1, 2, 3))).reason == ["failed"]
    with pytest.raises(ValueError, match="leaves pose 1 undetermined"):
        graph.solve(np.zeros((2, 3)), [1])


def test_graph_of_fixed_poses_only() -> None:
    graph = _core.Graph([-1, 0], [True, True])
    graph.add_odometry([0], [1], [[1.0, 0, 0]], np.eye(3)[None])
    found = graph.solve(np.zeros((2, 3)), [0, 1])
    assert found.reason == ["converged"]
    assert found.cost[0] == 0.5
    assert not found.covariance.any()


def test_iterations_and_tolerance_are_respected() -> None:
    twin = team(np.random.default_rng(0))
    stopped = twin.core.optimize(twin.poses[None], max_iterations=1)
    assert (stopped.reason, stopped.iterations[0]) == (["max_iterations"], 1)
    untouched = twin.core.optimize(twin.poses[None], max_iterations=0)
    np.testing.assert_array_equal(untouched.poses[0], twin.poses)
    coarse, fine = (twin.core.optimize(twin.poses[None], step_tolerance=t) for t in (1e-2, 1e-10))
    assert coarse.iterations[0] < fine.iterations[0]


def test_converges_quadratically() -> None:
    """Second derivatives are used near the optimum: residuals of several σ cost no further iterations."""
    twin = team(np.random.default_rng(1), noise=2.0, kernels=False)
    best = twin.core.optimize(twin.poses[None]).poses[0]
    rng = np.random.default_rng(0)
    start = np.where(twin.reference.fixed[:, None], best, retract(best, 1e-3 * rng.normal(size=best.shape)))
    assert twin.core.optimize(start[None]).iterations[0] <= 4


# ---- marginalisation ----


@seeds
@pytest.mark.parametrize("gauge", ["none", "pose", "world"])
def test_marginal_is_the_schur_complement(gauge: str, seed: int) -> None:
    """Against the dense Schur complement of the reference's factors that touch an eliminated pose."""
    twin = team(np.random.default_rng(seed), gauge=gauge)
    slot = 13  # of 7, 9, 11, 13, 15
    slots = twin.slots
    gone = np.flatnonzero((slots < slot) & ~twin.reference.fixed)
    kept, information, gradient = twin.core.marginalize(twin.poses, slot)

    factors = [f for f in twin.reference.factors if set(f.poses) & set(gone)]
    h, g = twin.reference.all_normal_equations(twin.poses, factors)
    touched = {k for f in factors for k in f.poses}
    expected = sorted(k for k in touched if slots[k] >= slot and not twin.reference.fixed[k])
    assert list(kept) == expected
    a, b = rows(expected), rows(gone)
    gain = h[np.ix_(a, b)] @ np.linalg.inv(h[np.ix_(b, b)])
    schur = h[np.ix_(a, a)] - gain @ h[np.ix_(b, a)]
    np.testing.assert_allclose(information, schur, atol=1e-9 * np.abs(schur).max())
    np.testing.assert_allclose(gradient, g[a] - gain @ g[b], atol=1e-9 * np.abs(g).max())
    np.testing.assert_array_equal(information, information.T)


@seeds
@pytest.mark.parametrize("gauge", ["none", "world"])
def test_window_with_prior_steps_as_the_full_graph(gauge: str, seed: int) -> None:
    """All factors linearised at common points: the live poses get the same Gauss–Newton step. METHOD §1."""
    full = team(np.random.default_rng(seed), gauge=gauge)
    slot, slots, at = 11, full.slots, full.poses
    kept, information, gradient = full.core.marginalize(at, slot)

    live = np.flatnonzero((slots >= slot) | full.reference.fixed)
    hessian, slope = full.core.hessian(at)
    free = np.flatnonzero(~full.reference.fixed)
    gone = np.flatnonzero(slots[free] < slot)
    stay = np.flatnonzero(slots[free] >= slot)
    a, b = rows(stay), rows(gone)
    gain = hessian[np.ix_(a, b)] @ np.linalg.inv(hessian[np.ix_(b, b)])
    reduced, reduced_slope = hessian[np.ix_(a, a)] - gain @ hessian[np.ix_(b, a)], slope[a] - gain @ slope[b]

    # The prior: relative to the first kept pose without a world, absolute with one.
    window = _core.Graph(slots[live], full.reference.fixed[live])
    place = {int(k): n for n, k in enumerate(live)}
    if gauge == "world":
        members, part, reference = kept, slice(None), -1
        relative = at[members]
    else:
        members, part, reference = kept[1:], slice(3, None), place[int(kept[0])]
        relative = se2.between(at[kept[0]], at[members])
    window.add_prior(reference, [place[int(k)] for k in members], relative, information[part, part], gradient[part])
    prior_hessian, prior_slope = window.hessian(at[live])

    # Full Schur complement = prior + live factors, those that do not touch what is gone.
    rest = [f for f in full.reference.factors if not set(f.poses) & set(free[gone])]
    rest_h, rest_g = full.reference.all_normal_equations(at, rest)
    r = rows(free[stay])
    scale = np.abs(reduced).max()
    np.testing.assert_allclose(prior_hessian + rest_h[np.ix_(r, r)], reduced, atol=1e-9 * scale)
    np.testing.assert_allclose(prior_slope + rest_g[r], reduced_slope, atol=1e-9 * np.abs(slope).max())
