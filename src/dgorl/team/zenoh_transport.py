"""The transport between robots: Zenoh, peer to peer, embedded in the process. INTERFACES, "Live team".

Keys ``dgorl/TEAM/ROBOT/CHANNEL``; presence by liveliness tokens ``dgorl/TEAM/ROBOT/alive``. Who sent a message is read
from its key, which anybody on the network could have chosen: what it says is believed for its signature alone.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from threading import Lock, Thread
from time import sleep
from typing import Any

import zenoh
from zenoh.handlers import Callback

from dgorl.errors import DgorlError
from dgorl.logs.team import valid_name
from dgorl.team.gate import MESSAGES_PER_SECOND
from dgorl.team.network import Network, zenoh_settings
from dgorl.team.rates import Bucket
from dgorl.team.transport import BULLETINS, CHANNELS, GOSSIPED, WATCHED, Received, Traffic

QUEUE = 4096
"""Messages kept between two polls; the newest beyond that are dropped and counted."""
QUEUE_BYTES = 16 * 2**20
"""... and payload bytes."""
PRESENT = 256
"""Beside the team's so many are noticed at most; those whose names no robot can have are counted."""
RATE, BURST = 2 * MESSAGES_PER_SECOND, 4 * MESSAGES_PER_SECOND
"""What one sender says beyond this [1/s], and more at once, is not even copied: the gate would let in half of it."""
CLOSING = 3.0
"""Leaving in good order takes at most so long [s]."""
BRAKE, EVERY = 0.01, 20
"""So long [s] the network waits after so many too many: whoever floods us is slowed down by its own connection."""


class NetworkError(DgorlError):
    """The network cannot be used as the team file says."""


def open_session(settings: Mapping[str, Any]) -> zenoh.Session:
    """A Zenoh session; settings: slash-separated key → value. Raises NetworkError with what Zenoh says."""
    try:
        configuration = zenoh.Config()
        for key, value in settings.items():
            configuration.insert_json5(key, json.dumps(value))
        return zenoh.open(configuration)
    except zenoh.ZError as error:
        what = str(error).split(" at /")[0].splitlines()[0]
        endpoints = [*settings.get("listen/endpoints", ()), *settings.get("connect/endpoints", ())]
        raise NetworkError(f"network: cannot be opened ({', '.join(endpoints)}): {what}") from error


