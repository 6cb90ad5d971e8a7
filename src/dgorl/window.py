"""The window graph of one component: its tracks from the boundary on, with everything measured there. METHOD §1.

``grow`` extends what a node knows by odometry and joins what relative poses link; ``assemble`` lays it out as the
flat arrays of a :class:`~dgorl.optimization.problem.Problem`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from dgorl import _core, se2
from dgorl.configuration import Bearings, Radio, Ranging
from dgorl.history import WORLD_KEY, History
from dgorl.measurements import RelativePose
from dgorl.optimization.problem import DensePrior, Indices, Loss, Problem, RelativePoses, Scalars
from dgorl.se2 import Array
from dgorl.sightings import Rows
from dgorl.tracks import KEYFRAMES_PER_SECOND, Track, TrackKey


class Stretch(NamedTuple):
    """Poses (K, 3) of a track's keyframes ``first``, ``first`` + 1, … in its component's frame."""

    first: int
    poses: Array


@dataclass(frozen=True)
class Prior:
    """What the marginalised past says of the members' poses at boundary ``keyframe``, relative to ``reference``."""

    keyframe: int
    reference: TrackKey
    members: tuple[TrackKey, ...]
    relative: Array
    information: Array
    gradient: Array


@dataclass(frozen=True)
class Component:
    """Tracks whose relative poses are accepted, in canonical order; the world, if a member, comes last."""

    stretches: Mapping[TrackKey, Stretch]
    priors: tuple[Prior, ...] = ()
    links: tuple[Link, ...] = ()

    @property
    def tracks(self) -> tuple[TrackKey, ...]:
        return tuple(sorted(key for key in self.stretches if key != WORLD_KEY))

    @property
    def has_world(self) -> bool:
        return WORLD_KEY in self.stretches


class Link(NamedTuple):
    """A relative pose inside the window, placed on its tracks."""

    pose: RelativePose
    reference: TrackKey
    robot: TrackKey
    stamp_reference: float
    stamp_robot: float


@dataclass(frozen=True)
class Window:
    """A problem and where each track's poses are in it: key → (index of the first pose, first keyframe, count)."""

    problem: Problem
    layout: Mapping[TrackKey, tuple[int, int, int]]
    world: int | None
    base: int
    """keyframe index of slot 0"""
    stamps: tuple[Array, ...] = field(default=(), repr=False)
    """of the rows of each of the problem's scalars [s]"""

    def index(self, key: TrackKey, keyframe: int) -> int:
        """Index of a track's pose at a keyframe."""
        if key == WORLD_KEY:
            assert self.world is not None
            return self.world
        offset, first, _ = self.layout[key]
        return offset + keyframe - first


WORLD_STRETCH = Stretch(0, np.zeros((1, 3)))


def grow(
    history: History,
    components: Iterable[Component],
    low: float,
    limit: float,
    since: Mapping[TrackKey, float] | None = None,
) -> list[Component]:
    """Components extended to ``limit`` [s] by odometry, from window start ``low`` [s] on, joined where poses link them.

    Every track with odometry in the window is in exactly one of the components returned, alone if nothing links it.
    since: from when on a track counts, if it was cut off its component [s].
    """
    tracks = {t.key: t for t in history.tracks if t.core.known(limit) >= max(low, t.key.begin)}
    units = [extended(unit, tracks, limit) for unit in components]
    taken = {key for unit in units for key in unit.stretches}
    units += [
        alone(track, max(low, (since or {}).get(key, low)), limit) for key, track in tracks.items() if key not in taken
    ]
    if not any(unit.has_world for unit in units):
        units.append(Component({WORLD_KEY: WORLD_STRETCH}))
    for link in links(history, tracks, low, limit):
        a = next(unit for unit in units if link.reference in unit.stretches)
        b = next(unit for unit in units if link.robot in unit.stretches)
        if not (stands(a, link.reference, link.stamp_reference) and stands(b, link.robot, link.stamp_robot)):
            continue
        units = [unit for unit in units if unit is not a and unit is not b]
        units.append(_joined(a, b, link, tracks))
    return sorted((u for u in units if u.tracks), key=lambda unit: unit.tracks[0])


def assemble(history: History, component: Component, low: float, limit: float, pin: int | None) -> Window:
    """The component's window as a problem. Without the world, the first track's pose at keyframe ``pin`` is fixed."""
    keys = component.tracks
    layout: dict[TrackKey, tuple[int, int, int]] = {}
    offset = 0
    for key in keys:
        stretch = component.stretches[key]
        layout[key] = (offset, stretch.first, len(stretch.poses))
        offset += len(stretch.poses)
    world = offset if component.has_world else None
    base = min(first for _, first, _ in layout.values())
    size = offset + (world is not None)
    slots, fixed, initial = np.full(size, -1), np.zeros(size, dtype=bool), np.zeros((size, 3))
    for key, (start, first, count) in layout.items():
        slots[start : start + count] = np.arange(first - base, first - base + count)
        initial[start : start + count] = component.stretches[key].poses
    fixed[_pinned(layout, pin) if world is None else world] = True
    window = Window(_EMPTY, layout, world, base)
    tracks = {track.key: track for track in history.tracks}
    scalars, stamps = _scalars(history, window, tracks, low, limit)
    radio = history.configuration.radio
    problem = Problem(
        slots=slots,
        fixed=fixed,
        initial=initial,
        odometry=_odometry(layout, tracks),
        scalars=scalars,
        relative_poses=_relative_poses(component.links, window, tracks),
        priors=tuple(_dense(prior, window) for prior in component.priors),
        radio=(radio.rssi_at_1m_dbm, radio.path_loss_exponent),
    )
    return Window(problem, layout, world, base, stamps)


