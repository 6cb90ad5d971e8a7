"""A network in memory: everyone hears everyone, at once. Loss, delay and topology are for `faults`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from dgorl.team.transport import Received, Traffic

QUEUE = 100_000
"""Messages a transport holds until it is polled."""


class Air:
    """What all transports share. ``now`` is time as it passes [s], set by whoever owns it."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now
        self._transports: list[MemoryTransport] = []

    def transport(self, robot: str, clock: Callable[[float], float] = float) -> MemoryTransport:
        """A robot's; ``clock``: time → its local clock [s]."""
        transport = MemoryTransport(self, robot, clock)
        self._transports.append(transport)
        return transport

    def carry(self, sender: MemoryTransport, channel: str, payload: bytes) -> None:
        """To all others."""
        for transport in self._transports:
            if transport is not sender:
                transport.hear(channel, sender.robot, payload)

    def others(self, transport: MemoryTransport) -> frozenset[str]:
        """Who else is there."""
        return frozenset(other.robot for other in self._transports if other is not transport)

    def leave(self, transport: MemoryTransport) -> None:
        """It is not there any more."""
        if transport in self._transports:
            self._transports.remove(transport)

    def has(self, transport: MemoryTransport) -> bool:
        """Whether it is there."""
        return transport in self._transports


class MemoryTransport:
    """One robot's end; see `transport.Transport`."""

    def __init__(self, air: Air, robot: str, clock: Callable[[float], float]) -> None:
        self.robot = robot
        self._air, self._clock = air, clock
        self._queue: deque[Received] = deque()
        self._sent, self._sent_bytes, self._received, self._received_bytes, self._dropped = 0, 0, 0, 0, 0

    def local(self, now: float) -> float:
        """A time on this robot's clock [s]."""
        return self._clock(now)

    def send(self, channel: str, payload: bytes) -> None:
        """To all others."""
        if not self._air.has(self):
            self._dropped += 1
            return
        self._sent += 1
        self._sent_bytes += len(payload)
        self._air.carry(self, channel, payload)

    def hear(self, channel: str, sender: str, payload: bytes) -> None:
        """Take a message from the air."""
        if len(self._queue) >= QUEUE:
            self._dropped += 1
            return
        self._received += 1
        self._received_bytes += len(payload)
        self._queue.append(Received(channel, sender, payload, self.local(self._air.now)))

    def poll(self) -> list[Received]:
        """What came."""
        messages = list(self._queue)
        self._queue.clear()
        return messages

    def present(self) -> frozenset[str]:
        """The others."""
        return self._air.others(self)

    @property
    def traffic(self) -> Traffic:
        """What was carried so far."""
        return Traffic(self._sent, self._sent_bytes, self._received, self._received_bytes, self._dropped)

    def close(self) -> None:
        """Leave."""
        self._air.leave(self)
