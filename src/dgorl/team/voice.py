"""What a robot says: every message with its head, signed; proofs to those whose messages do not count."""

from __future__ import annotations

from typing import NamedTuple

from dgorl.team.keys import Roster, Signer
from dgorl.team.messages import CHANNEL, Bundles, Key, Message, write
from dgorl.team.rates import Losses
from dgorl.team.transport import Channel
from dgorl.team.wire import short

PROOF_EVERY = 0.5
"""A robot is shown at most this often [s] that its epoch has ended."""


class Outgoing(NamedTuple):
    """A message to all who hear."""

    channel: Channel
    payload: bytes


class Voice:
    """Of one robot in one epoch. Its stamps grow strictly; its messages are numbered."""

    def __init__(self, key: Key, roster: Roster, signer: Signer, configuration: bytes) -> None:
        self._key, self._roster, self._signer, self._configuration = key, roster, signer, configuration
        self._number, self._stamp = 0, -float("inf")
        self._proved: dict[str, float] = {}

    def head(self, now: float) -> tuple[str, str, int, float, int, bytes]:
        """A new head; of two messages made at once the second is stamped 1 µs later."""
        self._stamp = max(now, self._stamp + 1e-6)
        self._number = (self._number + 1) % Losses.MODULUS
        return self._roster.team, *self._key, short(self._stamp), self._number, self._configuration

    def say(self, message: Message) -> Outgoing:
        """The message, signed."""
        return Outgoing(CHANNEL[type(message)], write(message, self._signer))

    def prove(self, robot: str, proof: list[bytes], now: float) -> tuple[Outgoing, ...]:
        """Show a robot what it signed itself, unless it was just shown."""
        if not proof or now < self._proved.get(robot, -float("inf")) + PROOF_EVERY:
            return ()
        self._proved[robot] = now
        return (self.say(Bundles(*self.head(now), proof)),)
