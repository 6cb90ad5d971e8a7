"""The table of a comparison of solvers: a row per graph, start and solver, and its summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

AGREEMENT = 1e-6
"""Costs that differ by less than this share are one optimum."""


@dataclass(frozen=True)
class SolverRow:
    """One solver on one graph: CPU times [ms], medians of its repeats. off: relative distance from the optimum's cost.

    marginals_ms, the newest poses' joint covariance, is None where a solver cannot give it; total_ms is without it.
    """

    graph: int
    sensor: str
    start: str
    solver: str
    poses: int
    readings: int
    build_ms: float
    optimise_ms: float
    marginals_ms: float | None
    total_ms: float
    iterations: int
    cost: float
    off: float

    @property
    def reached(self) -> bool:
        """Whether this is the optimum, not another one."""
        return self.off < AGREEMENT


@dataclass(frozen=True)
class SolverSummary:
    """One solver from one start: medians over graphs of build, optimise, marginals and their total; of optimise, which
    the paper calls solver time, also mean, standard deviation and quartiles; all CPU [ms].

    ratio, total_ratio: medians over graphs of the time divided by the native core's on the same graph, where both
    reach the optimum. reached: graphs on which it does, within AGREEMENT of the cost. disagreement: largest relative
    distance from it on those. None where there is none.
    """

    sensor: str
    start: str
    solver: str
    graphs: int
    build_ms: float
    optimise_ms: float
    marginals_ms: float | None
    total_ms: float
    mean_ms: float
    std_ms: float
    low_ms: float
    high_ms: float
    iterations: float
    reached: int
    disagreement: float | None
    ratio: float | None
    total_ratio: float | None


@dataclass(frozen=True)
class SolverTable:
    """All rows, and why a solver is missing."""

    rows: tuple[SolverRow, ...]
    missing: Mapping[str, str]

    def summary(self) -> tuple[SolverSummary, ...]:
        """One per sensor, start and solver, in the order they ran."""
        keys = dict.fromkeys((row.sensor, row.start, row.solver) for row in self.rows)
        return tuple(self._summarised(*key) for key in keys)

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        summary, rows = ([asdict(entry) for entry in entries] for entries in (self.summary(), self.rows))
        return {"summary": summary, "rows": rows, "missing": dict(self.missing)}

    def text(self) -> str:
        """For the terminal: CPU ms."""
        head = ("sensor", "start", "solver", "build", "optimise", "± std", "marginals", "total", "iterations",
                "reached", "off by", "optimise ÷ ours", "total ÷ ours")  # fmt: skip
        lines = [head, *(_cells(entry) for entry in self.summary())]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        table = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
        absent = [f"{solver} is missing: {reason}" for solver, reason in self.missing.items()]
        return "\n".join(line.rstrip() for line in [*table, *absent])

    def _summarised(self, sensor: str, start: str, solver: str) -> SolverSummary:
        def of(solver: str) -> list[SolverRow]:
            return [row for row in self.rows if (row.sensor, row.start, row.solver) == (sensor, start, solver)]

        rows, ours = of(solver), of("native")

        def middle(value: Callable[[SolverRow], float | None]) -> float | None:
            known = [found for row in rows if (found := value(row)) is not None]
            return float(np.median(known)) if known else None

        def ratio(value: Callable[[SolverRow], float]) -> float | None:
            pairs = [pair for pair in zip(rows, ours, strict=True) if all(row.reached for row in pair)]
            return float(np.median([value(row) / value(native) for row, native in pairs])) if pairs else None

        optimise = np.array([row.optimise_ms for row in rows])
        low, high = np.quantile(optimise, (0.25, 0.75)).tolist()
        return SolverSummary(
            sensor,
            start,
            solver,
            graphs=len(rows),
            build_ms=float(np.median([row.build_ms for row in rows])),
            optimise_ms=float(np.median(optimise)),
            marginals_ms=middle(lambda row: row.marginals_ms),
            total_ms=float(np.median([row.total_ms for row in rows])),
            mean_ms=float(optimise.mean()),
            std_ms=float(optimise.std(ddof=1)) if len(rows) > 1 else 0.0,
            low_ms=low,
            high_ms=high,
            iterations=float(np.median([row.iterations for row in rows])),
            reached=sum(row.reached for row in rows),
            disagreement=max((abs(row.off) for row in rows if row.reached), default=None),
            ratio=ratio(lambda row: row.optimise_ms),
            total_ratio=ratio(lambda row: row.total_ms),
        )


def _cells(entry: SolverSummary) -> tuple[str, ...]:
    def shown(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    return (
        *(entry.sensor, entry.start, entry.solver, shown(entry.build_ms, ".2f"), shown(entry.optimise_ms, ".2f")),
        *(shown(entry.std_ms, ".2f"), shown(entry.marginals_ms, ".2f"), shown(entry.total_ms, ".2f")),
        *(f"{entry.iterations:g}", f"{entry.reached}/{entry.graphs}", shown(entry.disagreement, ".0e")),
        *(shown(entry.ratio, ".1f"), shown(entry.total_ratio, ".1f")),
    )
