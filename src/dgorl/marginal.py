"""Windows settled: converged poses by track, and the past as a prior on relative poses. METHOD §1."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from dgorl import se2
from dgorl.history import WORLD_KEY, History
from dgorl.limits import optimum
from dgorl.optimization import native
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import WORLD_STRETCH, Component, Prior, Stretch, Window, assemble

TOLERANCE = 1e-9
"""Largest last step of a node's optimisation [m, rad]."""


@dataclass(frozen=True)
class Settled:
    """A component at a node, and the window whose optimum ``poses`` (N, 3), at that cost, it comes from."""

    component: Component
    window: Window
    poses: Array
    cost: float


def settled(history: History, component: Component, low: float, g: float, boundary: float) -> Settled:
    """The component converged on [low, g] [s], with everything before ``boundary`` [s] marginalised into a prior.

    Raises ValueError when the graph leaves a pose undetermined.
    """
    pin = None if boundary == -np.inf else int(boundary * KEYFRAMES_PER_SECOND)
    window = assemble(history, component, low, g, pin)
    solution = optimum(history.configuration, window, np.zeros(0, np.int64), TOLERANCE)
    priors = component.priors
    if pin is not None and pin > window.base:
        priors = marginalized(window, solution.poses, pin)
    return Settled(Component(stretches(window, solution.poses, pin), priors), window, solution.poses, solution.cost)


def without(history: History, component: Component, robot: TrackKey, low: float, keyframe: int) -> Component:
    """The component's other members at ``keyframe``, all that was known until then, ``robot``'s part too, as a prior.

    component: as it was before; it has to know the keyframe. Raises ValueError when a pose is undetermined.
    """
    cut = {
        key: stretch if key == WORLD_KEY else Stretch(stretch.first, stretch.poses[: keyframe - stretch.first + 1])
        for key, stretch in component.stretches.items()
        if key == WORLD_KEY or stretch.first < keyframe
    }
    priors = tuple(p for p in component.priors if p.keyframe <= keyframe and {p.reference, *p.members} <= cut.keys())
    limit = keyframe / KEYFRAMES_PER_SECOND
    inside = tuple(
        link for link in component.links
        if {link.reference, link.robot} <= cut.keys() and max(link.stamp_reference, link.stamp_robot) < limit
    )  # fmt: skip
    window = assemble(history, Component(cut, priors, inside), low, limit, keyframe)
    solution = optimum(history.configuration, window, np.zeros(0, np.int64), TOLERANCE)
    priors = marginalized(window, solution.poses, keyframe, robot)
    found = {key: s for key, s in stretches(window, solution.poses, keyframe).items() if key != robot}
    return Component(found, priors)


def stretches(window: Window, poses: Array, first: int | None) -> Mapping[TrackKey, Stretch]:
    """A solution's poses by track, from keyframe ``first`` on; tracks that ended before it are left out."""
    found: dict[TrackKey, Stretch] = {}
    for key, (offset, start, count) in window.layout.items():
        skip = 0 if first is None else max(first - start, 0)
        if skip < count:
            found[key] = Stretch(start + skip, poses[offset + skip : offset + count])
    if window.world is not None:
        found[WORLD_KEY] = WORLD_STRETCH
    return found


def marginalized(window: Window, poses: Array, boundary: int, leave_out: TrackKey | None = None) -> tuple[Prior, ...]:
    """The prior at the boundary keyframe, relative to the first track by name that stands there.

    leave_out: a track that is marginalised altogether, what it says of the others included in the prior.
    """
    standing = {
        window.index(key, boundary): key
        for key, (_, first, count) in window.layout.items()
        if first < boundary < first + count and key != leave_out
    }
    if not standing:
        return ()
    reference = min(standing)
    found = native.marginalize(window.problem, poses, boundary - window.base, reference, window.world)
    members, relative, information, gradient = found
    names = {
        window.index(key, boundary): key
        for key, (_, first, n) in window.layout.items()
        if first <= boundary < first + n
    }
    if window.world is not None:
        names[window.world] = WORLD_KEY
    keys = tuple(names[int(member)] for member in members)
    prior = Prior(boundary, standing[reference], keys, relative, information, gradient)
    prior = _left_out(prior, {leave_out}) if leave_out in keys else prior
    return (prior,) if prior.members else ()


def excerpt(component: Component, keys: Collection[TrackKey]) -> Component:
    """What a component knows of some of its tracks and the world: priors with the others marginalised."""
    if {*keys, WORLD_KEY} >= component.stretches.keys():
        return component
    kept = {key: s for key, s in component.stretches.items() if key in keys or key == WORLD_KEY}
    priors = (_among(prior, kept.keys()) for prior in component.priors)
    return Component(kept, tuple(prior for prior in priors if prior is not None))


def _among(prior: Prior, keys: Collection[TrackKey]) -> Prior | None:
    """A prior on those of its tracks that are among the keys; None where fewer than two are."""
    kept = [key for key in (prior.reference, *prior.members) if key in keys]
    if len(kept) < 2:
        return None
    if prior.reference not in keys:
        prior = _seen_from(prior, kept[0])
    gone = {member for member in prior.members if member not in keys}
    return _left_out(prior, gone) if gone else prior


def _seen_from(prior: Prior, reference: TrackKey) -> Prior:
    """The same prior on poses relative to one of its members r: Z_j = Y_r⁻¹ Y_j, and Y_r⁻¹ of the reference before.

    δy_r = −Ad(Y_r⁻¹) δz_ref and δy_j = δz_j + Ad(Z_j⁻¹) δy_r, right perturbations.
    """
    r = prior.members.index(reference)
    relative = se2.between(prior.relative[r], prior.relative)
    relative[r] = se2.inverse(prior.relative[r])
    size = len(prior.members)
    jacobian = np.eye(3 * size)
    turned = -se2.adjoint(relative[r])
    for j in range(size):
        back = turned if j == r else se2.adjoint(se2.inverse(relative[j])) @ turned
        jacobian[3 * j : 3 * j + 3, 3 * r : 3 * r + 3] = back
    information = jacobian.T @ prior.information @ jacobian
    members = tuple(prior.reference if key == reference else key for key in prior.members)
    symmetric = (information + information.T) / 2
    return Prior(prior.keyframe, reference, members, relative, symmetric, jacobian.T @ prior.gradient)


def _left_out(prior: Prior, keys: Collection[TrackKey]) -> Prior:
    """The prior on the other members, those marginalised."""
    gone = np.repeat([member in keys for member in prior.members], 3)
    kept = ~gone
    coupling = prior.information[np.ix_(kept, gone)]
    factor = np.linalg.solve(prior.information[np.ix_(gone, gone)], coupling.T).T
    information = prior.information[np.ix_(kept, kept)] - factor @ coupling.T
    return Prior(
        prior.keyframe,
        prior.reference,
        tuple(member for member in prior.members if member not in keys),
        prior.relative[kept[::3]],
        (information + information.T) / 2,
        prior.gradient[kept] - factor @ prior.gradient[gone],
    )
