"""JSON lines of a robot's own measurements: every format, what is wrong with one, nothing else raised."""

from __future__ import annotations

import json
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl import Bearing, Displacement, Odometry, Range, Rssi
from dgorl.errors import MeasurementError
from dgorl.measurements import WORLD, RelativePose
from dgorl.team.intake import LONGEST_LINE, Moved, line_of, read_line

TEAM = ("r1", "r2", "läufer")
COVARIANCE = (0.01, 0.0, 0.0, 0.01, 0.0, 0.001)


def read(line: object, now: float = 1.0, history: float = 180.0):
    data = line if isinstance(line, bytes) else json.dumps(line).encode()
    return read_line(data, "r1", TEAM, now, history)


@pytest.mark.parametrize(
    ("line", "measured"),
    [
        ({"type": "odometry", "start": 0, "end": 0.5, "v": 0.5, "omega": -0.1}, Odometry("r1", 0.0, 0.5, 0.5, -0.1)),
        (
            {"type": "displacement", "start": 0, "end": 0.5, "dx": 0.2, "dy": 0, "dtheta": 0.1},
            Displacement("r1", 0.0, 0.5, 0.2, 0.0, 0.1),
        ),
        (
            {"type": "displacement", "start": 0, "end": 1, "dx": 0, "dy": 0, "dtheta": 0, "covariance": COVARIANCE},
            Displacement("r1", 0.0, 1.0, 0.0, 0.0, 0.0, COVARIANCE),
        ),
        ({"type": "rssi", "stamp": 0.5, "transmitter": "r2", "dbm": -61}, Rssi("r2", "r1", 0.5, -61.0)),
        ({"type": "range", "stamp": 0.5, "peer": "r2", "range": 4.2, "sigma": 0.1}, Range("r1", "r2", 0.5, 4.2, 0.1)),
        (
            {"type": "range", "stamp": 0.5, "peer": "läufer", "range": 4.2, "exchange": 7},
            Range("r1", "läufer", 0.5, 4.2, None, 7),
        ),
        ({"type": "range", "stamp": 0.5, "peer": "r2", "range": 4.2, "sigma": None}, Range("r1", "r2", 0.5, 4.2)),
        (
            {"type": "bearing", "stamp": 0.5, "peer": "r2", "bearing": 1.5, "sigma": 0.1},
            Bearing("r1", "r2", 0.5, 1.5, 0.1),
        ),
        ({"type": "moved", "stamp": 0.5}, Moved(0.5)),
    ],
)
def test_every_format(line: dict[str, object], measured: object) -> None:
    assert read(line) == measured
    assert read(line_of(measured)) == measured


@pytest.mark.parametrize(
    ("line", "what"),
    [
        (b"", "truncated"),
        (b"what?", "malformed"),
        (b"\xff\xfe", "malformed|utf"),
        (b"[1, 2]", "object"),
        (b'{"type": "odometry", "start": NaN, "end": 1, "v": 0, "omega": 0}', "malformed"),
        ({"stamp": 0.5}, "type"),
        ({"type": "odometri"}, "odometri"),
        ({"type": "rssi", "transmitter": "r2", "dbm": -60}, "stamp"),
        ({"type": "rssi", "stamp": None, "transmitter": "r2", "dbm": -60}, "stamp"),
        ({"type": "rssi", "stamp": "now", "transmitter": "r2", "dbm": -60}, "stamp"),
        (
            {"type": "rssi", "stamp": 0.5, "transmitter": "laufer", "dbm": -60},
            "file; did you mean `läufer`",
        ),
        ({"type": "rssi", "stamp": 0.5, "transmitter": "r1", "dbm": -60}, "cannot measure itself"),
        ({"type": "rssi", "stamp": 0.5, "transmitter": "r2", "dbm": -60, "rate": 3}, "rate"),
        ({"type": "range", "stamp": 0.5, "peer": "r2", "range": -4.2}, "negative"),
        ({"type": "odometry", "start": 1, "end": 0.5, "v": 0, "omega": 0}, "must end after it starts"),
        ({"type": "odometry", "start": 1e300, "end": 1e301, "v": 0, "omega": 0}, "within"),
        ({"type": "moved", "stamp": 1e300}, "time in seconds"),
        ({"type": "moved", "stamp": 11.5}, r"10\.5 s ahead of this robot's clock"),
        ({"type": "moved", "stamp": -179.5}, r"180\.5 s behind this robot's clock"),
        (b'{"type": "moved", "stamp": 0.5' + b" " * LONGEST_LINE + b"}", "a line of"),
    ],
)
def test_what_is_wrong_is_said(line: object, what: str) -> None:
    with pytest.raises(MeasurementError, match=what):
        read(line)


def test_what_no_line_can_say() -> None:
    with pytest.raises(MeasurementError):
        line_of(RelativePose(WORLD, "r1", 0.0, 0.0, 0.0, 0.0, COVARIANCE, prior=True))


@settings(max_examples=50, deadline=None)
@given(
    st.binary(max_size=200)
    | st.text().map(str.encode)
    | st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(("type", "stamp", "peer")), inner),
        max_leaves=8,
    ).map(lambda value: json.dumps(value).encode())
)
def test_nothing_but_complaints(line: bytes) -> None:
    with suppress(MeasurementError):
        read(line)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(-1e9, 1e9), st.floats(1e-3, 50.0))
def test_numbers_arrive_bit_for_bit(stamp: float, bearing: float, length: float) -> None:
    assert read(line_of(Bearing("r1", "r2", stamp, bearing))) == Bearing("r1", "r2", stamp, bearing)
    step = Odometry("r1", stamp - length, stamp, bearing, length)
    assert read(line_of(step)) == step
