"""The log-distance path-loss model between robots. METHOD §2."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dgorl.configuration import Radio
from dgorl.se2 import Array

MINIMUM_DISTANCE = 0.1
"""Distances are clamped here [m]: the model has no meaning inside an antenna."""


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
    exponent = (radio.rssi_at_1m_dbm - np.asarray(rssi_dbm, dtype=float)) / (10.0 * radio.path_loss_exponent)
    return np.asarray(10.0**exponent)


def relative_sigma(radio: Radio) -> float:
    """s = ln10·σ_dB/(10η): the standard deviation of ln d̂."""
    return float(np.log(10.0) * radio.sigma_db / (10.0 * radio.path_loss_exponent))
