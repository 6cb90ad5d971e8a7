"""altitude.csv and terrain.npz of a dgorl log: for terrain relative navigation alone. METHOD §7."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from dgorl.errors import LogError, MeasurementError
from dgorl.logs.stamps import Stamps
from dgorl.logs.text import Columns, Forward, csv_rows
from dgorl.se2 import Array
from dgorl.terrain import Altitude, Terrain

ALTITUDE: Columns = ("t", "robot", "height", "sigma")
ARRAYS = ("x", "y", "height")


def read_altitudes(path: Path, robots: Collection[str], stamps: Stamps) -> tuple[Altitude, ...]:
    """Rows of altitude.csv in their order, their stamps noted. Raises LogError naming file and line."""
    forward = Forward()
    found = []
    for row in csv_rows(path, [[ALTITUDE]])[1]:
        robot, stamp = row.robot(1, robots), row.number(0)
        forward.check(row, stamp)
        stamps.take(row, stamp, "altitude")
        found.append(row.make(Altitude, robot, stamp, row.number(2), row.number(3)))
    return tuple(found)


def read_terrain(path: Path) -> Terrain:
    """The elevation map in an .npz file with arrays x, y, height. Raises LogError."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            missing = [name for name in ARRAYS if name not in arrays]
            if missing:
                raise LogError(path, None, f"holds no array `{missing[0]}`; an elevation map has x, y and height")
            x, y, height = (_numbers(path, name, arrays[name]) for name in ARRAYS)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise LogError(path, None, f"not an .npz file of NumPy arrays: {error}") from error
    try:
        return Terrain(x, y, height)
    except MeasurementError as error:
        raise LogError(path, None, str(error)) from error


def terrain_bytes(terrain: Terrain) -> bytes:
    """The .npz file of a map; the same map gives the same bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, x=terrain.x, y=terrain.y, height=terrain.height)
    return buffer.getvalue()


def altitude_rows(altitudes: Sequence[Altitude]) -> list[tuple[object, ...]]:
    """Rows of altitude.csv."""
    return [(m.stamp, m.robot, m.height, m.sigma) for m in altitudes]


def _numbers(path: Path, name: str, values: Array) -> Array:
    if values.dtype.kind not in "iuf":
        raise LogError(path, None, f"array `{name}` must hold numbers, got {values.dtype}")
    return values.astype(float)
