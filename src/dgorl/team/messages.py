"""What robots tell one another: digests, requests, bundles. Signed by their sender, each with its send stamp.

The sender's stamps grow strictly, on its own clock; ``number`` counts its messages modulo 128. What a message repeats
from one before it is recognised by the stamp.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta

from dgorl.measurements import LARGEST
from dgorl.team.envelope import Reason, Rejected, decoded, unwrap, verify, wrap
from dgorl.team.keys import Roster, Signer
from dgorl.team.ranges import Ranges
from dgorl.team.rates import Losses
from dgorl.team.transport import Channel
from dgorl.team.wire import BITS_64, NUMBERS, Text, Whole

HASH_BYTES = 8

MOST_INFLATED = 65_536
"""Bundles deflated together are at most this much [bytes] when inflated."""

Number = Annotated[int, Meta(ge=0, lt=Losses.MODULUS)]
Hash = Annotated[bytes, Meta(min_length=HASH_BYTES, max_length=HASH_BYTES)]
Intervals = Annotated[list[Annotated[int, Meta(ge=0, lt=NUMBERS)]], Meta(max_length=512)]
Holding = tuple[Text, Whole, Intervals]
"""robot, epoch, sequence numbers: first, last, first, last..."""
Holdings = Annotated[list[Holding], Meta(max_length=512)]
Key = tuple[str, int]
"""robot, epoch"""


class Head(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """What every message begins with: who sent it and when, on its clock [s]."""

    team: Text
    robot: Text
    epoch: Whole
    stamp: float
    number: Number
    configuration: Hash

    @property
    def key(self) -> Key:
        """Robot and epoch."""
        return self.robot, self.epoch


class Digest(Head, frozen=True):
    """What the sender holds, and whom it hears itself."""

    holds: Holdings
    hears: Annotated[list[Text], Meta(max_length=512)]


class Requests(Head, frozen=True):
    """Bundles the sender lacks, and who is to send them."""

    wants: Annotated[list[tuple[Text, Holdings]], Meta(max_length=512)]

    def wanted(self) -> dict[Key, Ranges]:
        """What it lacks, whoever is asked. Raises Rejected."""
        wanted: dict[Key, Ranges] = {}
        for _, holdings in self.wants:
            for robot, epoch, numbers in holdings:
                of_epoch = wanted.setdefault((robot, epoch), Ranges())
                for low, high in unflat(numbers):
                    of_epoch.add(low, high)
        return wanted


class Bundles(Head, frozen=True):
    """Sealed bundles, the sender's own or others'; several may be deflated together, see :func:`packed`."""

    sealed: list[bytes] | bytes

    def bundles(self) -> list[bytes]:
        """The sealed bundles, inflated. Raises Rejected."""
        if isinstance(self.sealed, list):
            return self.sealed
        inflate = zlib.decompressobj()
        try:
            data = inflate.decompress(self.sealed, MOST_INFLATED)
        except zlib.error as error:
            raise Rejected(Reason.MALFORMED, str(error)) from error
        if not inflate.eof or inflate.unused_data:
            raise Rejected(Reason.MALFORMED, "deflated bundles that do not end, or more than there may be")
        return decoded(_lists, data)


Message = Digest | Requests | Bundles

CHANNEL: dict[type[Head], Channel] = {Digest: "digest", Requests: "requests", Bundles: "bundles"}
_lists = msgspec.msgpack.Decoder(list[bytes])
_decoders = {channel: msgspec.msgpack.Decoder(kind) for kind, channel in CHANNEL.items()}


class Unverified(NamedTuple):
    """A message whose signature is still to be checked."""

    message: Message
    channel: str
    signature: bytes
    body: bytes

    def verify(self, roster: Roster) -> None:
        """Raises Rejected unless its sender signed it for this channel."""
        verify(self.channel, self.message.robot, self.signature, self.body, roster)


def write(message: Message, signer: Signer) -> bytes:
    """The payload of a message."""
    return wrap(CHANNEL[type(message)], msgspec.msgpack.encode(message), signer)


def read(channel: str, payload: bytes, sender: str, roster: Roster, configuration: bytes, largest: int) -> Unverified:
    """A message of this team and configuration by ``sender``. Raises Rejected."""
    if channel not in _decoders:
        raise Rejected(Reason.MALFORMED, f"no channel `{channel}`")
    signature, body = unwrap(payload, largest)
    message = decoded(_decoders[channel], body)
    if message.team != roster.team:
        raise Rejected(Reason.TEAM, f"`{message.team}`, here `{roster.team}`")
    if message.robot != sender:
        raise Rejected(Reason.SENDER, f"{sender} sends as {message.robot}")
    if message.configuration != configuration:
        raise Rejected(Reason.CONFIGURATION, f"{sender} has another team.yaml; copy one file to all robots")
    if not -LARGEST <= message.stamp <= LARGEST or message.epoch >= BITS_64:
        raise Rejected(Reason.MALFORMED, "stamp or epoch that cannot be")
    return Unverified(message, channel, signature, body)  # type: ignore[arg-type]


def packed(sealed: Sequence[bytes]) -> list[bytes] | bytes:
    """Bundles as a message carries them: deflated together where that is shorter."""
    plain = list(sealed)
    encoded = msgspec.msgpack.encode(plain)
    deflated = zlib.compress(encoded) if len(encoded) <= MOST_INFLATED else encoded
    return deflated if len(deflated) < len(encoded) else plain


def flat(ranges: Ranges, newest: int) -> list[int]:
    """The newest intervals as a message lists them."""
    return [end for interval in list(ranges)[-newest:] for end in interval]


def unflat(numbers: list[int]) -> Ranges:
    """The set a message lists. Raises Rejected for half an interval."""
    if len(numbers) % 2:
        raise Rejected(Reason.MALFORMED, "half an interval")
    return Ranges(zip(numbers[::2], numbers[1::2], strict=True))
