"""Elevation maps and what altimeters read above them: inputs of terrain relative navigation alone. METHOD §7.

They are no measurements of the team: DGORL's own estimator never sees them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dgorl.errors import MeasurementError
from dgorl.measurements import LARGEST, SMALLEST_SIGMA
from dgorl.se2 import Array

EVEN = 1e-6
"""Grid lines are even to this share of their spacing."""


@dataclass(frozen=True, slots=True)
class Altitude:
    """Height of the terrain under ``robot`` at ``stamp`` [s]: height, sigma [m], zero as the map's."""

    robot: str
    stamp: float
    height: float
    sigma: float

    def __post_init__(self) -> None:
        for name, value in (("stamp", self.stamp), ("height", self.height), ("sigma", self.sigma)):
            if not abs(value) <= LARGEST:
                raise MeasurementError(f"{name} must be finite and within ±{LARGEST:.0e}, got {value}")
        if not self.sigma >= SMALLEST_SIGMA:
            raise MeasurementError(f"sigma must be at least {SMALLEST_SIGMA}, got {self.sigma}")


@dataclass(frozen=True, eq=False)
class Terrain:
    """An elevation map in the log's start frame: height (len(y), len(x)) [m] at even x and y, rising [m].

    Raises MeasurementError for anything else.
    """

    x: Array
    y: Array
    height: Array

    def __post_init__(self) -> None:
        for name, line in (("x", self.x), ("y", self.y)):
            steps = np.diff(line) if line.ndim == 1 else np.empty(0)
            if len(steps) < 1 or not np.isfinite(line).all() or not steps[0] > 0:
                raise MeasurementError(f"{name} must hold at least two rising numbers")
            if np.abs(steps - steps.mean()).max() > EVEN * steps.mean():
                raise MeasurementError(f"{name} must be evenly spaced")
        if self.height.shape != (len(self.y), len(self.x)):
            wanted = f"({len(self.y)}, {len(self.x)}), as y and x are long"
            raise MeasurementError(f"height must have the shape {wanted}, got {self.height.shape}")
        if not np.isfinite(self.height).all():
            raise MeasurementError("height must be finite everywhere")

    def at(self, points: Array) -> Array:
        """Heights (...,) at points (..., 2), bilinear; NaN off the map."""
        column = (points[..., 0] - self.x[0]) / (self.x[-1] - self.x[0]) * (len(self.x) - 1)
        row = (points[..., 1] - self.y[0]) / (self.y[-1] - self.y[0]) * (len(self.y) - 1)
        off = (column < 0) | (column > len(self.x) - 1) | (row < 0) | (row > len(self.y) - 1)
        i = np.clip(np.floor(row), 0, len(self.y) - 2).astype(np.int64)
        j = np.clip(np.floor(column), 0, len(self.x) - 2).astype(np.int64)
        up, right = row - i, column - j
        low = (1 - right) * self.height[i, j] + right * self.height[i, j + 1]
        high = (1 - right) * self.height[i + 1, j] + right * self.height[i + 1, j + 1]
        return np.asarray(np.where(off, np.nan, (1 - up) * low + up * high))

    @cached_property
    def middle(self) -> tuple[float, float]:
        """Mean and spread of the map's heights [m]: all that is known off it."""
        return float(self.height.mean()), float(self.height.std())
