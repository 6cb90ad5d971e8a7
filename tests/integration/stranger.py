"""Somebody without keys on a team's network, who hears all and says whatever does harm."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import cycle

import msgspec
import zenoh

from dgorl.measurements import Odometry, Range
from dgorl.team.bundles import Bundle, track_epoch
from dgorl.team.envelope import Reason, unwrap
from dgorl.team.intake import line_of
from dgorl.team.keys import Key, generate
from dgorl.team.messages import CHANNEL, Bundles, Digest, Message, Requests, write
from dgorl.team.team_file import TeamFile
from dgorl.team.wire import LIMITS, seal
from dgorl.team.zenoh_transport import open_session

Forgery = tuple[str, str, bytes, Reason]
"""Robot it is said to be of, channel, payload, what it will be counted as."""
YESTERDAY = 1
"""An epoch of the victim that is long gone."""
OLD = 1.0
"""A message is repeated when it is older than this [s]: all have it."""
OFTEN = 0.8
"""Volleys come no faster than this [s]: what a robot is allowed to say is not used up."""


class Stranger:
    """Pretends to be ``victim``. ``said``: how many messages each of the others should have counted, by reason.

    recorded: the victim's own key, for what it said in an earlier life and somebody recorded.
    """

    def __init__(self, team: TeamFile, victim: str, recorded: Key) -> None:
        self.said: Counter[str] = Counter()
        self._team, self._victim = team, victim
        self._key, self._recorded = generate(), recorded
        self._heard: dict[str, list[tuple[float, bytes]]] = {}
        self._epoch, self._number, self._last = 0, 0, -float("inf")
        self._stack = ExitStack()
        self._session = self._stack.enter_context(self._joined())
        key = f"dgorl/{team.team}/{victim}/*"
        self._session.declare_subscriber(key, self._hear, allowed_origin=zenoh.Locality.REMOTE)

    def volley(self) -> None:
        """One of every forgery, if it is time and there is something to forge."""
        now = time.monotonic()
        old = {c: [data for at, data in heard if at < now - OLD] for c, heard in self._heard.items()}
        if now - self._last < OFTEN or not old.get("digest") or not old.get("bundles"):
            return
        self._last = now
        for robot, channel, payload, reason in self._forgeries(old):
            self._put(f"dgorl/{self._team.team}/{robot}/{channel}", payload)
            self.said[reason] += 1
        for key, payload in self._beside(old):
            self._put(key, payload)

    def flood(self, rate: float, seconds: float) -> int:
        """Garbage and forged messages as the victim's, so many a second, one after another; how many."""
        messages = cycle([("bundles", b"nonsense" * 20), *self._messages(epoch=YESTERDAY)])
        began, sent = time.monotonic(), 0
        while (passed := time.monotonic() - began) < seconds:
            while sent < rate * passed:
                channel, payload = next(messages)
                self._session.put(f"dgorl/{self._team.team}/{self._victim}/{channel}", payload)
                sent += 1
            time.sleep(0.01)
        return sent

    def too_large(self) -> None:
        """A message larger than the network takes; the one who sends it is cut off."""
        with self._joined() as session:
            session.put(f"dgorl/{self._team.team}/{self._victim}/bundles", bytes(2**21))
            time.sleep(0.2)

    def sense(self, robot: str, now: float) -> None:
        """Measurements for ``robot``, good ones but for the network they come by."""
        peer = next(name for name in self._team.robots if name != robot)
        rows = (Odometry(robot, now - 0.5, now, 9.0, 1.0), Range(robot, peer, now, 77.0, 0.01))
        self._put(f"local/{robot}/measurements", b"\n".join(map(line_of, rows)))

    def close(self) -> None:
        self._stack.close()

    def _forgeries(self, old: dict[str, list[bytes]]) -> Iterator[Forgery]:
        """What has to be counted."""
        victim, digest = self._victim, old["digest"][-1]
        self._epoch = msgspec.msgpack.decode(unwrap(digest, LIMITS.message)[1])[2]
        for channel, payload in self._messages():
            yield victim, channel, payload, Reason.SIGNATURE
            yield "r9", channel, payload, Reason.UNKNOWN
            yield victim, channel, b"\x94\x02" + payload[2:] + b"\0", Reason.VERSION
            yield victim, channel, b"nonsense", Reason.MALFORMED
            yield victim, channel, payload[: len(payload) // 2], Reason.MALFORMED
        yield victim, "bundles", bytes(LIMITS.message + 1), Reason.TOO_LARGE
        for channel, payload in self._messages(team="another"):
            yield victim, channel, payload, Reason.TEAM
        for channel, payload in self._messages(configuration=bytes(8)):
            yield victim, channel, payload, Reason.CONFIGURATION
        for channel, payload in self._messages(robot="r9"):
            yield victim, channel, payload, Reason.SENDER
        yield victim, "digest", digest, Reason.REPLAYED
        yield victim, "bundles", old["bundles"][0], Reason.REPLAYED
        yield victim, "requests", digest, Reason.MALFORMED

    def _beside(self, old: dict[str, list[bytes]]) -> Iterator[tuple[str, bytes]]:
        """What has no effect and is not counted: on other keys, in another life."""
        for channel, payload in self._messages(self._recorded, epoch=YESTERDAY):
            yield f"dgorl/{self._team.team}/{self._victim}/{channel}", payload
        for channel in (*CHANNEL.values(), "estimate"):
            payload = (old.get(channel) or old["digest"])[-1]
            yield f"dgorl/another/{self._victim}/{channel}", payload
            yield f"dgorl/{self._team.team}/*/{channel}", payload
        yield f"dgorl/{self._team.team}/{self._victim}/estimate", b"nonsense"
        yield f"dgorl/{self._team.team}/{self._victim}/no-such-channel", b"nonsense"

    def _messages(
        self, key: Key | None = None, epoch: int | None = None, **changes: object
    ) -> Iterator[tuple[str, bytes]]:
        """One of each kind that is well made but for the key, stamped in the future of all that the victim said."""
        key, epoch = key or self._key, epoch or self._epoch
        row = Odometry(self._victim, 0.0, 0.5, 9.0, 9.0, track_epoch(epoch, 0))
        bundle = Bundle(self._team.team, self._victim, epoch, 10_000, 0, 0.5, (row,))
        held = [(self._victim, epoch, [0, 10_000])]
        contents: tuple[tuple[type[Message], list], ...] = (
            (Digest, [held, [self._victim]]),
            (Requests, [[(robot, held) for robot in self._team.robots]]),
            (Bundles, [[seal(bundle, key).data]]),
        )
        for kind, content in contents:
            self._number += 1
            head = {
                "team": self._team.team, "robot": self._victim, "epoch": epoch, "stamp": 1e6 + self._number,
                "number": self._number % 128, "configuration": self._team.configuration_hash,
            }  # fmt: skip
            yield CHANNEL[kind], write(kind(*(head | changes).values(), *content), key)

    def _joined(self) -> zenoh.Session:
        endpoints = list(self._team.transport.addresses.values())
        return open_session(
            {
                "mode": "peer",
                "listen/endpoints": [],
                "connect/endpoints": endpoints,
                "scouting/multicast/enabled": False,
            }
        )

    def _put(self, key: str, payload: bytes) -> None:
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def _hear(self, sample: zenoh.Sample) -> None:
        channel = str(sample.key_expr).rpartition("/")[2]
        self._heard.setdefault(channel, []).append((time.monotonic(), sample.payload.to_bytes()))
