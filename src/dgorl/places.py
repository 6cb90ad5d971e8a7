"""The places a peer may be at: hypotheses about its cluster that put it at the same place count together. METHOD §4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dgorl import se2
from dgorl.estimate import PeerHypothesis
from dgorl.expansion.apart import SAME
from dgorl.relative import Relative
from dgorl.tracks import TrackKey


def places_of(
    key: TrackKey, possible: Sequence[tuple[float, Mapping[TrackKey, Relative]]]
) -> tuple[PeerHypothesis, ...]:
    """Distinct places of a track, most probable first.

    possible: probability of each hypothesis, most probable first, and the tracks as it places them.
    """
    found: list[PeerHypothesis] = []
    for probability, relative in possible:
        if key not in relative:
            continue
        pose, covariance, tangent = relative[key]
        for k, place in enumerate(found):
            difference = pose - place.pose
            difference[2] = se2.wrap(difference[2])
            if difference @ np.linalg.solve(place.covariance, difference) <= SAME**2:
                found[k] = replace(place, probability=place.probability + probability)
                break
        else:
            found.append(PeerHypothesis(probability, pose, covariance, tangent))
    return tuple(sorted(found, key=lambda place: -place.probability))
