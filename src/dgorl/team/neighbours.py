"""What a robot knows of another it hears itself: what it holds, whom it hears, how much gets lost on the way."""

from __future__ import annotations

from collections import OrderedDict

from dgorl.team.bundles import Name
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.messages import Digest, Key, unflat
from dgorl.team.ranges import Ranges
from dgorl.team.rates import Losses

LIVE = 6.0
"""Who was not heard for this long [s] is away."""

LAGS = 15.0
"""Who lacked what had settled counts as behind for this long [s]."""

LATEST = 5.0
"""What a sender stamped this much [s] before its newest message is too late."""

EPOCHS = 8
"""Messages of so many epochs of a robot are told apart; of older ones the first may be repeated once."""

INTERVALS = 4096
"""What a neighbour holds is remembered in at most so many intervals."""


class Neighbour:
    """One robot, in the epoch it lives in now."""

    def __init__(self, key: Key) -> None:
        self.key = key
        self.heard = -float("inf")
        """when it was last heard [s]"""
        self.hears: frozenset[str] = frozenset()
        self.holds: dict[Key, Ranges] = {}
        self.losses = Losses()
        self._lagged = -float("inf")

    def live(self, now: float) -> bool:
        """Whether it was heard lately."""
        return now - self.heard < LIVE

    def hear(self, number: int, now: float) -> bool:
        """A message came; True if it was away before."""
        back = not self.live(now)
        if back:
            self.losses = Losses()
        self.losses.count(number)
        self.heard = max(self.heard, now)
        return back

    def lags(self, now: float) -> None:
        """It just told that it lacks what others have long had."""
        self._lagged = now

    def behind(self, now: float) -> bool:
        """Whether it lacked such things lately."""
        return now - self._lagged < LAGS

    def digest(self, digest: Digest) -> None:
        """Take what it says it holds. Raises Rejected if that is nothing a robot can hold."""
        if sum(len(numbers) for _, _, numbers in digest.holds) > 2 * INTERVALS:
            raise Rejected(Reason.MALFORMED, "a digest of too many intervals")
        self.holds = {(robot, epoch): unflat(numbers) for robot, epoch, numbers in digest.holds}
        self.hears = frozenset(digest.hears)

    def has(self, name: Name) -> bool:
        """Whether it holds a bundle, as far as is known."""
        held = self.holds.get((name.robot, name.epoch))
        return held is not None and name.sequence in held

    def showed(self, name: Name) -> None:
        """It sent this bundle, so it holds it; of its own all from the first it told of."""
        key = name.robot, name.epoch
        held = self.holds.setdefault(key, Ranges())
        held.add(name.sequence)
        if key == self.key:
            held.add(held.low, name.sequence)
        if len(held) > INTERVALS:
            self.holds[key] = Ranges(list(held)[-INTERVALS // 2 :])


class Stamps:
    """The stamps of one robot's messages, to know those that are repeated."""

    def __init__(self) -> None:
        self._epochs: OrderedDict[int, tuple[float, set[float]]] = OrderedDict()
        self._before: dict[int, float] = {}

    def check(self, epoch: int, stamp: float) -> None:
        """Raises Rejected for a stamp that came before, or is too late to tell."""
        newest, seen = self._epochs.get(epoch, (stamp, ()))
        if stamp in seen or stamp < newest - LATEST or stamp <= self._before.get(epoch, stamp - 1.0):
            raise Rejected(Reason.REPLAYED, f"stamp {stamp}, the newest is {newest}")

    def restore(self, epoch: int, stamp: float) -> None:
        """All up to this stamp came before this program began."""
        self._before[epoch] = max(stamp, self._before.get(epoch, stamp))

    def mark(self, epoch: int, stamp: float) -> None:
        """A message with this stamp was taken."""
        newest, seen = self._epochs.get(epoch, (stamp, set[float]()))
        seen.add(stamp)
        if stamp > newest:
            newest = stamp
        if len(seen) > 64 and min(seen) < newest - 2 * LATEST:
            seen = {s for s in seen if s >= newest - LATEST}
        self._epochs[epoch] = newest, seen
        self._epochs.move_to_end(epoch)
        if len(self._epochs) > EPOCHS:
            self._epochs.popitem(last=False)
