"""Elevation maps and altitudes: simulated, written, read again, refused when they are wrong."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dgorl import logs
from dgorl.errors import ConfigurationError, LogError, MeasurementError
from dgorl.simulation import Scenario, simulate
from dgorl.terrain import Altitude, Terrain

LINE = np.array([0.0, 1.0, 2.0])
FLAT = np.zeros((3, 3))
SMALL = Scenario(robots=3, steps=40, terrain=True, seed=20_000)


def test_without_terrain_nothing_changes() -> None:
    """The same seed gives the same measurements, starts and truth, with and without."""
    bare, log = simulate(replace(SMALL, terrain=False)), simulate(SMALL)
    assert (bare.altitudes, bare.terrain) == ((), None)
    assert (bare.measurements, bare.starts, bare.configuration) == (log.measurements, log.starts, log.configuration)
    assert all(np.array_equal(bare.truth[robot], log.truth[robot]) for robot in bare.robots)


def test_altimeters_read_the_map() -> None:
    log = simulate(replace(SMALL, steps=400, altimeter_sigma=0.2))
    assert log.terrain is not None
    assert [(m.stamp, m.robot) for m in log.altitudes[:4]] == [(0.5, "r1"), (0.5, "r2"), (0.5, "r3"), (1.0, "r1")]
    places = np.array([log.truth[m.robot][round(2 * m.stamp), 1:3] for m in log.altitudes])
    noise = np.array([m.height for m in log.altitudes]) - log.terrain.at(places)
    assert {m.sigma for m in log.altitudes} == {0.2}
    assert np.std(noise) == pytest.approx(0.2, rel=0.06)
    assert abs(np.mean(noise)) < 0.03


def test_the_landscape_is_a_smooth_random_field() -> None:
    """Spread and slope of exp(−d²/2ℓ²): relief and relief/ℓ; as wide as the area and ℓ around it; one per seed."""
    spreads, slopes = [], []
    for seed in range(20_000, 20_020):
        log = simulate(replace(SMALL, seed=seed, steps=1, relief=3.0, terrain_length=6.0))
        terrain = log.terrain
        assert terrain is not None
        assert (terrain.x[0], terrain.x[-1]) == (-6.0, 66.0)
        spreads.append(np.mean(terrain.height**2))
        slopes.append(np.mean(np.gradient(terrain.height, terrain.x, axis=1) ** 2))
    assert np.sqrt(np.mean(spreads)) == pytest.approx(3.0, rel=0.1)
    assert np.sqrt(np.mean(slopes)) == pytest.approx(0.5, rel=0.1)
    one, two = simulate(SMALL).terrain, simulate(SMALL).terrain
    other = simulate(replace(SMALL, seed=20_001)).terrain
    assert one is not None and two is not None and other is not None  # noqa: PT018
    assert np.array_equal(one.height, two.height)
    assert not np.array_equal(one.height, other.height)


def test_heights_between_grid_lines() -> None:
    terrain = Terrain(LINE, np.array([0.0, 2.0]), np.array([[0.0, 1.0, 2.0], [4.0, 5.0, 6.0]]))
    points = np.array([[0.0, 0.0], [2.0, 2.0], [0.5, 1.0], [1.5, 0.5], [-0.1, 1.0], [1.0, 2.1]])
    np.testing.assert_allclose(terrain.at(points), [0.0, 6.0, 2.5, 2.5, np.nan, np.nan])


def test_written_and_read_again(tmp_path: Path) -> None:
    log = simulate(SMALL)
    assert log.terrain is not None
    logs.write(log, tmp_path / "a")
    logs.write(log, tmp_path / "b")
    again = logs.read(tmp_path / "a")
    assert again.altitudes == log.altitudes
    assert again.measurements == log.measurements
    assert again.terrain is not None
    for name in ("x", "y", "height"):
        assert np.array_equal(getattr(again.terrain, name), getattr(log.terrain, name))
    for name in ("terrain.npz", "altitude.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    logs.write(simulate(replace(SMALL, terrain=False)), tmp_path / "a")
    assert not (tmp_path / "a/terrain.npz").exists()
    assert not (tmp_path / "a/altitude.csv").exists()


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ("1.0,r1,2.0", "altitude.csv:3: needs 4 columns, got 3"),
        ("1.0,r9,2.0,0.1", "altitude.csv:3: unknown robot `r9`"),
        ("1.0,r1,high,0.1", "altitude.csv:3: `height` must be a finite number, got `high`"),
        ("1.0,r1,2.0,", "altitude.csv:3: `sigma` must be a finite number"),
        ("1.0,r1,2.0,0", "altitude.csv:3: sigma must be at least 1e-06"),
        ("1.0,r1,1e11,1", "altitude.csv:3: height must be finite and within"),
        ("0.1,r1,2.0,0.1", "altitude.csv:3: time runs backwards"),
    ],
)
def test_bad_altitudes(tmp_path: Path, row: str, what: str) -> None:
    logs.write(simulate(replace(SMALL, steps=2)), tmp_path)
    (tmp_path / "altitude.csv").write_text(f"t,robot,height,sigma\n0.5,r1,1.0,0.1\n{row}\n")
    with pytest.raises(LogError) as caught:
        logs.read(tmp_path)
    assert what in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "what"),
    [
        (None, "not an .npz file"),
        ({"x": LINE, "y": LINE}, "holds no array `height`"),
        ({"x": LINE, "y": LINE, "height": FLAT.astype(str)}, "array `height` must hold numbers"),
        ({"x": LINE, "y": LINE, "height": FLAT[:2]}, r"height must have the shape (3, 3), as y and x are long"),
        ({"x": LINE[::-1], "y": LINE, "height": FLAT}, "x must hold at least two rising numbers"),
        ({"x": LINE[:1], "y": LINE, "height": FLAT[:, :1]}, "x must hold at least two rising numbers"),
        ({"x": LINE, "y": LINE**2, "height": FLAT}, "y must be evenly spaced"),
        ({"x": LINE, "y": LINE, "height": FLAT + np.nan}, "height must be finite everywhere"),
        ({"x": np.array([LINE, LINE]), "y": LINE, "height": FLAT}, "x must hold at least two rising numbers"),
        ({"x": LINE, "y": LINE, "height": np.array([{}])}, "not an .npz file of NumPy arrays"),
    ],
)
def test_bad_maps(tmp_path: Path, arrays: dict[str, Any] | None, what: str) -> None:
    logs.write(simulate(replace(SMALL, steps=2)), tmp_path)
    buffer = io.BytesIO(b"PK is no zip")
    if arrays is not None:
        np.savez(buffer, **arrays)
    (tmp_path / "terrain.npz").write_bytes(buffer.getvalue())
    with pytest.raises(LogError) as caught:
        logs.read(tmp_path)
    assert "terrain.npz: " in str(caught.value)
    assert what in str(caught.value)


def test_what_cannot_be_made() -> None:
    with pytest.raises(MeasurementError, match="stamp must be finite"):
        Altitude("r1", float("nan"), 0.0, 1.0)
    for name in ("relief", "terrain_length", "altimeter_sigma"):
        with pytest.raises(ConfigurationError, match=f"{name} must be positive"):
            replace(SMALL, **{name: 0.0})  # type: ignore[arg-type]
