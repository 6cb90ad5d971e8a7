"""The places a peer may be at: hypotheses about its cluster that put it at the same place count together. METHOD §4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import pi, sqrt

import numpy as np

from dgorl import se2
from dgorl.estimate import PeerHypothesis
from dgorl.expansion.apart import SAME
from dgorl.relative import Relative
from dgorl.se2 import Array
from dgorl.tracks import TrackKey

EVIDENCE = 2.0
"""σ of the difference of two log masses: Laplace's method takes an optimum for a Gaussian.

Of the exponents on the odds 0.5 to 0.6 made the true places the most likely, in 140 logs of simulated RSSI and ranges;
this makes 0.62.
"""

MISSED = 0.01
"""Probability that the peer is at none of the places kept: in up to 0.6 % of the ticks it was."""


def places_of(
    key: TrackKey, possible: Sequence[tuple[float, Mapping[TrackKey, Relative]]]
) -> tuple[PeerHypothesis, ...]:
    """Distinct places of a track, most probable first, with the probabilities that are published.

    possible: probability of each hypothesis, most probable first, and the tracks as it places them.
    """
    found: list[PeerHypothesis] = []
    for probability, relative in possible:
        if key not in relative:
            continue
        pose, covariance, tangent = relative[key]
        for k, place in enumerate(found):
            # In the tangent: the published ellipse covers the bend of the ring on which the places lie apart.
            difference, known = se2.between(place.pose, pose), place.tangent_covariance
            if known is not None and difference @ np.linalg.solve(known, difference) <= SAME**2:
                found[k] = replace(place, probability=place.probability + probability)
                break
        else:
            found.append(PeerHypothesis(probability, pose, covariance, tangent))
    said = published(np.array([place.probability for place in found]))
    found = [replace(place, probability=float(p)) for place, p in zip(found, said, strict=True)]
    return tuple(sorted(found, key=lambda place: -place.probability))


def published(probability: Array) -> Array:
    """Probabilities (K,) of all places that are kept as they are to be trusted: their sum is 1 − MISSED.

    Log odds Δ known to ±s are worth σ(Δ / √(1 + π s²/8)) on average (MacKay, Neural Computation 4, 1992, 720-736).
    """
    share = probability ** (1 / sqrt(1 + pi * EVIDENCE**2 / 8))
    return np.asarray((1 - MISSED) * share / max(float(share.sum()), 1e-300))
