"""The live picture: frames, names and what is not sure."""

from __future__ import annotations

from math import pi

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dgorl.estimate import PeerEstimate, PeerHypothesis, Status
from dgorl.measurements import WORLD
from dgorl.plotting.live import LEAST, draw_live

COVARIANCE = np.diag([0.04, 0.09, 0.01])


def peer(status: Status, *pose: float, places: tuple[tuple[float, float], ...] = ()) -> PeerEstimate:
    hypotheses = tuple(PeerHypothesis(0.5, np.array([x, y, 0.0]), COVARIANCE) for x, y in places)
    place = (np.array(pose), COVARIANCE) if pose else (None, None)
    return PeerEstimate(*place, status, 1.0, 0.0, hypotheses=hypotheses)


def drawn(peers: dict[str, PeerEstimate]) -> tuple:
    figure = Figure()
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for _ in range(2):  # the second time it is drawn over the first
        draw_live(axes, "r1", peers, ("r1", "r2", "r3", "r4"), "note")
        figure.canvas.draw()
    robots = [line for line in axes.lines if line.get_marker() == "o"]
    spots = {tuple(np.round([line.get_xdata()[0], line.get_ydata()[0]], 6)) for line in robots}
    return axes, spots, {text.get_text() for text in axes.texts}


def test_in_the_robots_own_frame() -> None:
    peers = {"r2": peer(Status.TRACKED, 3.0, 1.0, 0.5), "r3": peer(Status.UNOBSERVABLE, -2.0, 0.0, 0.0)}
    axes, spots, texts = drawn({**peers, "r4": peer(Status.ISOLATED)})
    assert spots == {(0.0, 0.0), (3.0, 1.0), (-2.0, 0.0)}
    assert {"r1", "r2", "r3: unobservable", "note"} <= texts
    assert not any("r4" in text for text in texts)
    assert axes.get_xlabel() == "forward of r1 [m]"


def test_in_the_start_frame_where_it_is_known() -> None:
    # r1 stands at (5, 0) and looks along +y.
    world = peer(Status.TRACKED, 0.0, 5.0, -pi / 2)
    axes, spots, texts = drawn({"r2": peer(Status.TRACKED, 1.0, 0.0, 0.0), WORLD: world})
    assert spots == {(5.0, 0.0), (5.0, 1.0)}
    assert WORLD not in texts
    assert axes.get_xlabel() == "x [m]"


def test_all_places_of_an_ambiguous_peer() -> None:
    unsure = peer(Status.AMBIGUOUS, 1.0, 2.0, 0.0, places=((1.0, 2.0), (1.0, -2.0)))
    _, spots, texts = drawn({"r2": unsure})
    assert spots == {(0.0, 0.0), (1.0, 2.0), (1.0, -2.0)}
    assert "r2? 50 %" in texts


def test_a_robot_alone_is_not_blown_up() -> None:
    axes, spots, _ = drawn({})
    assert spots == {(0.0, 0.0)}
    assert min(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())) >= LEAST
