"""A node's step in the expansion, and what its parts share. METHOD §4."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dgorl.history import History
from dgorl.tracks import Track, TrackKey
from dgorl.window import Component, Link, links, stands

SPACING = 5.0
"""Seconds between nodes."""

WHOLE = 24
"""Up to so many tracks are treated together; more of them part by part."""

LARGEST = 12
"""Tracks of such a part: n_max of METHOD §6."""

Group = tuple[TrackKey, ...]
"""The tracks of a component, the world among them."""


@dataclass(frozen=True)
class Step:
    """Where a cluster is taken at node time g [s], with the tracks known there."""

    history: History
    tracks: Mapping[TrackKey, Track]
    g: float
    since: Mapping[TrackKey, float] = field(default_factory=dict)

    @property
    def index(self) -> int:
        """Number of the node."""
        return int(self.g // SPACING)

    @property
    def seed(self) -> tuple[int, int]:
        return self.history.configuration.seed, self.index % 2**31


def restricted(component: Component, keys: Iterable[TrackKey]) -> Component:
    """What a component knows of some of its tracks alone."""
    keys = set(keys)
    priors = tuple(p for p in component.priors if {p.reference, *p.members} <= keys)
    return Component({key: s for key, s in component.stretches.items() if key in keys}, priors)


def internal_links(step: Step, component: Component, low: float) -> tuple[Link, ...]:
    """Measured relative poses inside a component since ``low`` [s]."""
    inside = component.stretches
    return tuple(
        link
        for link in links(step.history, step.tracks, low, step.g)
        if {link.reference, link.robot} <= inside.keys()
        and stands(component, link.reference, link.stamp_reference)
        and stands(component, link.robot, link.stamp_robot)
    )


def beside(component: Component, keys: Sequence[TrackKey]) -> Sequence[TrackKey]:
    """Some tracks and those nearest to the first of them, as many as are taken apart at a time."""
    x, y, _ = component.stretches[keys[0]].poses[-1]
    far = {key: float(np.hypot(*(s.poses[-1, :2] - (x, y)))) for key, s in component.stretches.items()}
    return sorted(component.tracks, key=lambda key: (key not in keys, far[key], key))[:LARGEST]
