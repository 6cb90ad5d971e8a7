"""The limits of a configuration as constraints on a window's poses. METHOD §5."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np

from dgorl.configuration import Configuration, Limits
from dgorl.optimization.constraints import Constraints, box, disc, distances, together
from dgorl.optimization.lagrangian import constrained
from dgorl.optimization.problem import Indices, Solution
from dgorl.optimization.solver import solve
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Window


def optimum(configuration: Configuration, window: Window, select: Indices, tolerance: float) -> Solution:
    """A window's optimum within the limits, by the configured solver, and the covariance of selected poses.

    Its reason is ``converged`` only if the limits are kept; otherwise it is what exceeds them least, and the reason
    says why. Raises ValueError when the graph leaves a pose undetermined.
    """
    if configuration.limits == Limits():
        return solve(window.problem, select, tolerance, configuration.solver)
    bounds = constraints(configuration.limits, window)
    return constrained(window.problem, bounds, select, tolerance, configuration.solver).solution


def constraints(limits: Limits, window: Window) -> Constraints:
    """The limits on every keyframe of a window. A workspace only where the window knows the world."""
    parts = []
    if limits.diameter is not None:
        parts += [distances(*pair, limits.diameter) for pair in _abreast(window)]
    if limits.speed is not None:
        for offset, _, count in window.layout.values():
            i = np.arange(offset, offset + count - 1)
            parts.append(distances(i, i + 1, limits.speed / KEYFRAMES_PER_SECOND))
    if window.world is not None:
        free = np.flatnonzero(~window.problem.fixed)
        if limits.disc is not None:
            x, y, radius = limits.disc
            parts.append(disc(window.world, free, (x, y), radius))
        if limits.box is not None:
            parts.append(box(window.world, free, limits.box[:2], limits.box[2:]))
    return together(parts)


def _abreast(window: Window) -> Iterable[tuple[Indices, Indices]]:
    """Poses of two robots at the same keyframes, for every pair of tracks."""
    for (a, (at_a, first_a, count_a)), (b, (at_b, first_b, count_b)) in combinations(window.layout.items(), 2):
        first, last = max(first_a, first_b), min(first_a + count_a, first_b + count_b)
        if a.robot != b.robot and first < last:
            keyframes = np.arange(first, last)
            yield at_a + keyframes - first_a, at_b + keyframes - first_b
