"""A smooth random landscape and the altimeters above it. METHOD §7.

Heights are a Gaussian random field with covariance relief² · exp(−d²/2ℓ²), as a sum of waves with random directions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dgorl.se2 import Array
from dgorl.simulation.scenario import Scenario
from dgorl.terrain import Altitude, Terrain

WAVES = 300
"""Waves a landscape is made of."""
CELLS = 10
"""Cells of the map over one length ℓ: its bilinear error is 0.2 % of the relief."""
CHUNK = 4096
"""Points whose waves are summed at once."""


class Landscape:
    """The true heights of a scenario, everywhere."""

    def __init__(self, scenario: Scenario) -> None:
        chance = scenario.generator("terrain")
        self._scenario = scenario
        self._waves = chance.normal(0.0, 1.0 / scenario.terrain_length, (2, WAVES))
        self._phases = chance.uniform(0.0, 2.0 * np.pi, WAVES)

    def heights(self, points: Array) -> Array:
        """Heights (K,) at points (K, 2) of the world [m]."""
        scale = self._scenario.relief * np.sqrt(2.0 / WAVES)
        parts = [points[k : k + CHUNK] for k in range(0, len(points), CHUNK)]
        return np.asarray(
            scale * np.concatenate([np.cos(part @ self._waves + self._phases).sum(axis=1) for part in parts])
        )

    def map(self) -> Terrain:
        """The map of the area and one length ℓ around it."""
        length = self._scenario.terrain_length
        size = self._scenario.area + 2.0 * length
        line = np.linspace(-length, self._scenario.area + length, int(np.ceil(size / length * CELLS)) + 1)
        x, y = np.meshgrid(line, line)
        return Terrain(line, line, self.heights(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape))

    def altitudes(self, poses: Array, stamps: Array) -> Iterator[Altitude]:
        """What the altimeters read: poses (T, N, 3) at stamps (T,) [s], one reading a robot and step."""
        sigma = self._scenario.altimeter_sigma
        truth = self.heights(poses[:, :, :2].reshape(-1, 2)).reshape(poses.shape[:2])
        draws = [self._scenario.generator(f"altitude {name}").normal(size=len(stamps)) for name in self._scenario.names]
        read = truth + sigma * np.stack(draws, axis=1)
        for stamp, row in zip(stamps, read, strict=True):
            for name, height in zip(self._scenario.names, row, strict=True):
                yield Altitude(name, float(stamp), float(height), sigma)
