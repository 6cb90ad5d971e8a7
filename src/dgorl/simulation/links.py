"""Radio links: path loss, shadowing that changes with the way, two directions that share it. METHOD §2."""

from __future__ import annotations

import numpy as np

from dgorl.configuration import Radio
from dgorl.radio import MINIMUM_DISTANCE, range_to_rssi
from dgorl.se2 import Array
from dgorl.simulation.scenario import RSSI_AT_1M_DBM, Scenario


def radio_of(scenario: Scenario) -> Radio:
    """The path-loss model of the scenario."""
    return Radio(
        rssi_at_1m_dbm=RSSI_AT_1M_DBM,
        path_loss_exponent=scenario.path_loss_exponent,
        sigma_db=scenario.shadowing_db,
        reciprocity=scenario.reciprocity,
    )


def rssi(scenario: Scenario, pair: str, ends: Array) -> Array:
    """RSSI of a link in both directions, in line of sight.

    ends: (T, 2, 2) positions of its two ends [m], one row a step.  Returns (T, 2) [dBm].
    """
    distance = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1)
    expected = range_to_rssi(np.maximum(distance, MINIMUM_DISTANCE), radio_of(scenario))
    return expected[:, None] + shadowing(scenario, pair, ends)


def shadowing(scenario: Scenario, pair: str, ends: Array) -> Array:
    """Shadowing of both directions (T, 2) [dB]: √ρ · common + √(1 − ρ) · own, each Gudmundson's AR(1).

    From one step to the next it keeps exp(−Δ/D), Δ: the ways of both ends added, D: the correlation distance.
    """
    draws = scenario.generator(f"shadowing {pair}").normal(size=(len(ends), 3))
    if scenario.shadowing_correlation > 0:
        way = np.linalg.norm(np.diff(ends, axis=0), axis=-1).sum(axis=-1)
        kept = np.exp(-way / scenario.shadowing_correlation)
        for k in range(1, len(draws)):
            draws[k] = kept[k - 1] * draws[k - 1] + np.sqrt(1.0 - kept[k - 1] ** 2) * draws[k]
    common, own = draws[:, :1], draws[:, 1:]
    share = scenario.reciprocity
    return np.asarray(scenario.shadowing_db * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own))
