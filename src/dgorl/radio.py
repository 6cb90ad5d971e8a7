"""The log-distance path-loss model between robots. METHOD §2."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dgorl.configuration import Radio
from dgorl.se2 import Array

MINIMUM_DISTANCE = 0.1
"""Distances are clamped here [m]: the model has no meaning inside an antenna."""

DECADES = 10.0
"""Distances are from 10⁻¹⁰ to 10¹⁰ m."""


def range_to_rssi(distance: ArrayLike, radio: Radio) -> Array:
    """Expected RSSI at a distance.

    distance: (...,) [m], > 0.  Returns (...,) [dBm].
    Raises ValueError for a distance that is not positive.
    """
    d = np.asarray(distance, dtype=float)
    if not np.all(d > 0):
        raise ValueError("distance must be positive")
    d = np.maximum(d, MINIMUM_DISTANCE)
    return np.asarray(radio.rssi_at_1m_dbm - 10.0 * radio.path_loss_exponent * np.log10(d))


def rssi_to_range(rssi_dbm: ArrayLike, radio: Radio) -> Array:
    """Most likely distance at an RSSI: d = 10^((A − RSSI)/(10η)), the paper's range model.

    rssi_dbm: (...,).  Returns (...,) [m].  Its mean is too long by exp(s²/2), see :func:`relative_sigma`.
    """
    return distances(rssi_dbm, radio.rssi_at_1m_dbm, radio.path_loss_exponent)


def distances(rssi_dbm: ArrayLike, rssi_at_1m_dbm: float, exponent: float) -> Array:
    """:func:`rssi_to_range` of a path-loss model's two numbers. No more than 10¹⁰ m, whatever is claimed."""
    decades = (rssi_at_1m_dbm - np.asarray(rssi_dbm, dtype=float)) / (10.0 * exponent)
    return np.asarray(10.0 ** np.clip(decades, -DECADES, DECADES))


def relative_sigma(radio: Radio) -> float:
    """s = ln10·σ_dB/(10η): the standard deviation of ln d̂."""
    return float(np.log(10.0) * radio.sigma_db / (10.0 * radio.path_loss_exponent))