_EMPTY = Problem(
    np.zeros(0, np.int64), np.zeros(0, bool), np.zeros((0, 3)),
    (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))),
)  # fmt: skip


def extended(unit: Component, tracks: Mapping[TrackKey, Track], limit: float) -> Component:
    """A component carried on to ``limit`` [s] by odometry, without the tracks that are not among ``tracks``."""
    stretches = {}
    for key, stretch in unit.stretches.items():
        if key == WORLD_KEY:
            stretches[key] = stretch
        elif key in tracks:
            core = tracks[key].core
            last, newest = stretch.first + len(stretch.poses) - 1, core.newest(limit)
            if newest > last:
                delta, _ = _core.odometry([core], [last], [newest])
                grown = _core.chain(stretch.poses[-1], delta)
                stretch = Stretch(stretch.first, np.concatenate([stretch.poses, grown[1:]]))
            stretches[key] = stretch
    return Component(stretches, unit.priors)


def alone(track: Track, low: float, limit: float) -> Component:
    """A track by itself from ``low`` to ``limit`` [s], beginning at the origin."""
    core = track.core
    first, last = core.first, core.newest(limit)
    if low > -np.inf:
        first = min(max(first, int(np.floor(low * KEYFRAMES_PER_SECOND))), last)
    delta, _ = _core.odometry([core], [first], [last])
    return Component({track.key: Stretch(first, _core.chain(np.zeros(3), delta))})


def links(history: History, tracks: Mapping[TrackKey, Track], low: float, limit: float) -> list[Link]:
    """Measured relative poses with low ≤ stamp ≤ limit [s] between tracks whose odometry is known there."""
    found = []
    for pose in history.poses:
        placed = history.placed(pose)
        if placed is None:
            continue
        link = Link(pose, *placed)
        for key, stamp in ((link.reference, link.stamp_reference), (link.robot, link.stamp_robot)):
            if key != WORLD_KEY and (key not in tracks or not low <= stamp <= tracks[key].core.known(limit)):
                break
        else:
            found.append(link)
    return found


def stands(unit: Component, key: TrackKey, stamp: float) -> bool:
    """Whether a component's poses of a track go back to ``stamp`` [s]."""
    return key == WORLD_KEY or unit.stretches[key].first <= int(np.floor(stamp * KEYFRAMES_PER_SECOND))


def _joined(a: Component, b: Component, link: Link, tracks: Mapping[TrackKey, Track]) -> Component:
    """One component of both; the one with the world, or the first by name, keeps its frame."""
    if a is b:
        return Component(a.stretches, a.priors, (*a.links, link))
    T_a_reference = _pose_at(a, link.reference, link.stamp_reference, tracks)
    T_b_robot = _pose_at(b, link.robot, link.stamp_robot, tracks)
    measured = np.array([link.pose.x, link.pose.y, link.pose.theta])
    T_a_b = se2.compose(se2.compose(T_a_reference, measured), se2.inverse(T_b_robot))
    both = merged(a, b, T_a_b)
    return Component(both.stretches, both.priors, (*both.links, link))


def merged(a: Component, b: Component, T_a_b: Array) -> Component:
    """One component of both; the one with the world, or the first by name, keeps its frame."""
    keep, move, T_keep_move = a, b, T_a_b
    if not a.has_world and (b.has_world or b.tracks[0] < a.tracks[0]):
        keep, move, T_keep_move = b, a, se2.inverse(T_a_b)
    moved = {key: Stretch(s.first, se2.compose(T_keep_move, s.poses)) for key, s in move.stretches.items()}
    return Component({**keep.stretches, **moved}, (*keep.priors, *move.priors), (*keep.links, *move.links))


def _pose_at(unit: Component, key: TrackKey, stamp: float, tracks: Mapping[TrackKey, Track]) -> Array:
    stretch = unit.stretches[key]
    if key == WORLD_KEY:
        return np.zeros(3)
    keyframe, offset = _located(tracks[key], stamp)
    return se2.compose(stretch.poses[keyframe - stretch.first], offset)


def _located(track: Track, stamp: float) -> tuple[int, Array]:
    """Keyframe before ``stamp`` and the pose (3,) at it in the keyframe's frame."""
    keyframe, offset = track.core.locate(stamp)
    return keyframe, offset