class ZenohTransport:
    """One robot on its team's network; a Transport.

    clock: the robot's local clock [s], read when a message comes in. members: the team's robots; all others share what
    one may say. folder: where relative paths of TLS files start.
    joins: at once, or later, when :meth:`join` is called.
    watching: it is no robot of the team but hears digests and bulletins of all, and says nothing.
    Raises NetworkError when the network cannot be used, ConfigurationError for missing TLS files.
    """

    def __init__(
        self,
        team: str,
        robot: str,
        network: Network,
        clock: Callable[[], float],
        folder: Path,
        members: Collection[str],
        *,
        watching: bool = False,
        joins: bool = True,
    ) -> None:
        self._robot, self._clock = None if watching else robot, clock
        self._lock = Lock()
        self._inbox: deque[Received] = deque()
        self._waiting = 0
        self._present: set[str] = set()
        self._nameless: set[str] = set()
        self._sent, self._sent_bytes, self._received, self._received_bytes, self._dropped = 0, 0, 0, 0, 0
        self._refused, self._excess, self._braking = 0, 0, Lock()
        self._keys: dict[str, tuple[str, str]] = {}
        self._rates = {name: Bucket(RATE, BURST) for name in members}
        self._others = Bucket(RATE, BURST)
        self._settings = zenoh_settings(network, robot, folder, watching=watching)
        self._team, self._own = team, f"dgorl/{team}/{robot}"
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._session: zenoh.Session | None = None
        if joins:
            self.join()

    def join(self) -> None:
        """Join the network, once; until then nobody is heard and what is sent is dropped. Raises NetworkError."""
        self._session = open_session(self._settings)
        watching = self._robot is None
        # Called straight from the network's thread: a slow process slows its senders, who drop, and queues nowhere.
        for channel in WATCHED if watching else GOSSIPED:
            self._session.declare_subscriber(f"dgorl/{self._team}/*/{channel}", Callback(self._hear, indirect=False))
        liveliness = self._session.liveliness()
        everybody = f"dgorl/{self._team}/*/alive"
        liveliness.declare_subscriber(everybody, Callback(self._notice, indirect=False), history=True)
        self._token = None if watching else liveliness.declare_token(f"{self._own}/alive")
        self._publishers = {
            channel: self._publisher(self._session, f"{self._own}/{channel}")
            for channel in (() if watching else CHANNELS)
        }

    def send(self, channel: str, payload: bytes) -> None:
        """To all who hear; dropped under congestion by Zenoh, unseen here, or counted when there is no network.

        A bulletin costs nothing while nobody watches.
        """
        publisher = self._publishers.get(channel)
        try:
            if publisher is None:
                raise zenoh.ZError(f"no channel {channel}")
            if channel == BULLETINS and not publisher.matching_status.matching:  # type: ignore[attr-defined]
                return
            publisher.put(payload)
        except zenoh.ZError:
            with self._lock:
                self._dropped += 1
            return
        with self._lock:
            self._sent += 1
            self._sent_bytes += len(payload)

    def poll(self) -> list[Received]:
        """What came since the last poll, in the order it came."""
        with self._lock:
            inbox, self._inbox, self._waiting = self._inbox, deque(), 0
        return list(inbox)

    def present(self) -> frozenset[str]:
        """The other robots on the network now."""
        with self._lock:
            return frozenset(self._present)

    @property
    def nameless(self) -> int:
        """How many are on the network now under names that no robot can have."""
        with self._lock:
            return len(self._nameless)

    @property
    def traffic(self) -> Traffic:
        """Payload carried so far."""
        with self._lock:
            return Traffic(
                self._sent, self._sent_bytes, self._received, self._received_bytes, self._dropped, self._refused
            )

    def close(self) -> None:
        """Leave the network; what is sent afterwards is dropped and counted."""
        if self._session is not None and not self._session.is_closed():
            self._publishers = {}
            # With links that are broken it takes 10 s and fails; the others notice by their lease that we are gone.
            closing = Thread(target=_close, args=(self._session,), daemon=True)
            closing.start()
            closing.join(CLOSING)

    def _publisher(self, session: zenoh.Session, key: str) -> zenoh.Publisher:
        return session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, allowed_destination=zenoh.Locality.REMOTE
        )

    def _hear(self, sample: zenoh.Sample) -> None:
        """Called for every message; one too many costs no more than its key."""
        at = self._clock()
        key = str(sample.key_expr)
        sender, channel = self._keys.get(key) or self._read(key)
        if not sender or sender == self._robot or not self._rate(sender).take(1.0, at):
            self._refuse(sender)
            return
        if sample.kind != zenoh.SampleKind.PUT:
            return
        size = len(sample.payload)
        with self._lock:
            if len(self._inbox) >= QUEUE or self._waiting + size > QUEUE_BYTES:
                self._dropped += 1
                return
            self._inbox.append(Received(channel, sender, sample.payload.to_bytes(), at))
            self._waiting += size
            self._received += 1
            self._received_bytes += size

    def _read(self, key: str) -> tuple[str, str]:
        """Sender and channel of a key; those of the team are remembered."""
        named = _named(key)
        if named[0] in self._rates:
            self._keys[key] = named
        return named

    def _rate(self, sender: str) -> Bucket:
        """What a sender may still say."""
        return self._rates.get(sender, self._others)

    def _refuse(self, sender: str) -> None:
        """Count it, and slow down the connection it came by: one at a time, so that the others go on."""
        with self._lock:
            self._refused += sender not in ("", self._robot)
            self._excess += 1
            brake = self._excess % EVERY == 0
        if brake and self._braking.acquire(blocking=False):
            try:
                sleep(BRAKE)
            finally:
                self._braking.release()

    def _notice(self, sample: zenoh.Sample) -> None:
        robot, _ = _named(str(sample.key_expr))
        if robot == self._robot or not robot:
            return
        known = self._present if valid_name(robot) else self._nameless
        with self._lock:
            if sample.kind != zenoh.SampleKind.PUT:
                known.discard(robot)
            elif robot in self._rates or len(known) < PRESENT:
                known.add(robot)


def _close(session: zenoh.Session) -> None:
    with suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]


def _named(key: str) -> tuple[str, str]:
    """The last two parts of a sample's key; empty for one with wildcards, which a stranger may use."""
    _, _, robot, what = key.split("/") if "*" not in key else ("",) * 4
    return robot, what
