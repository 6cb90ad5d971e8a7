"""Bulletins: what a robot tells those who watch, and what is not believed."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import msgspec
import pytest

from dgorl.estimate import Status
from dgorl.team.bulletin import LARGEST_BULLETIN, PLACES, WORDS, Bulletins, read_bulletin
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.keys import Roster, generate
from dgorl.team.report import Carried, Clock, Peer, Place, Report

KEY = generate()
ROSTER = Roster("lab", {"r1": KEY.public, "r2": generate().public})
HASH = b"8 bytes."
COVARIANCE = 0.25, -0.06, 0.01, 0.16, 0.002, 0.04


def peer(**changes: object) -> Peer:
    told = {
        "pose": (1.2345, -6.0, 3.1),
        "covariance": COVARIANCE,
        "status": Status.TRACKED,
        "probability": 1.0,
        "age": 0.5,
        "reason": "",
        "resolve_by": "",
    }
    return Peer(**{**told, **changes})


def report(peers: dict[str, Peer], sent: int = 0, **changes: object) -> Report:
    carried = Carried(3, sent, 5, 2 * sent, 0, None, 1)
    told = {
        "robot": "r1",
        "stamp": 10.0,
        "data": "",
        "present": ("r2",),
        "clocks": {"r1": Clock(0.25, 1e-6, 0.001)},
        "rejected": {"too late": 4},
        "tick_s": 0.0042,
    }
    return Report(peers=peers, traffic=carried, **{**told, **changes})


def bulletins(robot: str = "r1", team: str = "lab") -> Bulletins:
    return Bulletins(team, robot, 7, HASH, KEY)


def test_what_is_told_is_what_was_reported_to_a_millimetre() -> None:
    places = tuple(Place(0.9 / 2**k, (k, 0.5, 0.1), COVARIANCE) for k in range(6))
    unsure = peer(status=Status.AMBIGUOUS, age=None, reason="why", resolve_by="what", hypotheses=places)
    peers = {"r2": peer(), "r3": unsure, "r4": peer(pose=None, covariance=None)}
    payload = bulletins().due(report(peers), {"r2": 0.25}, 10.02)
    assert payload is not None
    told = read_bulletin(payload, "r1", ROSTER)
    assert (told.robot, told.epoch, told.stamp, told.configuration) == ("r1", 7, 10.02, HASH)
    assert told.peers["r2"].pose == pytest.approx((1.2345, -6.0, 3.1), abs=5.1e-4)
    assert told.peers["r2"].covariance == pytest.approx(COVARIANCE, abs=1e-3)
    assert (told.peers["r2"].status, told.peers["r2"].age) == (Status.TRACKED, 0.5)
    assert (told.peers["r3"].age, told.peers["r3"].reason, told.peers["r3"].resolve_by) == (None, "why", "what")
    assert [round(p.pose[0]) for p in told.peers["r3"].hypotheses] == list(range(PLACES))
    assert told.peers["r4"].pose is None
    assert told.clocks == {"r1": Clock(0.25, 1e-6, 0.001)}
    assert (told.losses, told.rejected, told.present) == ({"r2": 0.25}, {"too late": 4}, {"r2"})
    assert told.tick == pytest.approx(0.0042)
    assert (told.sent, told.received, told.wire) == (None, None, None)


def test_once_a_second_with_rates() -> None:
    writer = bulletins()
    assert writer.due(report({}, sent=1000), {}, 5.0)
    assert writer.due(report({}, sent=1300), {}, 5.9) is None
    payload = writer.due(report({}, sent=2000), {}, 7.0)
    assert payload is not None
    told = read_bulletin(payload, "r1", ROSTER)
    assert (told.sent, told.received, told.number) == (500, 1000, 2)


def test_odd_numbers_are_told_as_large_ones() -> None:
    wild = peer(pose=(inf, -1e30, 0.0), covariance=(inf, 0.0, 0.0, 1e40, 0.0, -1.0))
    payload = bulletins().due(report({"r2": wild}), {}, 1.0)
    assert payload is not None
    told = read_bulletin(payload, "r1", ROSTER).peers["r2"]
    assert told.pose == (1e6, -1e6, 0.0)
    assert told.covariance is not None
    assert told.covariance[0] == told.covariance[3] == 1e12
    assert told.covariance[5] == 0.0


def test_the_largest_team_fits() -> None:
    words, place = "x" * 500, Place(0.5, (1e9, 1e9, 1e9), (1e20, 1.0, 1.0, 1e20, 1.0, 1e20))
    unsure = peer(status=Status.UNOBSERVABLE, reason=words, resolve_by=words, hypotheses=(place,) * 9)
    peers = {f"{k:064d}": unsure for k in range(64)}
    payload = bulletins().due(report(peers, present=tuple("y" * 99 for _ in range(9999))), {}, 1.0)
    assert payload is not None
    assert len(payload) <= LARGEST_BULLETIN
    told = read_bulletin(payload, "r1", ROSTER)
    assert told.peers[f"{7:064d}"].reason == "x" * WORDS
    assert told.present == frozenset()


@dataclass(frozen=True)
class _Forger:
    public = None
    signature: bytes

    def sign(self, data: bytes) -> bytes:
        return self.signature


@pytest.mark.parametrize(
    ("writer", "sender", "reason"),
    [
        (Bulletins("lab", "r1", 7, HASH, generate()), "r1", Reason.SIGNATURE),
        (Bulletins("lab", "r1", 7, HASH, _Forger(b"")), "r1", Reason.SIGNATURE),
        (Bulletins("lab", "r2", 7, HASH, KEY), "r2", Reason.SIGNATURE),
        (bulletins(), "r2", Reason.SENDER),
        (bulletins(team="other"), "r1", Reason.TEAM),
        (Bulletins("lab", "r1", 2**64 - 1, b"short", KEY), "r1", Reason.MALFORMED),
    ],
    ids=["another's key", "no signature", "another robot's", "as another", "other team", "short hash"],
)
def test_what_is_not_the_senders_is_rejected(writer: Bulletins, sender: str, reason: Reason) -> None:
    payload = writer.due(report({"r2": peer()}), {}, 1.0)
    assert payload is not None
    with pytest.raises(Rejected) as error:
        read_bulletin(payload, sender, ROSTER)
    assert error.value.reason == reason


@pytest.mark.parametrize("odd", [{"peers": {"r2": peer(age=float("nan"))}}, {"clocks": {"r1": Clock(inf, 0.0, 0.0)}}])
def test_numbers_that_cannot_be_are_rejected(odd: dict) -> None:
    payload = bulletins().due(msgspec.structs.replace(report({}), **odd), {}, 1.0)
    assert payload is not None
    with pytest.raises(Rejected, match="malformed"):
        read_bulletin(payload, "r1", ROSTER)
    for damaged in (payload[:-1], b"", payload[:9] + b"\xff" + payload[10:]):
        with pytest.raises(Rejected):
            read_bulletin(damaged, "r1", ROSTER)
