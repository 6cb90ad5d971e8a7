"""Windows settled: converged poses by track, and the past as a prior on relative poses. METHOD §1."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dgorl.history import WORLD_KEY, History
from dgorl.optimization import native
from dgorl.optimization.solver import solve
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import WORLD_STRETCH, Component, Prior, Stretch, Window, assemble

TOLERANCE = 1e-9
"""Largest last step of a node's optimisation [m, rad]."""


def settled(history: History, component: Component, low: float, g: float, boundary: float) -> Component:
    """The component converged on [low, g] [s], with everything before ``boundary`` [s] marginalised into a prior.

    Raises ValueError when the graph leaves a pose undetermined.
    """
    pin = None if boundary == -np.inf else int(boundary * KEYFRAMES_PER_SECOND)
    window = assemble(history, component, low, g, pin)
    solution = solve(window.problem, np.zeros(0, np.int64), TOLERANCE, history.configuration.solver)
    priors = component.priors
    if pin is not None and pin > window.base:
        priors = marginalized(window, solution.poses, pin)
    return Component(stretches(window, solution.poses, pin), priors)


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


def marginalized(window: Window, poses: Array, boundary: int) -> tuple[Prior, ...]:
    """The prior at the boundary keyframe, relative to the first track by name that stands there."""
    standing = {
        window.index(key, boundary): key
        for key, (_, first, count) in window.layout.items()
        if first < boundary < first + count
    }
    if not standing:
        return ()
    reference = min(standing)
    found = native.marginalize(window.problem, poses, boundary - window.base, reference, window.world)
    members, relative, information, gradient = found
    if not len(members):
        return ()
    names = {
        window.index(key, boundary): key
        for key, (_, first, n) in window.layout.items()
        if first <= boundary < first + n
    }
    if window.world is not None:
        names[window.world] = WORLD_KEY
    keys = tuple(names[int(member)] for member in members)
    return (Prior(boundary, standing[reference], keys, relative, information, gradient),)
