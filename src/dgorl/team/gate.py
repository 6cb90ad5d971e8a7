"""What is let in from the network: messages of the team, signed by who sends them, new, and not too many."""

from __future__ import annotations

from dgorl.team.admission import Admission
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.keys import Roster
from dgorl.team.messages import Message, read
from dgorl.team.neighbours import Stamps
from dgorl.team.rates import Bucket
from dgorl.team.wire import Limits

MESSAGES_PER_SECOND, BYTES_PER_SECOND = 40.0, 128_000.0
"""More than this of one sender is not looked at; in a burst, twice as much."""


class Gate:
    """Checks one robot's messages, the cheap checks before the dear ones."""

    def __init__(self, robot: str, roster: Roster, configuration: bytes, limits: Limits) -> None:
        self.robot = robot
        self._roster, self._configuration, self._limits = roster, configuration, limits
        self._stamps = {name: Stamps() for name in roster.robots}
        self._rates = {
            name: (Bucket(MESSAGES_PER_SECOND, 2 * MESSAGES_PER_SECOND), Bucket(BYTES_PER_SECOND, 2 * BYTES_PER_SECOND))
            for name in roster.robots
        }

    def open(self, channel: str, sender: str, payload: bytes, admission: Admission, now: float) -> Message:
        """The message in a payload. Raises Rejected."""
        if sender == self.robot:
            raise Rejected(Reason.OWN)
        if sender not in self._rates:
            raise Rejected(Reason.UNKNOWN)
        messages, amount = self._rates[sender]
        if not messages.take(1.0, now) or not amount.take(len(payload), now):
            raise Rejected(Reason.RATE)
        unverified = read(channel, payload, sender, self._roster, self._configuration, self._limits.message)
        message = unverified.message
        if admission.admitted(message.key) and admission.current(sender) != message.epoch:
            raise Rejected(Reason.EPOCH, "an earlier one")
        self._stamps[sender].check(message.epoch, message.stamp)
        unverified.verify(self._roster)
        self._stamps[sender].mark(message.epoch, message.stamp)
        return message
