"""The pictures ``dgorl run`` writes."""

from __future__ import annotations

from pathlib import Path

from dgorl.evaluation.records import Records
from dgorl.plotting.errors import plot_errors
from dgorl.plotting.notes import notes
from dgorl.plotting.trajectories import plot_trajectories


def write_figures(records: Records, directory: Path) -> list[Path]:
    """trajectories.png and error_EGO.png of every ego in ``directory``; returns those drawn.

    Raises MissingExtraError without matplotlib.
    """
    paths = [directory / "trajectories.png"]
    plot_trajectories(records, paths[0])
    for ego in records.egos:
        paths.append(directory / f"error_{ego}.png")
        plot_errors(ego, records.of(ego), paths[-1], notes(ego, records.last[ego]))
    return [path for path in paths if path.exists()]
