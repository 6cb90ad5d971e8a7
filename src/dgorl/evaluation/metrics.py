"""Errors, consistency and the summary of a replay (METHOD §8): pure functions of its records.

Nothing is aligned. What counts is the same everywhere: position figures take ticks with status ``position``
or ``tracked`` ("located"), headings and NEES ``tracked`` alone, ``all_ticks_…`` every tick that has a pose. A
tick without truth counts in no error; a figure nothing counts in is None.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dgorl.estimate import Status
from dgorl.evaluation.records import PairRecord, Records
from dgorl.se2 import Array, wrap

CHI2_95_2DOF = 5.991464547107979
"""a 2-dof squared Mahalanobis distance is below this 95 % of the time"""
WRONG = 1.5
"""a located peer further off than this is wrong [m]"""


def position_error(record: PairRecord) -> Array:
    """e_ij = R̂_iᵀ(p̂_j − p̂_i) − R_iᵀ(p_j − p_i): (T, 2) [m]."""
    return np.asarray(record.pose[:, :2] - record.truth[:, :2])


def heading_error(record: PairRecord) -> Array:
    """wrap((θ̂_j − θ̂_i) − (θ_j − θ_i)): (T,) [rad]."""
    return wrap(record.pose[:, 2] - record.truth[:, 2])


def position_nees(record: PairRecord) -> Array:
    """e_ijᵀ P_xy⁻¹ e_ij, 2 degrees of freedom: (T,), NaN without pose or truth."""
    return _mahalanobis(position_error(record), record.covariance[:, :2, :2])


def nees(record: PairRecord) -> Array:
    """Normalised squared error of the whole pose, 3 degrees of freedom: (T,), NaN without pose or truth."""
    error = np.column_stack([position_error(record), heading_error(record)])
    return _mahalanobis(error, record.covariance)


def position_sigma(covariance: Array) -> Array:
    """σ of the position in its worst direction [m]: covariance (T, 3, 3) → (T,), the root of the largest eigenvalue."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b)))


def bound_95(record: PairRecord) -> Array:
    """Largest half-axis of the 95 % position ellipse: (T,) [m]; at least 95 % of errors should be below."""
    return np.asarray(np.sqrt(CHI2_95_2DOF) * position_sigma(record.covariance))


