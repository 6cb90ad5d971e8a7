"""What came in from others and was not taken: counted by reason, and who said it, for the log."""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

from dgorl.team.envelope import Reason, Rejected

HELD = 100
"""So many wait for whoever logs them; the oldest make way."""


class Rejection(NamedTuple):
    """Something that ``sender``, as the network names it, said."""

    sender: str
    reason: Reason
    what: str


class Rejections(Counter[str]):
    """Counts by reason; ``untold`` is taken out by who logs them."""

    def __init__(self) -> None:
        super().__init__()
        self.untold: deque[Rejection] = deque(maxlen=HELD)

    def take(self, sender: str, rejected: Rejected) -> None:
        """Count one."""
        self[rejected.counted] += 1
        self.untold.append(Rejection(sender, rejected.reason, str(rejected)))
