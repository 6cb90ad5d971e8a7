"""A team watched from outside: who is there, and what each robot says of itself. Every signature is checked.

A watcher cannot challenge anybody: what a robot signed earlier and somebody repeats now is recognised only while the
robot itself is heard, and by its clock.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection
from dataclasses import dataclass, field
from math import inf

import msgspec

from dgorl.logs.team import valid_name
from dgorl.team.bulletin import Bulletin, check_head, read_bulletin
from dgorl.team.envelope import Reason, Rejected, decoded, unwrap, verify
from dgorl.team.keys import Roster
from dgorl.team.messages import Digest
from dgorl.team.neighbours import LIVE, Stamps
from dgorl.team.rates import Bucket
from dgorl.team.transport import BULLETINS, Received
from dgorl.team.wire import LIMITS

MESSAGES_PER_SECOND = 40.0
"""More than this of one sender is not looked at; in a burst, twice as much."""
STRANGERS = 64
"""So many names that are not the team's are remembered."""
READINGS = 16
"""A clock is read from the quickest of so many messages."""

_digests = msgspec.msgpack.Decoder(Digest)


@dataclass
class Seen:
    """What was heard of one robot, with its signature.

    heard: when, last, and ``first``, on the watcher's clock [s]. earlier: the first bulletin of the same epoch.
    returns: how often another epoch took over. rejected: messages in its name that were not taken, by reason; details:
    the last one's words.
    """

    robot: str
    first: float = inf
    heard: float = -inf
    epoch: int | None = None
    returns: int = 0
    stamp: float = -inf
    configuration: bytes | None = None
    digest: Digest | None = None
    earlier: Bulletin | None = None
    bulletin: Bulletin | None = None
    before: Bulletin | None = None
    """the bulletin before that one"""
    told: float = -inf
    """when the bulletin came [s]"""
    rejected: Counter[str] = field(default_factory=Counter)
    details: dict[str, str] = field(default_factory=dict)
    _ahead: deque[float] = field(default_factory=lambda: deque(maxlen=READINGS))

    def live(self, now: float) -> bool:
        """Whether it was heard lately."""
        return now - self.heard < LIVE

    @property
    def rejects(self) -> list[str]:
        """What it counted between its last two bulletins of what says that one robot lives twice."""
        known = self.before.rejected if self.before else {}
        now = self.bulletin.rejected if self.bulletin and self.before else {}
        grown = [reason for reason, count in now.items() if count > known.get(reason, 0)]
        return [reason for reason in grown if reason.partition(": ")[0] in (Reason.ENDED, Reason.CONFLICT)]

    @property
    def ahead(self) -> float | None:
        """How far its clock is ahead of the watcher's [s], less the time a message takes."""
        return max(self._ahead, default=None)


class Watch:
    """What one sees of a team. robots: of the roster; strangers: messages by names that are not in it.

    nameless: messages by names that no robot can have.
    """

    def __init__(self, roster: Roster) -> None:
        self._roster = roster
        self.robots = {robot: Seen(robot) for robot in roster.robots}
        self.strangers: Counter[str] = Counter()
        self.nameless = 0
        self._inbound = {robot: Bucket(MESSAGES_PER_SECOND, 2 * MESSAGES_PER_SECOND) for robot in roster.robots}
        self._stamps = {(robot, kind): Stamps() for robot in roster.robots for kind in (Digest, Bulletin)}

    def take(self, messages: Collection[Received]) -> None:
        """Take what came."""
        for message in messages:
            seen = self.robots.get(message.sender)
            if seen is None:
                if not valid_name(message.sender):
                    self.nameless += 1
                elif message.sender in self.strangers or len(self.strangers) < STRANGERS:
                    self.strangers[message.sender] += 1
                continue
            try:
                self._take(seen, message)
            except Rejected as rejected:
                seen.rejected[rejected.reason] += 1
                seen.details[rejected.reason] = str(rejected)

    def heard(self, now: float) -> frozenset[str]:
        """Robots heard lately, whatever they said."""
        return frozenset(robot for robot, seen in self.robots.items() if seen.live(now))

    def _take(self, seen: Seen, message: Received) -> None:
        if not self._inbound[seen.robot].take(1.0, message.at):
            raise Rejected(Reason.RATE)
        said: Digest | Bulletin
        if message.channel == BULLETINS:
            said = read_bulletin(message.payload, seen.robot, self._roster)
        elif message.channel == "digest":
            said = read_digest(message.payload, seen.robot, self._roster)
        else:
            return
        if said.epoch != seen.epoch:
            if seen.live(message.at) and said.stamp < seen.stamp:
                raise Rejected(Reason.REPLAYED, "of an earlier epoch")
            seen = self.robots[seen.robot] = _anew(seen, said.epoch)
        stamps = self._stamps[seen.robot, type(said)]
        stamps.check(said.epoch, said.stamp)
        stamps.mark(said.epoch, said.stamp)
        _remember(seen, said, message.at)


def read_digest(payload: bytes, sender: str, roster: Roster) -> Digest:
    """``sender``'s digest, its signature checked, whatever its configuration. Raises Rejected."""
    signature, body = unwrap(payload, LIMITS.message)
    digest = decoded(_digests, body)
    check_head(digest, sender, roster)
    verify("digest", sender, signature, body, roster)
    return digest


def _anew(seen: Seen, epoch: int) -> Seen:
    returns = 0 if seen.epoch is None else seen.returns + 1
    return Seen(seen.robot, seen.first, epoch=epoch, returns=returns, rejected=seen.rejected, details=seen.details)


def _remember(seen: Seen, said: Digest | Bulletin, at: float) -> None:
    seen.first, seen.heard = min(seen.first, at), max(seen.heard, at)
    seen._ahead.append(said.stamp - at)
    if said.stamp > seen.stamp:
        seen.stamp, seen.configuration = said.stamp, said.configuration
    if isinstance(said, Digest):
        if seen.digest is None or said.stamp > seen.digest.stamp:
            seen.digest = said
    elif seen.bulletin is None or said.stamp > seen.bulletin.stamp:
        seen.earlier = seen.earlier or said
        seen.bulletin, seen.before, seen.told = said, seen.bulletin, at
