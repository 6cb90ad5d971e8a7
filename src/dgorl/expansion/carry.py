"""Hypotheses from one node to the next: longer at one end, shorter at the other. METHOD §4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dgorl.expansion.step import Group, Step, internal_links, restricted
from dgorl.history import WORLD_KEY
from dgorl.marginal import marginalized
from dgorl.tracks import KEYFRAMES_PER_SECOND, TrackKey
from dgorl.window import Component, Stretch, assemble, extended


def carried(step: Step, hypotheses: Sequence[Component], groups: Sequence[Group], base: int) -> list[Component]:
    """Hypotheses carried on to g, of the tracks that are still there, from keyframe ``base`` on.

    What is older is dropped; inside components that are joined it becomes their prior, one for all hypotheses.
    """
    keys = {key for group in groups for key in group}
    units = [extended(restricted(unit, keys), step.tracks, step.g) for unit in hypotheses]
    old = [group for group in groups if any(_begins(units[0], key) < base for key in group)]
    if not old:
        return units
    priors = [p for p in units[0].priors if not any(p.reference in group for group in old)]
    for group in old:
        inside = restricted(units[0], group)
        if len(inside.stretches) > 1:
            low = min(_begins(inside, key) for key in inside.tracks) / KEYFRAMES_PER_SECOND
            inside = Component(inside.stretches, inside.priors, internal_links(step, inside, low))
            window = assemble(step.history, inside, low, step.g, base)
            priors += marginalized(window, window.problem.initial, base)
    return [Component(_since(unit, base), tuple(priors)) for unit in units]


def _begins(unit: Component, key: TrackKey) -> int:
    """First keyframe of a track; of the world, or one that is not there, later than all."""
    return unit.stretches[key].first if key in unit.stretches and key != WORLD_KEY else 2**62


def _since(unit: Component, base: int) -> Mapping[TrackKey, Stretch]:
    """Stretches from keyframe ``base`` on."""
    kept = {}
    for key, stretch in unit.stretches.items():
        skip = 0 if key == WORLD_KEY else max(base - stretch.first, 0)
        if skip < len(stretch.poses):
            kept[key] = Stretch(stretch.first + skip, stretch.poses[skip:])
    return kept