def nees_per_tick(records: Sequence[PairRecord]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Mean 3-dof NEES over the tracked pairs of each tick, (T,) stamps, (T,) means, (T,) how many pairs.

    Compare with :func:`nees_band` of that many; pairs of one team share errors, so that band is narrow.
    """
    stamps, values = _pool(records, lambda r: r.t, _tracked), _pool(records, nees, _tracked)
    t, tick, count = np.unique(stamps, return_inverse=True, return_counts=True)
    return t, np.bincount(tick, values, len(t)) / count, count


def nees_band(count: int, dof: int = 3, level: float = 0.95) -> tuple[float, float]:
    """Where the mean of ``count`` independent NEES of ``dof`` lies with probability ``level``.

    χ² quantiles by Wilson and Hilferty: within 1 % from 9 degrees of freedom (count · dof) up, the upper one
    always.
    """
    n = count * dof
    z = NormalDist().inv_cdf((1 + level) / 2) * np.sqrt(2 / (9 * n))
    centre = 1 - 2 / (9 * n)
    return float(dof * max(centre - z, 0.0) ** 3), float(dof * (centre + z) ** 3)


def predicted_over_measured(records: Sequence[PairRecord]) -> float | None:
    """Position RMSE promised by the covariances ÷ measured, over located ticks: below 1 is too sure."""
    predicted = _pool(records, lambda r: r.covariance[:, 0, 0] + r.covariance[:, 1, 1], _located)
    measured = _pool(records, _squared_position, _located)
    return float(np.sqrt(predicted.mean() / measured.mean())) if len(measured) and measured.any() else None


def bootstrap_rmse(
    trials: Sequence[Array], level: float = 0.95, draws: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Interval of the RMSE pooled over trials, resampling whole trials.

    trials: the squared errors of each, any length; errors within a trial go together and stay together.
    """
    total, count = np.array([np.sum(e) for e in trials]), np.array([len(e) for e in trials])
    drawn = np.random.default_rng(seed).integers(len(trials), size=(draws, len(trials)))
    with np.errstate(invalid="ignore"):
        rmse = np.sqrt(total[drawn].sum(1) / count[drawn].sum(1))
    low, high = np.nanquantile(rmse, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def squared_errors(records: Sequence[PairRecord]) -> Array:
    """Squared position errors over located ticks, pooled, as :func:`bootstrap_rmse` takes them [m²]."""
    return _pool(records, _squared_position, _located)


def time_to_track(record: PairRecord) -> float | None:
    """From the first tick to the first with the peer located [s]; None if never."""
    located = np.flatnonzero(record.located)
    return float(record.t[located[0]] - record.t[0]) if len(located) else None


def summarize(records: Records) -> dict[str, Any]:
    """``ticks``, ``team`` and ``egos`` of summary.json; names and meaning are INTERFACES'."""
    egos = {}
    for ego in records.egos:
        peers = records.of(ego)
        egos[ego] = {
            "tick_ms": {
                "median": _quantile(records.tick_s[ego], 0.5),
                "p99": _quantile(records.tick_s[ego], 0.99),
            },
            **figures(list(peers.values())),
            "rejected": dict(sorted(records.last[ego].rejected.items())) if ego in records.last else {},
            "peers": {
                peer: figures([record]) | {"time_to_track_s": time_to_track(record)} | _at_the_end(record)
                for peer, record in peers.items()
            },
        }
    return {"ticks": len(records.stamps), "team": figures(records.between_robots()), "egos": egos}


def figures(records: Sequence[PairRecord]) -> dict[str, float | None]:
    """The figures of the ``team`` entry of summary.json, pooled over pairs and ticks."""
    located = _pool(records, _squared_position, _located)
    turned = _pool(records, lambda r: heading_error(r) ** 2, _tracked)
    consistency = _pool(records, nees, _tracked)
    share = np.array([located for r in records for located in r.located], dtype=bool)
    return {
        "position_rmse_m": _root_mean(located),
        "heading_rmse_deg": _degrees(_root_mean(turned)),
        "position_median_m": _median(np.sqrt(located)),
        "all_ticks_position_rmse_m": _root_mean(_pool(records, _squared_position, _any)),
        "all_ticks_heading_rmse_deg": _degrees(_root_mean(_pool(records, lambda r: heading_error(r) ** 2, _any))),
        "tracked_fraction": _mean(share),
        "wrong_fraction": _mean(located > WRONG**2),
        "coverage_95": _mean(_pool(records, position_nees, _located) <= CHI2_95_2DOF),
        "nees_mean": _mean(consistency),
        "nees_median": _median(consistency),
        "truth_fraction": _mean(np.isfinite([place for r in records for place in r.truth[:, 0]])),
    }


def _at_the_end(record: PairRecord) -> dict[str, str]:
    """Status at the last tick, why it is no better and what would help."""
    if not len(record.t):
        return {}
    return {"status": str(record.status[-1]), "reason": record.reason[-1], "resolve_by": record.resolve_by[-1]}


def _pool(
    records: Iterable[PairRecord],
    value: Callable[[PairRecord], Array],
    counts: Callable[[PairRecord], NDArray[np.bool_]],
) -> Array:
    """``value`` of every tick that counts and has truth, over all records."""
    parts = [value(r)[counts(r) & np.isfinite(_squared_position(r))] for r in records]
    return np.concatenate(parts) if parts else np.empty(0)


def _squared_position(record: PairRecord) -> Array:
    return np.asarray(np.sum(position_error(record) ** 2, axis=1))


def _located(record: PairRecord) -> NDArray[np.bool_]:
    return record.located


def _tracked(record: PairRecord) -> NDArray[np.bool_]:
    return record.having(Status.TRACKED)


def _any(record: PairRecord) -> NDArray[np.bool_]:
    return np.ones(len(record.t), dtype=bool)


def _mahalanobis(error: Array, covariance: Array) -> Array:
    """eᵀ P⁻¹ e row by row, NaN where either is NaN."""
    known = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    out = np.full(len(error), np.nan)
    e = error[known]
    out[known] = np.einsum("ni,ni->n", e, np.linalg.solve(covariance[known], e[..., None])[..., 0])
    return out


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if len(values) else None


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None


def _root_mean(squares: Array) -> float | None:
    return float(np.sqrt(squares.mean())) if len(squares) else None


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else float(np.degrees(angle))


def _quantile(seconds: Array, q: float) -> float | None:
    return float(1e3 * np.quantile(seconds, q)) if len(seconds) else None
