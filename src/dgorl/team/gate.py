"""What is let in from the network: messages of the team, signed by who sends them, new, and not too many."""

from __future__ import annotations

from collections.abc import Sequence

from dgorl.team.bundles import Sealed
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.keys import Roster
from dgorl.team.messages import Message, read
from dgorl.team.neighbours import Stamps
from dgorl.team.rates import Bucket
from dgorl.team.wire import Limits

MESSAGES_PER_SECOND, BYTES_PER_SECOND = 40.0, 128_000.0
"""More than this of one sender is not looked at; in a burst, twice as much."""

UNTOLD = 2.0
"""What was heard is told once a second and journalled with the next bundle: so much [s] of it a journal may lack."""


class Gate:
    """Checks one robot's messages, the cheap checks before the dear ones."""

    def __init__(self, robot: str, roster: Roster, configuration: bytes, limits: Limits) -> None:
        self.robot = robot
        self._roster, self._configuration, self._limits = roster, configuration, limits
        self._stamps = {name: Stamps() for name in roster.robots}
        self._fresh = True
        self._rates = {
            name: (Bucket(MESSAGES_PER_SECOND, 2 * MESSAGES_PER_SECOND), Bucket(BYTES_PER_SECOND, 2 * BYTES_PER_SECOND))
            for name in roster.robots
        }

    def open(self, channel: str, sender: str, payload: bytes, now: float) -> Message:
        """The message in a payload. Raises Rejected."""
        if sender == self.robot:
            raise Rejected(Reason.OWN)
        if sender not in self._rates:
            raise Rejected(Reason.UNKNOWN)
        self._fresh = False
        messages, amount = self._rates[sender]
        if not messages.take(1.0, now) or not amount.take(len(payload), now):
            raise Rejected(Reason.RATE)
        unverified = read(channel, payload, sender, self._roster, self._configuration, self._limits.message)
        message = unverified.message
        self._stamps[sender].check(message.epoch, message.stamp)
        unverified.verify(self._roster)
        self._stamps[sender].mark(message.epoch, message.stamp)
        return message

    def restore(self, bundles: Sequence[Sealed]) -> None:
        """Nothing said before counts again: up to the cuts of bundles, and the stamps that own ones tell of.

        Not where the program only goes on in another epoch, and knows all stamps.
        """
        if not self._fresh:
            return
        for bundle in (sealed.bundle for sealed in bundles):
            newest = {(bundle.robot, bundle.epoch): bundle.cut}
            if bundle.robot == self.robot:
                newest |= {(told.peer, told.peer_epoch): told.sent for told in bundle.clocks}
            for (robot, epoch), stamp in newest.items():
                if robot in self._stamps:
                    self._stamps[robot].restore(epoch, stamp + UNTOLD)
