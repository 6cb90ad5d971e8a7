"""The envelope all that travels is in: ``[version, signature, body]`` in MessagePack, and why something is rejected.

The signature (Ed25519) covers what the body is for, the version and the body, so that nothing signed for one purpose
serves another. Whatever the version, an envelope begins with an array of at most 15 items, the first a number below
128: a future one is recognised and rejected as such.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TypeVar

import msgspec

from dgorl.errors import DgorlError
from dgorl.team.keys import Roster, Signer

VERSION = 1
OVERHEAD = 80
"""An envelope with its signature adds at most this much [bytes]."""

T = TypeVar("T")


class Reason(StrEnum):
    """Why something that came in was rejected; what is counted under."""

    RATE = "too fast"
    TOO_LARGE = "too large"
    MALFORMED = "malformed"
    VERSION = "other version"
    TEAM = "wrong team"
    CONFIGURATION = "other configuration"
    UNKNOWN = "unknown robot"
    SENDER = "another's name"
    OWN = "own name"
    SIGNATURE = "bad signature"
    REPLAYED = "replayed"
    EPOCH = "epoch not live"
    CONFLICT = "two of one name"
    ENDED = "own epoch has ended"


class Rejected(DgorlError):
    """Bytes that are not taken. ``counted`` is the reason, with the ``robot`` if one has to be named."""

    def __init__(self, reason: Reason, detail: str = "", robot: str = "") -> None:
        self.reason = reason
        self.counted = f"{reason}: {robot}" if robot else str(reason)
        super().__init__(f"{reason}: {detail}" if detail else str(reason))


class _Envelope(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, gc=False):
    version: int
    signature: bytes
    body: bytes


_envelopes = msgspec.msgpack.Decoder(_Envelope)


def wrap(purpose: str, body: bytes, signer: Signer) -> bytes:
    """The body in a signed envelope."""
    return msgspec.msgpack.encode(_Envelope(VERSION, signer.sign(_signed(purpose, body)), body))


def unwrap(data: bytes, largest: int) -> tuple[bytes, bytes]:
    """Signature, not checked yet, and body. Raises Rejected: too large, other version, malformed."""
    if len(data) > largest:
        raise Rejected(Reason.TOO_LARGE, f"{len(data)} bytes, at most {largest}")
    if len(data) > 1 and data[0] & 0xF0 == 0x90 and data[1] < 128 and data[1] != VERSION:
        raise Rejected(Reason.VERSION, f"{data[1]}, here {VERSION}; update the older robot")
    envelope = decoded(_envelopes, data)
    if envelope.version != VERSION:
        raise Rejected(Reason.MALFORMED, "no version")
    return envelope.signature, envelope.body


def verify(purpose: str, robot: str, signature: bytes, body: bytes, roster: Roster) -> None:
    """Raises Rejected unless ``robot`` signed the body for this purpose."""
    if not roster.verify(robot, signature, _signed(purpose, body)):
        raise Rejected(Reason.SIGNATURE, f"not signed by {robot}")


def decoded(decoder: msgspec.msgpack.Decoder[T], data: bytes) -> T:
    """``data`` as the decoder's type. Raises Rejected (malformed), whatever the bytes."""
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError, MemoryError) as error:
        raise Rejected(Reason.MALFORMED, str(error)) from error


def _signed(purpose: str, body: bytes) -> bytes:
    return b"dgorl/%d/%s\0" % (VERSION, purpose.encode()) + body