def _pinned(layout: Mapping[TrackKey, tuple[int, int, int]], pin: int | None) -> int:
    for offset, first, count in layout.values():
        if pin is not None and first <= pin < first + count:
            return offset + pin - first
    return 0


def _odometry(
    layout: Mapping[TrackKey, tuple[int, int, int]], tracks: Mapping[TrackKey, Track]
) -> tuple[Indices, Indices, Array, Array]:
    first = [first for _, first, _ in layout.values()]
    last = [first + count - 1 for _, first, count in layout.values()]
    delta, information = _core.odometry([tracks[key].core for key in layout], first, last)
    i = np.concatenate([np.arange(offset, offset + count - 1) for offset, _, count in layout.values()])
    return i, i + 1, delta, information


def _relative_poses(links: tuple[Link, ...], window: Window, tracks: Mapping[TrackKey, Track]) -> RelativePoses | None:
    if not links:
        return None
    links = tuple(sorted(links, key=lambda link: (link.stamp_robot, link.reference, link.robot, link.pose.x)))
    ends: dict[str, list[tuple[int, Array]]] = {"reference": [], "robot": []}
    for link in links:
        for end, key, stamp in (
            ("reference", link.reference, link.stamp_reference),
            ("robot", link.robot, link.stamp_robot),
        ):
            if key == WORLD_KEY:
                ends[end].append((window.index(key, 0), np.zeros(3)))
            else:
                keyframe, offset = _located(tracks[key], stamp)
                ends[end].append((window.index(key, keyframe), offset))
    upper = np.array([link.pose.covariance for link in links])
    covariance = np.zeros((len(links), 3, 3))
    rows, columns = np.triu_indices(3)
    covariance[:, rows, columns] = covariance[:, columns, rows] = upper
    information = np.linalg.inv(covariance)
    return RelativePoses(
        i=np.array([index for index, _ in ends["reference"]], dtype=np.int64),
        j=np.array([index for index, _ in ends["robot"]], dtype=np.int64),
        at_i=np.array([offset for _, offset in ends["reference"]]),
        at_j=np.array([offset for _, offset in ends["robot"]]),
        delta=np.array([(link.pose.x, link.pose.y, link.pose.theta) for link in links]),
        information=(information + information.transpose(0, 2, 1)) / 2,
    )


def _dense(prior: Prior, window: Window) -> DensePrior:
    return DensePrior(
        reference=window.index(prior.reference, prior.keyframe),
        members=np.array([window.index(key, prior.keyframe) for key in prior.members], dtype=np.int64),
        relative=prior.relative,
        information=prior.information,
        gradient=prior.gradient,
    )


def _scalars(
    history: History, window: Window, tracks: Mapping[TrackKey, Track], low: float, limit: float
) -> tuple[tuple[Scalars, ...], tuple[Array, ...]]:
    """Readings in the window between members of the component, where the odometry of both is known."""
    size = len(history.numbers) + 1  # the last entry answers for rows without a track
    offset, first, until = np.full(size, -1), np.zeros(size, np.int64), np.full(size, -np.inf)
    antenna = np.zeros((size, 3))
    for key, (start, keyframe, _) in window.layout.items():
        number = tracks[key].core.number
        offset[number], first[number], until[number] = start, keyframe, tracks[key].core.known(limit)
        antenna[number] = history.antenna(key.robot)
    found, stamps = [], []
    configuration = history.configuration
    losses: dict[str, Radio | Ranging | Bearings] = {
        "rssi": configuration.radio,
        "range": configuration.ranging,
        "bearing": configuration.bearings,
    }
    for kind, table in history.tables.items():
        if not len(table):
            continue
        rows = table.between(low, limit)
        a, b = rows.track_a, rows.track_b
        i, j = offset[a] + rows.keyframe_a - first[a], offset[b] + rows.keyframe_b - first[b]
        use = rows.stamp <= np.minimum(until[a], until[b])
        use &= (rows.keyframe_a >= first[a]) & (rows.keyframe_b >= first[b])
        if not use.any():
            continue
        if not use.all():
            rows, a, b, i, j = Rows(*(column[use] for column in rows)), a[use], b[use], i[use], j[use]
        at_a, at_b, height = rows.offset_a, rows.offset_b, np.zeros(len(a))
        if kind != "bearing" and antenna.any():
            at_a = np.concatenate([se2.transform(at_a, antenna[a, :2]), at_a[:, 2:]], axis=1)
            at_b = np.concatenate([se2.transform(at_b, antenna[b, :2]), at_b[:, 2:]], axis=1)
            height = antenna[a, 2] - antenna[b, 2]
        sensor = losses[kind]
        loss = Loss(sensor.kernel, sensor.width)
        found.append(Scalars(kind, i, j, at_a, at_b, height, rows.value, rows.sigma, loss))
        stamps.append(rows.stamp)
    return tuple(found), tuple(stamps)
