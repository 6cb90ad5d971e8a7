"""How messages leave a robot and come in: one small protocol; in memory, over Zenoh, or with faults round it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

Channel = Literal["digest", "bundles", "requests", "estimate"]
BULLETINS: Channel = "estimate"
GOSSIPED: tuple[Channel, ...] = ("digest", "bundles", "requests")
"""what robots hear"""
WATCHED: tuple[Channel, ...] = ("digest", BULLETINS)
"""what monitors hear"""
CHANNELS: tuple[Channel, ...] = (*GOSSIPED, BULLETINS)


class Received(NamedTuple):
    """A message as it came in. ``sender`` is who the network says it is; ``at``: the receiver's local clock [s]."""

    channel: str
    sender: str
    payload: bytes
    at: float


@dataclass(frozen=True, slots=True)
class Traffic:
    """Payload carried so far; ``dropped`` messages found a queue full or could not be sent.

    refused: came faster than anybody is listened to, and were not looked at.
    """

    sent_messages: int = 0
    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    dropped: int = 0
    refused: int = 0


class Transport(Protocol):
    """Best effort broadcast: messages may get lost, late, twice, in another order."""

    def send(self, channel: str, payload: bytes) -> None:
        """To all who hear; never blocks, never raises; what cannot be sent is dropped and counted."""

    def poll(self) -> list[Received]:
        """What came since the last poll, from a bounded queue."""

    def present(self) -> frozenset[str]:
        """The other robots on the network now (liveliness)."""

    @property
    def traffic(self) -> Traffic:
        """What was carried so far."""

    def close(self) -> None:
        """Leave the network; what is sent afterwards is dropped."""
