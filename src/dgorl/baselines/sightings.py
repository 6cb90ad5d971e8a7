"""What a filter takes of the team's tables: readings that nothing can replace any more, each once. METHOD §1, §2."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import ceil

import numpy as np

from dgorl import se2
from dgorl.configuration import Bearings, Radio, Ranging
from dgorl.history import LATE, History
from dgorl.optimization.problem import Loss
from dgorl.se2 import Array
from dgorl.tracks import Track


@dataclass(frozen=True, eq=False)
class Sighting:
    """One reading between two robots, placed on their tracks: at_a, at_b (3,) in the frames of their keyframes.

    height: difference of the antennas' [m].
    """

    kind: str
    stamp: float
    a: Track
    b: Track
    keyframe_a: int
    keyframe_b: int
    at_a: Array
    at_b: Array
    height: float
    value: float
    sigma: float
    loss: Loss

    @property
    def keyframe(self) -> int:
        """The later of both ends'."""
        return max(self.keyframe_a, self.keyframe_b)


class Sightings:
    """The readings of a history, in the order in which a filter may use them."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._used: set[tuple[object, ...]] = set()

    def new(self, now: float) -> list[Sighting]:
        """Those that became usable since the last call, by stamp.

        A reading is usable when both robots' odometry tells of its stamp and its thinning bin has ended: a filter
        cannot take back what it has used. What waits for longer than 10 s is not used.
        """
        tracks = {track.core.number: track for track in self._history.tracks}
        found = [sighting for kind in self._history.tables for sighting in self._of(kind, tracks, now)]
        self._used = {key for key in self._used if _stamp(key) > now - 3 * LATE}
        return sorted(found, key=lambda s: (s.stamp, s.kind, s.a.key, s.b.key, s.value))

    def _of(self, kind: str, tracks: Mapping[int, Track], now: float) -> Iterator[Sighting]:
        configuration = self._history.configuration
        sensors: Mapping[str, Radio | Ranging | Bearings] = {
            "rssi": configuration.radio,
            "range": configuration.ranging,
            "bearing": configuration.bearings,
        }
        sensor, table = sensors[kind], self._history.tables[kind]
        rows = table.between(now - LATE - sensor.thinning, now)
        known = {number: track.core.known(now) for number, track in tracks.items()}
        for stamp, value, sigma, a, b, keyframe_a, keyframe_b, at_a, at_b in zip(*rows, strict=True):
            key = (kind, float(stamp), int(a), int(b), float(value))
            if key in self._used or int(a) not in tracks or int(b) not in tracks:
                continue
            if stamp > min(known[int(a)], known[int(b)]) or _end(float(stamp), sensor.thinning) > now:
                continue
            self._used.add(key)
            one, other, height = tracks[int(a)], tracks[int(b)], 0.0
            if kind != "bearing":
                (xa, ya, za), (xb, yb, zb) = (self._history.antenna(t.key.robot) for t in (one, other))
                at_a, at_b = se2.compose(at_a, (xa, ya, 0.0)), se2.compose(at_b, (xb, yb, 0.0))
                height = za - zb
            yield Sighting(
                kind, float(stamp), one, other, int(keyframe_a), int(keyframe_b), np.array(at_a), np.array(at_b),
                height, float(value), float(sigma), Loss(sensor.kernel, sensor.width),
            )  # fmt: skip


def _end(stamp: float, thinning: float) -> float:
    """When the reading's bin ends [s]."""
    return ceil(stamp / thinning) * thinning if thinning > 0 else stamp


def _stamp(key: tuple[object, ...]) -> float:
    stamp = key[1]
    assert isinstance(stamp, float)
    return stamp
