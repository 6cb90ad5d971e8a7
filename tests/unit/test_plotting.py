"""Pictures are drawn without a display, with and without truth and the world, and show something."""

from __future__ import annotations

import builtins
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dgorl.errors import MissingExtraError
from dgorl.estimate import Edge, Estimate, OptimizedGraph, PeerEstimate, PeerHypothesis, Status
from dgorl.evaluation.records import Records, collect
from dgorl.measurements import WORLD
from dgorl.plotting.errors import PEERS, plot_errors
from dgorl.plotting.figures import write_figures
from dgorl.plotting.frames import team_view
from dgorl.plotting.graph import draw_graph
from dgorl.plotting.hypotheses import draw_ellipse
from dgorl.plotting.labels import write_names
from dgorl.plotting.notes import LINES, notes
from dgorl.plotting.style import STATUSES, colors_of, picture
from dgorl.plotting.trajectories import plot_trajectories
from dgorl.se2 import Array, between, compose

WALK = 12


def team(n: int) -> dict[str, Array]:
    """Robots on circles of their own: robot → (T, 4) of t, x, y, theta."""
    t = 0.5 * np.arange(WALK)
    paths = {}
    for k in range(n):
        a = k + 0.2 * t
        paths[f"r{k + 1:02}"] = np.column_stack([t, 8 * k + 5 * np.cos(a), 5 * np.sin(a), a + np.pi / 2])
    return paths


def records(n: int = 3, *, world: bool = True, truth: bool = True, located: bool = True) -> Records:
    paths = team(n)
    ticks = []
    for k in range(WALK):
        poses = {robot: path[k, 1:] + [0.1, -0.1, 0.02] for robot, path in paths.items()}
        if world:
            poses[WORLD] = np.zeros(3)
        ticks.append(SimpleNamespace(
            stamp=0.5 * k, cpu_s=dict.fromkeys(paths, 0.001),
            estimates={ego: estimate(ego, 0.5 * k, poses, located and k > 2) for ego in paths},
        ))  # fmt: skip
    return collect(ticks, paths if truth else {})  # type: ignore[arg-type]


def estimate(ego: str, stamp: float, poses: dict[str, Array], located: bool) -> Estimate:
    seen = PeerEstimate(None, None, Status.ISOLATED, 0.0, np.inf, "nothing heard")
    relative = {robot: between(poses[ego], pose) for robot, pose in poses.items()}
    peers = {
        robot: PeerEstimate(pose, 0.1 * np.eye(3), Status.TRACKED, 1.0, 0.0) if located else seen
        for robot, pose in relative.items()
        if robot != ego
    }
    robots = sorted(robot for robot in poses if robot != WORLD)
    kinds = ("rssi", "range", "bearing", "pose")
    edges = tuple(Edge(robots[0], b, kinds[i % 4], stamp, 0.7 * i, 1.0) for i, b in enumerate(robots[1:]))
    known = relative if located else {ego: np.zeros(3)}
    graph = OptimizedGraph(known, edges, np.ones((len(robots), len(robots))))
    return Estimate(ego, stamp, peers, {}, lambda: graph)


def unresolved(records: Records, peer: str, until: int = WALK) -> Records:
    """The replay with ``peer`` ambiguous between two places up to tick ``until``, and saying why."""
    pairs, last = dict(records.pairs), dict(records.last)
    for (ego, other), record in records.pairs.items():
        if other != peer:
            continue
        alive = {
            k: tuple(
                PeerHypothesis(p, record.pose[k] * [1, side, side], np.eye(3)) for p, side in ((0.8, 1.0), (0.2, -1.0))
            )
            for k in range(3, until)
        }
        status = tuple(Status.AMBIGUOUS if k in alive else s for k, s in enumerate(record.status))
        pairs[ego, other] = replace(record, status=status, hypotheses=alive)
        if until == WALK:
            pose, covariance = record.pose[-1], record.covariance[-1]
            seen = PeerEstimate(pose, covariance, Status.AMBIGUOUS, 0.8, 0.0, "two places", "turn", alive[WALK - 1])
            last[ego] = replace(last[ego], peers={**last[ego].peers, peer: seen})
    return replace(records, pairs=pairs, last=last)


def pixels(path: Path) -> Array:
    from matplotlib.image import imread

    image = np.asarray(imread(path), dtype=float)[..., :3]
    assert min(image.shape[:2]) > 300
    return image


@pytest.mark.parametrize("world", [True, False])
@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("located", [True, False])
def test_pictures_of_every_kind_of_replay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, world: bool, truth: bool, located: bool
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    paths = write_figures(records(world=world, truth=truth, located=located), tmp_path)
    assert [p.name for p in paths] == ["trajectories.png", "error_r01.png", "error_r02.png", "error_r03.png"]
    for path in paths:
        assert (pixels(path).min(axis=2) < 0.9).mean() > 0.005


