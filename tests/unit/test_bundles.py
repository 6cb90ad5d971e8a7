"""Bundles and the bundler: lossless, limited, cut as the clock says."""

from __future__ import annotations

import struct
from dataclasses import replace
from math import pi

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import se2
from dgorl.configuration import Configuration
from dgorl.errors import MeasurementError
from dgorl.history import History
from dgorl.measurements import (
    LARGEST,
    WORLD,
    Bearing,
    ClockReading,
    Displacement,
    Measurement,
    Odometry,
    Range,
    RelativePose,
    Rssi,
    known_at,
)
from dgorl.team.bundler import CLOCKS_EVERY, Bundler, merged
from dgorl.team.bundles import Bundle, track_epoch
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.keys import UNSIGNED, Roster, generate
from dgorl.team.wire import LIMITS, NUMBERS, Limits, encode, open_sealed, seal, size

KEYS = {name: generate() for name in ("r1", "r2", "r3")}
ROSTER = Roster("t", {name: key.public for name, key in KEYS.items()})
COVARIANCE = (0.01, 0.001, -0.002, 0.02, 0.0, 0.03)

number = st.floats(-LARGEST, LARGEST, allow_nan=False) | st.integers(-(10**9), 10**9).map(float) | st.just(-0.0)
stamp = st.floats(0, 1000) | st.floats(1.7e9, 1.7e9 + 1)
whole = st.integers(0, 2**64 - 1)


@st.composite
def bundles(draw: st.DrawFn) -> Bundle:
    epoch, track, cut = draw(whole), draw(st.integers(0, 5)), 2e9
    at = track_epoch(epoch, track)
    twist = st.builds(
        lambda start, length, v, omega: Odometry("r1", start, start + length, v, omega, at),
        stamp, st.floats(0.001, 1), number, number,
    )  # fmt: skip
    displacement = st.builds(
        lambda start, length, a, b, c, s: Displacement("r1", start, start + length, a, b, c, s, at),
        stamp, st.floats(0.001, 1), number, number, number, st.sampled_from([None, COVARIANCE]),
    )  # fmt: skip
    peer = st.sampled_from(["r2", "r3"])
    sigma = st.none() | st.floats(1e-6, 10)
    exchange = st.none() | st.integers(-(2**63), 2**63 - 1)
    length = number.map(abs)
    return Bundle(
        "t", "r1", epoch, draw(st.integers(0, NUMBERS - 1)), track, cut,
        (*draw(st.lists(twist, max_size=5)), *draw(st.lists(displacement, max_size=3))),
        tuple(draw(st.lists(st.builds(Rssi, peer, st.just("r1"), stamp, number), max_size=5))),
        tuple(draw(st.lists(st.builds(Range, st.just("r1"), peer, stamp, length, sigma, exchange), max_size=5))),
        tuple(draw(st.lists(st.builds(Bearing, st.just("r1"), peer, stamp, number, sigma), max_size=5))),
        tuple(draw(st.lists(
            st.builds(ClockReading, st.just("r1"), st.just(epoch), peer, whole, number, number), max_size=5
        ))),
    )  # fmt: skip


