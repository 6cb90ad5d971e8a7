"""Everything ``dgorl paper`` draws."""

from __future__ import annotations

from pathlib import Path

from dgorl.configuration import Configuration, merge
from dgorl.evaluation.records import collect
from dgorl.evaluation.trials import Outcome
from dgorl.plotting.frames import team_view
from dgorl.plotting.graph import draw_graph
from dgorl.plotting.paper import published, write_paper_figures
from dgorl.plotting.style import colors_of
from dgorl.plotting.sweeps import plot_sweeps
from dgorl.plotting.trajectories import draw_paths
from dgorl.replay import replay
from dgorl.simulation import Scenario, simulate


def write_figures(scenario: Scenario, paper: Outcome, sweeps: Outcome | None, folder: Path) -> list[Path]:
    """Trajectories, RMSE, comparison, CPU and sweeps, as PNG and PDF; returns the PNGs.

    Raises MissingExtraError without matplotlib.
    """
    drawn = [folder / "trajectories.png"]
    plot_trial(scenario, drawn[0])
    drawn += write_paper_figures(paper, folder)
    if sweeps is not None:
        drawn.append(folder / "sweeps.png")
        plot_sweeps(sweeps.errors, drawn[-1])
    return drawn


def plot_trial(scenario: Scenario, path: Path) -> None:
    """One trial with known starts: true and estimated paths as the first robot has them, and its optimised graph."""
    log = simulate(scenario)
    configuration = merge(Configuration(), log.configuration, "the simulated log")
    records = collect(replay(log, configuration, egos=log.robots[:1]), log.truth)
    view = team_view(records, log.robots[0])
    colors = colors_of(log.robots)
    with published(path, 11.0, 5.2) as figure:
        paths, graph = figure.subplots(1, 2)
        draw_paths(paths, view, colors)
        draw_graph(figure, graph, records.last[view.ego], view, colors)