@pytest.mark.parametrize("until", [8, WALK])
@pytest.mark.parametrize("truth", [True, False])
def test_pictures_of_ambiguous_peers(tmp_path: Path, until: int, truth: bool) -> None:
    plain = records(world=False, truth=truth)
    paths = write_figures(unresolved(plain, "r02", until), tmp_path / "a")
    for path, before in zip(paths, write_figures(plain, tmp_path / "b"), strict=True):
        assert path.name == "error_r02.png" or path.read_bytes() != before.read_bytes()
    purple = np.array([int(STATUSES[Status.AMBIGUOUS][k : k + 2], 16) for k in (1, 3, 5)]) / 255
    assert (np.abs(pixels(tmp_path / "a/error_r01.png") - purple).max(axis=2) < 0.02).sum() > 200


def test_all_hypotheses_are_drawn_where_the_ego_sees_them(tmp_path: Path) -> None:
    unsure = unresolved(records(world=False), "r02")
    view = team_view(unsure, "r01")
    assert not np.isfinite(view.estimates["r02"]).any()
    assert np.isfinite(view.guesses["r02"][3:]).all()
    with picture(tmp_path / "graph.png", 5, 5) as figure:
        axes = figure.subplots()
        draw_graph(figure, axes, unsure.last["r01"], view, colors_of(list(team(3))))
        rings = {
            tuple(line.get_xydata()[0]): line.get_alpha()
            for line in axes.lines
            if line.get_marker() == "o" and line.get_markerfacecolor() == "white"
        }
        words = {text.get_text() for text in axes.texts}
        label = axes.get_legend().get_texts()[-1].get_text()
    alive = unsure.last["r01"]["r02"].hypotheses
    places = [tuple(compose(view.ego_pose[-1], h.pose)[:2].tolist()) for h in alive]
    assert set(rings) == set(places)
    assert rings[places[0]] > rings[places[1]]
    assert "r02? 80 %" in words
    assert "may be" in label


def test_far_flung_ellipses_do_not_widen_the_picture(tmp_path: Path) -> None:
    with picture(tmp_path / "ellipse.png", 4, 4) as figure:
        axes = figure.subplots()
        axes.plot([0, 10], [0, 10])
        draw_ellipse(axes, np.array([5.0, 5.0, 0.0]), np.eye(2), np.diag([1e4, 1.0]), "k")
        assert axes.get_xlim()[1] < 12
        draw_ellipse(axes, np.array([5.0, 5.0, 0.0]), np.eye(2), np.diag([9.0, 1.0]), "k")
        axes.autoscale_view()
        assert axes.get_xlim()[1] > 12


def test_notes_say_why_and_what_would_help() -> None:
    unsure = unresolved(records(), "r02")
    assert notes("r01", unsure.last["r01"]) == ["r01 → r02 ambiguous: two places — would help: turn"]
    assert notes("r01", records().last["r01"]) == []
    assert notes("r01", records(located=False).last["r01"]) == ["r01 → r02, r03 isolated: nothing heard"]
    many = {f"r{k:02}": PeerEstimate(None, None, Status.ISOLATED, 0.0, 0.0, f"reason {k}") for k in range(20)}
    lines = notes("r99", many)
    assert len(lines) == LINES
    assert lines[-1] == f"… and {20 - LINES + 1} more"


def test_every_robot_has_its_colour_in_the_picture(tmp_path: Path) -> None:
    trajectories = pixels(write_figures(records(), tmp_path)[0])
    for color in colors_of(list(team(3))).values():
        wanted = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        assert (np.abs(trajectories - wanted).max(axis=2) < 0.02).sum() > 50


def test_large_and_lonely_teams(tmp_path: Path) -> None:
    large = records(PEERS + 3)
    plot_trajectories(large, tmp_path / "paths.png")
    plot_errors("r01", large.of("r01"), tmp_path / "errors.png")
    assert pixels(tmp_path / "errors.png").shape[0] > 1000
    assert [p.name for p in write_figures(records(1), tmp_path / "one")] == ["trajectories.png"]
    assert write_figures(collect([], {}), tmp_path / "none") == []


def test_estimates_and_truth_share_a_frame() -> None:
    seen = team_view(records(), "r01")
    placed = team_view(records(world=False), "r01")
    assert seen.estimates["r02"][5] == pytest.approx(seen.truth["r02"][5] + [0.1, -0.1, 0.02])
    assert placed.ego_pose == pytest.approx(placed.truth["r01"])
    assert np.linalg.norm(placed.estimates["r02"][5] - placed.truth["r02"][5]) < 0.6
    assert "r01" not in placed.estimates


def test_names_do_not_overlap(tmp_path: Path) -> None:
    places = {f"r{k}": np.array([0.02 * k, 0.0]) for k in range(4)}
    with picture(tmp_path / "names.png", 4, 4) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1])
        write_names(axes, places, dict.fromkeys(places, "k"), np.array([[0.0, 0.0], [1.0, 1.0]]))
        figure.draw_without_rendering()
        boxes = [text.get_window_extent() for text in axes.texts]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_missing_matplotlib_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"-m pip install matplotlib"):
        write_figures(records(), tmp_path)


def test_of_a_long_replay_the_end_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dgorl.plotting.frames.LONGEST", 2.0)
    view = team_view(records(), "r01")
    assert view.t.tolist() == [3.5, 4.0, 4.5, 5.0, 5.5]
    assert view.start == 0.0
    assert {len(poses) for poses in (*view.estimates.values(), *view.truth.values())} == {5}
