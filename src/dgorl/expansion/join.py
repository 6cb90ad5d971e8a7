"""Components that were found certain as one component. METHOD §4, join."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from dgorl import se2
from dgorl.expansion.contradicted_links import contradicted
from dgorl.expansion.decimated import smoothed
from dgorl.expansion.hypotheses import Cluster
from dgorl.expansion.step import WHOLE, Step, internal_links, restricted
from dgorl.marginal import settled
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component, Prior, Stretch


@dataclass(frozen=True)
class Agreement:
    """A cluster and the pairs of its tracks whose relative pose is accepted."""

    cluster: Cluster
    pairs: Sequence[tuple[TrackKey, TrackKey]]

    @property
    def best(self) -> Component:
        return self.cluster.hypotheses[0].component


def joined_whole(step: Step, cluster: Cluster, components: Sequence[Component], boundary: float) -> Component:
    """One component of several, placed as the best hypothesis has them; a weak prior keeps it proper.

    Raises ValueError when a pose is left undetermined or the readings contradict it.
    """
    keys = {key for component in components for key in component.stretches}
    best = restricted(cluster.hypotheses[0].component, keys)
    return _settled(step, best, components, cluster.base / KEYFRAMES_PER_SECOND, boundary)


def joined_parts(
    step: Step, found: Sequence[Agreement], components: Mapping[int, Component], boundary: float
) -> Component:
    """One component of several, by number, of which clusters know parts: each as it is, where its part stands.

    Tracks that were alone come as the best hypothesis bends them, with all that was measured since the cluster's base.
    Raises ValueError when what agrees does not place them all or readings contradict it.
    """
    home = {key: k for k, component in components.items() for key in component.tracks}
    own = dict(components)
    for agreement in found:
        for key in (key for key in agreement.best.tracks if key in home and len(components[home[key]].stretches) == 1):
            own[home[key]] = Component({key: agreement.best.stretches[key]})
    placed = {min(own): np.zeros(3)}
    pairs = [(agreement.best, pair) for agreement in found for pair in agreement.pairs if set(pair) <= home.keys()]
    before = 0
    while before < len(placed):
        before = len(placed)
        for best, pair in pairs:
            for a, b in (pair, pair[::-1]):
                if home[a] in placed and home[b] not in placed:
                    moved = _placed(best, own[home[a]].stretches[a], own[home[b]].stretches[b], a, b)
                    if moved is not None:
                        placed[home[b]] = se2.compose(placed[home[a]], moved)
    if len(placed) < len(own):
        raise ValueError("what agrees does not place them all")
    stretches = {
        key: Stretch(s.first, se2.compose(placed[k], s.poses)) for k in own for key, s in own[k].stretches.items()
    }
    union = Component(stretches, tuple(prior for component in own.values() for prior in component.priors))
    low = min(stretches[key].first for key in union.tracks) / KEYFRAMES_PER_SECOND
    union = smoothed(step, union) if len(union.tracks) > WHOLE else union
    return _settled(step, union, list(own.values()), low, boundary)


def _placed(best: Component, on_a: Stretch, on_b: Stretch, a: TrackKey, b: TrackKey) -> Array | None:
    """How to move what b's stretch is part of, to stand to a as in ``best``; None if they never stand together."""
    ends = [on_a, on_b, best.stretches[a], best.stretches[b]]
    keyframe = min(s.first + len(s.poses) - 1 for s in ends)
    if keyframe < max(s.first for s in ends):
        return None
    at_a, at_b, from_a, to_b = (s.poses[keyframe - s.first] for s in ends)
    return se2.compose(se2.compose(at_a, se2.between(from_a, to_b)), se2.inverse(at_b))


def _settled(step: Step, best: Component, components: Sequence[Component], low: float, boundary: float) -> Component:
    weak = _weak(best, components)
    best = Component(best.stretches, (*best.priors, *weak), internal_links(step, best, low))
    found = settled(step.history, best, low, step.g, boundary)
    bodies = [tuple(component.stretches) for component in components]
    if contradicted(found.window, found.poses, bodies):  # parts know no readings between one another
        raise ValueError("the readings contradict what agreed")
    return found.component


def _weak(best: Component, components: Sequence[Component]) -> tuple[Prior, ...]:
    """Π between the body of the first track and each other one, at the newest keyframe where a track of both stands.

    A robot's earlier epoch is a track that ends, perhaps before the cluster begins: it need not be in ``best``.
    """
    bodies = [[key for key in component.tracks if key in best.stretches] for component in components]
    first = next(body for body in bodies if best.tracks[0] in body)
    found = []
    for body in bodies:
        abreast = None if body is first else _abreast(best, first, body)
        if abreast is None:
            continue
        keyframe, pair = abreast
        a, b = (best.stretches[key].poses[keyframe - best.stretches[key].first] for key in pair)
        relative = se2.between(a, b)
        sigma = max(float(np.hypot(relative[0], relative[1])), 5.0)
        information = np.diag([sigma**-2, sigma**-2, np.pi**-2])
        found.append(Prior(keyframe, pair[0], (pair[1],), relative[None], information, np.zeros(3)))
    return tuple(found)


def _abreast(best: Component, a: Sequence[TrackKey], b: Sequence[TrackKey]) -> tuple[int, tuple[TrackKey, ...]] | None:
    """The newest keyframe at which a track of both bodies stands, and these two; None if there is none."""
    found = []
    for pair in product(a, b):
        ends = [best.stretches[key] for key in pair]
        newest = min(s.first + len(s.poses) - 1 for s in ends)
        if newest >= max(s.first for s in ends):
            found.append((newest, pair))
    return max(found, key=lambda item: item[0], default=None)  # of several the first in canonical order
