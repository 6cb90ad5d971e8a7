"""The beam of hypotheses about a cluster, from node to node: carried on, searched anew, weighed. METHOD §4."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import floor, inf

import numpy as np

from dgorl import _core
from dgorl.consistency import astray, unfit
from dgorl.expansion import drafts, folds
from dgorl.expansion.carry import carried
from dgorl.expansion.cluster_graph import ClusterGraph, Optima, cluster_graph
from dgorl.expansion.contradicted_links import contradicted
from dgorl.expansion.decimated import Decimated, decimated
from dgorl.expansion.hypotheses import (
    CERTAIN,
    COARSE,
    TIE,
    Cluster,
    Hypothesis,
    Motion,
    agreement,
    both,
    distinct,
    fresh,
    probabilities,
    settled_pair,
)
from dgorl.expansion.passing import passed, passings
from dgorl.expansion.step import Group, Step, internal_links
from dgorl.history import WORLD_KEY
from dgorl.marginal import marginalized, stretches
from dgorl.observability_motion import mirrored, odometry_wander
from dgorl.se2 import Array
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Component, alone

STILL = 0.1
"""Who has gone less far than this [m] has not moved."""

WANDER = 0.05
"""Odometry that wanders off a straight line by more than this share of the way does not tell whether it is one."""

RECENT = 20
"""Keyframes of a hypothesis that ticks optimise; what came before is a prior to them."""

DRAFTS, IMPROVED, STARTS = 20, 7, 3
"""Candidate graphs that are optimised coarsely, more so, and wholly, at a time."""

SWEEPS = 4
"""Starts from the best hypothesis are tried again, from the better one they find, at most so often."""

WARM = 6
"""Warm particles of the best hypothesis."""


def expanded(
    step: Step, before: Cluster | None, components: Sequence[Component], since: float, sweeps: int = SWEEPS
) -> Cluster:
    """The cluster of these components at g, from what was known of it."""
    history, g = step.history, step.g
    first = floor(since * KEYFRAMES_PER_SECOND)
    base = first if before is None else max(before.base, first)
    groups = [tuple(component.stretches) for component in components]
    known = [] if before is None else carried(step, [h.component for h in before.hypotheses], groups, base)
    added = [_fresh(step, component, base) for component in components]
    unions = [_union([h, *(c for c in added if not c.stretches.keys() & h.stretches.keys())]) for h in known]
    union = unions[0] if unions else _union(added)
    union = Component(union.stretches, union.priors, internal_links(step, union, base / KEYFRAMES_PER_SECOND))
    graph = cluster_graph(history, union, groups, base, g)
    k = history.configuration.candidates
    shapes = drafts.shapes_of(graph, graph.start(_rigid(step, union, components)), graph.drift(), step.seed)
    coarse = decimated(graph, shapes.poses)
    optima = None
    if unions:
        starts = np.stack([graph.start(u) for u in unions])
        new = [j for j, c in enumerate(added) if not c.stretches.keys() & known[0].stretches.keys()]
        starts = _with_new(step, graph, starts, new, k) if new else starts
        optima = distinct(graph.optimize(coarse.whole(coarse.improve(coarse.optimize(starts)).poses)))
    starts = shapes.starts(drafts.cold(shapes, k)[:DRAFTS])
    if optima is None:
        optima = _searched(graph, coarse, None, starts)
        starts = starts[:0]
    for _ in range(sweeps):
        best = optima.mass[0]
        optima = _searched(graph, coarse, optima, np.concatenate([starts, _near(step, graph, optima)]))
        starts = starts[:0]
        if optima.mass[0] <= best + TIE:
            break
    other = passed(graph, optima.poses[0], passings(graph.window.layout, optima.poses[0], base))
    optima = distinct(both(optima, graph.optimize(other))) if len(other) else optima
    return beam(step, graph, optima, union, base, before)


def _near(step: Step, graph: ClusterGraph, optima: Optima) -> Array:
    """Starts (B, N, 3) from the best hypothesis: its mirror image, warm particles, bodies folded and placed anew.

    Those that the readings contradict are placed anew together.
    """
    near = drafts.shapes_of(graph, optima.poses[0], graph.drift(), step.seed)
    places = [folds.mirrored(near), folds.folded(near), drafts.warm(near, optima[[0]], WARM), drafts.reseeded(near)]
    off = contradicted(graph.window, optima.poses[0], graph.bodies)
    if off:
        places.append(drafts.regrown(near, [b for b, keys in enumerate(graph.bodies) if not off & set(keys)]))
    return near.starts(np.concatenate(places))


def _rigid(step: Step, union: Component, components: Sequence[Component]) -> Component:
    """Single tracks as odometry has them, joined components as a hypothesis does."""
    singles = {}
    for key in (c.tracks[0] for c in components if len(c.stretches) == 1):
        first = union.stretches[key].first / KEYFRAMES_PER_SECOND
        singles[key] = alone(step.tracks[key], first, step.g).stretches[key]
    return Component({**union.stretches, **singles})


def _searched(graph: ClusterGraph, coarse: Decimated, optima: Optima | None, starts: Array) -> Optima:
    """The best of the optima and of what candidate graphs lead to: coarsely all of them, wholly the few best."""
    tried = coarse.optimize(starts)
    found = coarse.improve(distinct(tried, IMPROVED, np.inf))
    if optima is None:
        return distinct(graph.optimize(coarse.whole(distinct(found, STARTS, COARSE).poses)))
    new = fresh(coarse.improve(coarse.optimize(optima.poses)), found, STARTS)
    return distinct(both(optima, graph.optimize(coarse.whole(new.poses)))) if len(new.mass) else optima


def _with_new(step: Step, graph: ClusterGraph, starts: Array, fresh: list[int], k: int) -> Array:
    """Starts in which components new to the cluster are placed where each hypothesis sees them."""
    placed = [j for j in range(len(graph.bodies)) if j not in fresh]
    grown = []
    for start in starts[: max(STARTS // k, 1)]:
        shapes = drafts.shapes_of(graph, start, graph.drift(), step.seed)
        found = drafts.complete(shapes, np.zeros((1, shapes.size, 3)), np.zeros(1), placed, k)
        grown.append(shapes.starts(found))
    return np.concatenate(grown)[: 2 * STARTS]


def _fresh(step: Step, component: Component, base: int) -> Component:
    """A component as it enters a cluster: single tracks from the base on."""
    if len(component.stretches) > 1 or WORLD_KEY in component.stretches:
        return Component(component.stretches, component.priors)
    key = component.tracks[0]
    return alone(step.tracks[key], max(base / KEYFRAMES_PER_SECOND, step.since.get(key, -inf)), step.g)


def _union(components: Sequence[Component]) -> Component:
    """Several components side by side, each in its own frame."""
    stretches = {key: s for component in components for key, s in component.stretches.items()}
    return Component(stretches, tuple(prior for component in components for prior in component.priors))


def beam(
    step: Step, graph: ClusterGraph, optima: Optima, union: Component, base: int, before: Cluster | None
) -> Cluster:
    """The beam of these optima as a cluster."""
    probability = probabilities(optima.mass)
    pin = floor(step.g * KEYFRAMES_PER_SECOND) - RECENT
    hypotheses = []
    for poses, mass, p in zip(optima.poses, optima.mass, probability, strict=True):
        component = Component(stretches(graph.window, poses, None), union.priors)
        recent = component
        if pin > graph.window.base:
            recent = Component(stretches(graph.window, poses, pin), marginalized(graph.window, poses, pin))
        same = len(optima.mass) == 1 or recent is component
        recent_mass = float(mass) if same else _mass(step, graph.bodies, recent)
        hypotheses.append(Hypothesis(component, float(mass), float(p), recent, recent_mass))
    agreed = {}
    # Whom a contradicting link is wrong about is not known: a whole side of the team may be folded.
    stands = not contradicted(graph.window, optima.poses[0], graph.bodies)
    keys, body = graph.keys, graph.body[graph.newest]
    for a, b in combinations(range(len(keys)), 2):
        if (
            stands
            and body[a] != body[b]
            and (len(probability) == 1 or agreement(optima, probability, a, b) >= CERTAIN)
            and settled_pair(optima, a, b)
        ):
            agreed[keys[a], keys[b]] = 1 + (0 if before is None else before.agreed.get((keys[a], keys[b]), 0))
    known = {} if before is None else before.unfit
    off = unfit(graph.window, optima.poses[0], step.g, graph.bodies)
    bad = {key: 1 + known.get(key, 0) for key in sorted(off)}
    lost = 0
    if astray(graph.window, optima.poses[0], step.g, graph.bodies):
        lost = 1 + (0 if before is None else before.astray)
    motion = _motion(step, graph, optima.poses[0])
    passing = None if before is None else before.passing
    if passing is not None and not set(passing) <= set(keys):
        passing = None
    begun = step.index if before is None else before.begun
    return Cluster(base, graph.bodies, tuple(hypotheses), agreed, motion, bad, passing, begun, lost)


def _mass(step: Step, groups: Sequence[Group], recent: Component) -> float:
    """Log mass of the recent part of a hypothesis where it stands."""
    base = min(recent.stretches[key].first for key in recent.tracks)
    unit = Component(recent.stretches, recent.priors, internal_links(step, recent, base / KEYFRAMES_PER_SECOND))
    graph = cluster_graph(step.history, unit, groups, base, step.g)
    poses = graph.start(unit)[None]
    return float(graph.weigh(poses, graph.graph.costs(poses)).mass[0])


def _motion(step: Step, graph: ClusterGraph, poses: Array) -> Motion:
    """Whether every track has gone straight, or none has moved, as far as odometry can tell."""
    paths, wander, still = [], [], []
    for key, (offset, first, count) in graph.window.layout.items():
        delta, information = _core.odometry([step.tracks[key].core], [first], [first + count - 1])
        path = poses[offset : offset + count, :2]
        noise = np.asarray(np.linalg.inv(information))
        paths.append(path)
        wander.append(odometry_wander(delta, noise) if len(delta) else 0.0)
        reach = np.sqrt(np.trace(noise[:, :2, :2], axis1=1, axis2=2).sum()) if len(delta) else 0.0
        still.append(float(np.hypot(*np.ptp(path, axis=0))) <= STILL + 3 * reach and _way(delta) <= STILL)
    if all(still):
        return "still"
    if not mirrored(paths, wander):
        return ""
    # Wheels wander by a few per cent of a straight way: a bent path is no straight one because they may wander farther.
    extents = [float(np.hypot(*np.ptp(path, axis=0))) for path in paths]
    plausible = [min(noise, WANDER * extent) for noise, extent in zip(wander, extents, strict=True)]
    return "straight" if mirrored(paths, plausible) else "uncertain"


def _way(delta: Array) -> float:
    """Length of the way that odometry reports [m]."""
    return float(np.hypot(delta[:, 0], delta[:, 1]).sum()) if len(delta) else 0.0