def bits(value: object) -> object:
    """A value in which −0.0 and 0.0 differ."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    fields = getattr(value, "__dataclass_fields__", None)
    return value if fields is None else (type(value), *(bits(getattr(value, name)) for name in fields))


@settings(max_examples=50, deadline=None)
@given(bundles())
def test_a_bundle_comes_out_bit_for_bit(bundle: Bundle) -> None:
    sealed = seal(bundle, KEYS["r1"])
    opened = open_sealed(sealed.data, ROSTER)
    assert opened == sealed
    assert bits(opened.bundle) == bits(bundle)
    assert len(sealed.data) <= size(bundle)


def a_bundle(**changes: object) -> Bundle:
    at = track_epoch(9, 0)
    steps = tuple(Odometry("r1", 0.1 * k, 0.1 * (k + 1), 0.3 + k / 7, 0.1, at) for k in range(5))
    return replace(Bundle("t", "r1", 9, 3, 0, 0.5, steps, rssi=(Rssi("r2", "r1", 0.5, -60.0),)), **changes)


def rejected(data: bytes, roster: Roster = ROSTER, limits: Limits = LIMITS) -> Reason:
    with pytest.raises(Rejected) as caught:
        open_sealed(data, roster, limits)
    return caught.value.reason


def test_every_changed_byte_is_noticed() -> None:
    data = seal(a_bundle(), KEYS["r1"]).data
    for k in range(len(data)):
        for change in (0x01, 0x80, 0xFF):
            assert rejected(data[:k] + bytes([data[k] ^ change]) + data[k + 1 :])
        assert rejected(data[:k])
    assert rejected(data + b"\0") == Reason.MALFORMED


def test_reasons() -> None:
    data = seal(a_bundle(), KEYS["r1"]).data
    assert rejected(data, limits=Limits(bundle=len(data) - 1)) == Reason.TOO_LARGE
    assert rejected(data, Roster("u", {n: k.public for n, k in KEYS.items()})) == Reason.TEAM
    assert rejected(data, Roster("t", {"r2": KEYS["r2"].public})) == Reason.UNKNOWN
    assert rejected(seal(a_bundle(), KEYS["r2"]).data) == Reason.SIGNATURE
    assert rejected(seal(a_bundle(), UNSIGNED).data) == Reason.SIGNATURE
    assert rejected(b"\x93\x02" + data[2:]) == Reason.VERSION
    assert rejected(b"\x9f\x7f") == Reason.VERSION
    assert rejected(b"") == Reason.MALFORMED


@pytest.mark.parametrize(
    "changes",
    [
        {"cut": 0.4},
        {"cut": float("nan")},
        {"cut": float("inf")},
        {"rssi": (Rssi("r2", "r1", 0.6, -60.0),)},
    ],
)
def test_what_cannot_be_is_rejected_whole(changes: dict) -> None:
    assert rejected(seal(a_bundle(**changes), KEYS["r1"]).data) == Reason.MALFORMED


def test_measurements_of_strangers_are_rejected() -> None:
    assert rejected(seal(a_bundle(rssi=(Rssi("x", "r1", 0.5, -60.0),)), KEYS["r1"]).data) == Reason.UNKNOWN


def test_rows_that_point_nowhere_are_rejected() -> None:
    """Signed by a member, but not written by this program."""
    for body in (
        ["t", "r1", 9, 3, 0, 0.5, [0.1, 0.2], [], [[0, 7, 1.0, 1.0]]],
        ["t", "r1", 9, 3, 0, 0.5, [0.2, 0.1], [], [[0, 1, 1.0, 1.0]]],
        ["t", "r1", 9, 3, 0, 0.5, [0.1, 0.2], [], [[0, 1, float("nan"), 1.0]]],
        ["t", "r1", 9, 3, 0, 0.5, [0.1], ["r2"], [], [], [], [[0, 0, -1.0]]],
        ["t", "r1", 9, 3, 0, 0.5, [0.1], ["r1"], [], [], [[0, 0, -1.0]]],
        ["t", "r1", 2**64 - 1, 3, -1, 0.5],
        ["t", "r1", 9, 3, 0, 0.5, [], [], [], [], [], [], [], [], "more"],
        ["t", "r1", 9, 3, 0],
    ):
        text = msgspec.msgpack.encode(body)
        signature = KEYS["r1"].sign(b"dgorl/1/bundle\0" + text)
        assert rejected(msgspec.msgpack.encode([1, signature, text])) == Reason.MALFORMED, body


def test_insecure_teams_sign_nothing() -> None:
    roster = Roster("t", {"r1": None, "r2": None}, insecure=True)
    data = seal(a_bundle(), UNSIGNED).data
    assert open_sealed(data, roster).bundle == a_bundle()
    assert rejected(seal(a_bundle(), KEYS["r1"]).data, roster) == Reason.SIGNATURE


def test_bytes_of_a_bundle() -> None:
    """Five twists of 0.1 s, an RSSI and a clock reading of each of four peers: what docs/live-team.md says."""
    peers = [f"r{k}" for k in range(2, 6)]
    start = 1.7e9 + 0.123
    at = track_epoch(2**63 + 5, 0)
    bundle = Bundle(
        "team", "r1", 2**63 + 5, 400, 0, start + 0.5,
        tuple(Odometry("r1", start + k / 10, start + (k + 1) / 10, 0.3 + k / 7, 0.1 + k / 7, at) for k in range(5)),
        tuple(Rssi(peer, "r1", start + 0.5, -60.0 - 1 / 7) for peer in peers),
        clocks=tuple(ClockReading("r1", 2**63 + 5, peer, 2**63 + 1, start, start + 0.001) for peer in peers),
    )  # fmt: skip
    assert len(seal(bundle, KEYS["r1"]).data) <= 480
    assert len(encode(replace(bundle, odometry=(), rssi=(), clocks=()))) <= 40


def test_track_epochs_differ_and_fit() -> None:
    epochs = {track_epoch(e, k) for e in (0, 1, 2**64 - 1) for k in range(100)}
    assert len(epochs) == 300
    assert max(epochs) < 2**53


# The bundler


def bundler(**options: object) -> Bundler:
    return Bundler("t", "r1", 9, **options)  # type: ignore[arg-type]


def step(start: float, end: float, v: float = 0.5, omega: float = 0.2) -> Odometry:
    return Odometry("r1", start, end, v, omega)


def test_what_is_known_is_cut_what_is_not_waits() -> None:
    cutter = bundler()
    for measurement in (step(0.0, 0.5), step(0.5, 1.0), Rssi("r2", "r1", 0.5, -50.0), Rssi("r2", "r1", 0.51, -50.0)):
        cutter.add(measurement)
    (first,) = cutter.cut(0.5)
    (second,) = cutter.cut(1.0)
    assert (first.sequence, first.cut, len(first.odometry), len(first.rssi)) == (0, 0.5, 1, 1)
    assert (second.sequence, second.cut, len(second.odometry), len(second.rssi)) == (1, 1.0, 1, 1)
    assert cutter.cut(1.5) == ()
    assert cutter.sequence == 2, "what is not cut has no number"
    assert first.odometry[0].epoch == track_epoch(9, 0)


def test_a_restarted_bundler_goes_on() -> None:
    cutter = bundler(sequence=17, track=2)
    cutter.add(step(0.0, 0.5))
    (bundle,) = cutter.cut(0.5)
    assert (bundle.sequence, bundle.track, bundle.odometry[0].epoch) == (17, 2, track_epoch(9, 2))


def test_carried_robots_begin_a_track() -> None:
    cutter = bundler()
    for k in range(10):
        cutter.add(step(0.1 * k, 0.1 * (k + 1)))
    cutter.add(Rssi("r2", "r1", 0.2, -50.0))
    cutter.add(Rssi("r2", "r1", 0.9, -50.0))
    cutter.moved(0.55)
    before, after = cutter.cut(1.0)
    assert (before.track, after.track) == (0, 1)
    assert len(before.odometry) == 5
    assert len(after.odometry) == 4
    assert [len(b.rssi) for b in (before, after)] == [1, 1]
    assert cutter.dropped == {"odometry while the robot was carried": 1}
    assert before.odometry[0].epoch != after.odometry[0].epoch
    cutter.add(step(0.4, 0.5))
    cutter.add(step(1.0, 1.1))
    (late,) = cutter.cut(1.5)
    assert (late.track, len(late.odometry)) == (1, 1), "what comes late of the old track is of no track"
    cutter.moved(9.0)
    cutter.add(step(1.5, 2.0))
    assert cutter.cut(2.0)[0].track == 1, "it is not yet"


@pytest.mark.parametrize(
    "measurement",
    [
        Odometry("r2", 0, 1, 0, 0), Rssi("r1", "r2", 0, -50), Range("r2", "r1", 0, 1), Bearing("r2", "r1", 0, 1),
        Range("r1", "r2", 0, 1, None, 2**63), RelativePose(WORLD, "r1", 0, 0, 0, 0, (1, 0, 0, 1, 0, 1), prior=True),
    ],
)  # fmt: skip
def test_what_is_not_its_own_is_refused(measurement: Measurement) -> None:
    with pytest.raises(MeasurementError):
        bundler().add(measurement)


def test_much_at_once_is_split_and_nothing_is_lost() -> None:
    cutter = bundler()
    rows: list[Measurement] = [step(0.001 * k, 0.001 * (k + 1)) for k in range(3000)]
    rows += [Range("r1", "r2", 0.02 * (k + 1), 1.0 + k / 7, 0.1) for k in range(2000)]
    for row in rows:
        cutter.add(row)
    cutter.heard([ClockReading("r1", 9, "r2", 5, 1.0, 1.1)])
    parts = cutter.cut(50.0)
    assert len(parts) > 10
    assert [b.sequence for b in parts] == list(range(len(parts)))
    assert all(len(seal(b, KEYS["r1"]).data) <= LIMITS.bundle for b in parts)
    back = [m for b in parts for m in open_sealed(seal(b, KEYS["r1"]).data, ROSTER).bundle.measurements]
    assert sorted(map(known_at, back)) == sorted(map(known_at, rows))
    assert set(back) == {replace(m, epoch=track_epoch(9, 0)) if isinstance(m, Odometry) else m for m in rows}
    assert sum(len(b.clocks) for b in parts) == 1
    assert not cutter.dropped


def test_of_clock_readings_the_shortest_is_told_and_not_too_often() -> None:
    cutter, told = bundler(), []
    for k in range(1, 41):
        now = 0.5 * k
        cutter.heard(ClockReading("r1", 9, "r2", 5, now - delay, now) for delay in (0.3, 0.1, 0.2))
        told += [c for b in cutter.cut(now) for c in b.clocks]
    assert all(c.received - c.sent == pytest.approx(0.1) for c in told)
    assert len(told) == pytest.approx(20 / CLOCKS_EVERY, abs=1)


# Composed odometry


def composed(rows: list) -> np.ndarray:
    total = np.zeros(3)
    for row in rows:
        twist = isinstance(row, Odometry)
        dt = row.end - row.start
        total = se2.compose(total, se2.exp([row.v * dt, 0, row.omega * dt]) if twist else [row.dx, row.dy, row.dtheta])
    return total


def test_composed_odometry_is_the_same_motion() -> None:
    rows = [step(0.1 * k, 0.1 * (k + 1), 0.2 + 0.1 * k, 0.5 - 0.1 * k) for k in range(10)]
    few = merged(rows, 0.5)
    assert [(m.start, m.end) for m in few] == [(0.0, rows[4].end), (rows[5].start, rows[9].end)]
    assert all(isinstance(m, Displacement) and m.covariance is None for m in few)
    assert np.allclose(composed(few), composed(rows), atol=1e-12)
    assert merged(rows, 0.0) == rows
    assert merged(rows, 0.1 - 1e-9) == rows, "none is shorter"


def test_composed_covariances_are_those_of_samples() -> None:
    noise = (1e-4, 2e-5, 1e-5, 2e-4, -1e-5, 3e-4)
    rows = [Displacement("r1", 0.1 * k, 0.1 * (k + 1), 0.3, 0.1, 0.4, noise) for k in range(5)]
    (one,) = merged(rows, 0.5)
    rng = np.random.default_rng(1)
    xx, xy, xt, yy, yt, tt = noise
    samples = rng.multivariate_normal(np.zeros(3), [[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]], (200_000, 5))
    total = np.zeros((200_000, 3))
    for k in range(5):
        total = se2.compose(total, np.array([0.3, 0.1, 0.4]) + samples[:, k])
    error = total - np.array([one.dx, one.dy, one.dtheta])
    error[:, 2] = se2.wrap(error[:, 2])
    sample = np.cov(error.T)[np.triu_indices(3)]
    assert np.allclose(one.covariance, sample, rtol=0.05, atol=1e-5)


def test_only_like_rows_that_follow_on_are_composed() -> None:
    stated = Displacement("r1", 0.1, 0.2, 0.1, 0, 0, COVARIANCE)
    rows = [step(0.0, 0.1), stated, step(0.2, 0.3), step(0.35, 0.4), replace(step(0.4, 0.45), epoch=1)]
    assert merged(rows, 0.5) == rows


def test_composed_turns_are_whole() -> None:
    (one,) = merged([step(0.0, 0.1, 0.1, 20.0), step(0.1, 0.2, 0.1, 20.0)], 0.5)
    assert isinstance(one, Displacement)
    assert one.dtheta == pytest.approx(4.0)
    assert one.dtheta > pi


def test_tracks_of_composed_odometry_agree_with_the_plain_ones() -> None:
    found = []
    for substep in (0.0, 0.5):
        cutter, history = bundler(substep=substep), History(Configuration())
        for k in range(50):
            cutter.add(step(0.1 * k, 0.1 * (k + 1), 0.5, 0.3))
        for k in range(1, 12):
            for bundle in cutter.cut(0.5 * k + 1e-9):
                for measurement in bundle.measurements:
                    history.add(measurement)
        history.admit(6.0, node_due=True)
        (track,) = history.tracks
        found.append([track.core.locate(stamp) for stamp in np.arange(0.01, 5.0, 0.01)])
        assert len(history.trails["r1"]._rows) == (50 if substep == 0.0 else 10)
    for (frame, pose), (other, same) in zip(*found, strict=True):
        assert frame == other
        assert np.allclose(pose, same, atol=1e-9)
