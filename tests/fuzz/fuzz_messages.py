"""Coverage-guided fuzzing of all that is decoded from the network (needs `pip install atheris`).

Usage: python tests/fuzz/fuzz_messages.py -max_total_time=60 [CORPUS_FOLDER]

The first byte chooses what the rest is: a payload, or the body of a message or bundle that a member signs, so that the
fuzzer gets behind the signatures. An exception is a crash; so is a bundle that does not come out as it went in.
"""

from __future__ import annotations

import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["dgorl.team"]):
    from dgorl.team.bundles import Bundle
    from dgorl.team.envelope import Rejected, unwrap, wrap
    from dgorl.team.gossip import Gossip
    from dgorl.team.keys import UNSIGNED, Roster
    from dgorl.team.messages import Bundles, Digest, Requests, write
    from dgorl.team.wire import LIMITS, encode, open_sealed, seal

from dgorl.measurements import Bearing, ClockReading, Displacement, Odometry, Range, Rssi
from dgorl.team.bundles import track_epoch

ROSTER = Roster("t", {"r1": None, "r2": None, "r3": None}, insecure=True)
CONFIGURATION = bytes(8)
CHANNELS = ("digest", "requests", "bundles", "bundle")
HEAD = ("t", "r2", 7, 1.0, 0, CONFIGURATION)
COVARIANCE = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)


def a_bundle(number: int) -> Bundle:
    """With a row of every kind."""
    at = track_epoch(7, 0)
    return Bundle(
        "t", "r2", 7, number, 0, 1.5,
        (Odometry("r2", 0.0, 0.25, 0.5, 0.1, at), Displacement("r2", 0.25, 0.5, 0.5, 0.1, 0.2, COVARIANCE, at)),
        (Rssi("r1", "r2", 0.5, -60.5),), (Range("r2", "r3", 0.5, 1.5, 0.1, 5),), (Bearing("r2", "r3", 0.5, 1.5, 0.1),),
        (ClockReading("r2", 7, "r1", 1, 0.5, 0.75),),
    )  # fmt: skip


KNOWN = seal(a_bundle(0), UNSIGNED)


def one(data: bytes) -> None:
    """One input."""
    kind, rest = data[0] if data else 0, data[1:]
    channel = CHANNELS[kind % 4]
    payload = rest if kind & 4 else wrap("bundle" if channel == "bundle" else channel, rest, UNSIGNED)
    if channel == "bundle":
        try:
            bundle = open_sealed(payload, ROSTER).bundle
        except Rejected:
            return
        assert repr(open_sealed(seal(bundle, UNSIGNED).data, ROSTER).bundle) == repr(bundle)
        return
    gossip = Gossip("r1", 1, ROSTER, UNSIGNED, CONFIGURATION)
    gossip.restore([KNOWN], [], 1.0)
    messages = [*gossip.receive(channel, "r2", payload, 1.1).send]
    for step in range(8):
        messages += gossip.tick(1.2 + 0.2 * step)
    assert all(len(payload) <= LIMITS.message for _, payload in messages)
    assert sum(map(len, messages)) < 1000


def seeds() -> list[bytes]:
    """One valid input of each kind."""
    sealed = seal(a_bundle(1), UNSIGNED).data
    digest = write(Digest(*HEAD, [("r2", 7, [0, 3]), ("r3", 5, [2, 9])], ["r1", "r3"]), UNSIGNED)
    requests = write(Requests(*HEAD, [("r1", [("r2", 7, [0, 3])])]), UNSIGNED)
    bundles = write(Bundles(*HEAD, [sealed]), UNSIGNED)
    whole = [digest, requests, bundles, sealed]
    bodies = [unwrap(payload, LIMITS.message)[1] for payload in whole]
    assert bodies[3] == encode(a_bundle(1))
    return [bytes([k]) + body for k, body in enumerate(bodies)] + [bytes([4 + k]) + p for k, p in enumerate(whole)]


if __name__ == "__main__":
    for k, seed in enumerate(seeds()):
        one(seed)
        if Path(sys.argv[-1]).is_dir():
            (Path(sys.argv[-1]) / f"seed{k}").write_bytes(seed)
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
