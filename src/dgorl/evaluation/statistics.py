"""Bootstrap intervals over trials, and the figures they are taken of. METHOD §8.

What happened within a trial hangs together, so trials are drawn, never ticks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dgorl.se2 import Array

DRAWS = 2000

Statistic = Callable[[Array], Array]
"""A figure of sums over trials: (..., K) → (...,)"""


def bootstrap(sums: Array, statistic: Statistic, draws: int = DRAWS, seed: int = 0) -> tuple[float, float]:
    """95 % interval of a figure of the sums over trials, resampling whole trials.

    sums: (N, K), what each trial adds. Draws in which the figure is undefined do not count; NaN when none is left.
    """
    drawn = np.random.default_rng(seed).integers(0, len(sums), (draws, len(sums)))
    with np.errstate(invalid="ignore", divide="ignore"):
        figures = statistic(sums[drawn].sum(axis=1))
    known = figures[np.isfinite(figures)]
    if not len(known):
        return float("nan"), float("nan")
    low, high = np.quantile(known, [0.025, 0.975])
    return float(low), float(high)


def root_ratio(sums: Array) -> Array:
    """√(first ÷ second): an RMSE of a sum of squares and a count, or the ratio of two over the same ticks."""
    return np.asarray(np.sqrt(sums[..., 0] / sums[..., 1]))


def ratio(sums: Array) -> Array:
    """First ÷ second: a mean, a share, the ratio of two totals."""
    return np.asarray(sums[..., 0] / sums[..., 1])
