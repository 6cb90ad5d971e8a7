"""What a claim's row is made of: rows of one estimator, figures of sums over trials, limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dgorl.evaluation.statistics import Statistic, bootstrap
from dgorl.evaluation.trials import Columns
from dgorl.se2 import Array

FIRST = 10
"""Steps before this one do not count: the bound of the first ones is the start's prior alone."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Claim:
    """One row of the table of claims.

    paper: its figure, in its words. value: ours, in ``unit``; low, high: its spread, of the kind ``spread`` names.
    trials: behind it. ratio: ours ÷ the figure it is compared with, ``against``. asked: the limit; met: whether
    ``value`` keeps it, None where nothing is asked.
    """

    claim: str
    paper: str
    value: float | None
    unit: str
    low: float | None = None
    high: float | None = None
    spread: str = "95 % of bootstraps"
    trials: int = 0
    ratio: float | None = None
    against: str = ""
    asked: str = ""
    met: bool | None = None
    note: str = ""
    command: str = ""


class Rows:
    """The rows of one estimator with one kind of start, in the paper's setting."""

    def __init__(self, columns: Columns, initial: str, estimator: str = "dgorl") -> None:
        chosen = (columns["scenario"] == "paper") & (columns["initial"] == initial)
        chosen &= columns["estimator"] == estimator
        self.columns = {name: values[chosen] for name, values in columns.items()}
        self.seeds = np.unique(self.columns["seed"])
        steps = self.columns["step"]
        self.late: Mask = steps >= min(FIRST, int(steps.max(initial=0)))

    def __len__(self) -> int:
        return len(self.columns["step"])

    def __getitem__(self, name: str) -> NDArray[Any]:
        values: NDArray[Any] = self.columns[name]
        return values

    def sums(self, *values: Array, where: Mask | None = None) -> Array:
        """(trials, K): each value (rows,) added up over the rows of a trial; without ``where``, over the late ones."""
        counted = self.late if where is None else where
        trial = np.searchsorted(self.seeds, self["seed"][counted])
        return np.column_stack([np.bincount(trial, value[counted], len(self.seeds)) for value in values])


def figure(sums: Array, statistic: Statistic, scale: float = 1.0) -> dict[str, Any]:
    """``value``, ``low``, ``high`` and ``trials`` of a figure of sums over trials (N, K)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        value = scale * float(statistic(sums.sum(axis=0)))
    low, high = (scale * end for end in bootstrap(sums, statistic))
    found = {"value": value, "low": min(low, high), "high": max(low, high)}
    return {name: number if np.isfinite(number) else None for name, number in found.items()} | {"trials": len(sums)}


def beside(of: dict[str, Any], papers: float) -> dict[str, Any]:
    """A figure's ratio to the paper's."""
    return {"ratio": None if of["value"] is None else of["value"] / papers, "against": "the paper's"}


def kept(claim: dict[str, Any], limit: str, keeps: Callable[[float], bool]) -> dict[str, Any]:
    """The limit asked of a figure, and whether it is kept; says where the interval leaves that open."""
    value, low, high = claim["value"], claim.get("low"), claim.get("high")
    if value is None:
        return {"asked": limit, "met": False, "note": "not measured"}
    ends = [keeps(end) for end in (low, high) if end is not None]
    note = "the interval reaches across the limit" if len(set(ends)) > 1 else ""
    return {"asked": limit, "met": keeps(value), "note": note}
