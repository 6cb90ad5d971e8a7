"""The robot's own side: measurements in and estimates out over a Zenoh session that is bound to loopback.

Keys ``local/ROBOT/measurements`` (one JSON line a message, or several with line breaks), ``local/ROBOT/estimate``,
``local/ROBOT/errors``. It shares nothing with the session on the team's network: no route leads from one to the other.
"""

from __future__ import annotations

from collections.abc import Callable
from ipaddress import ip_address

import zenoh
from zenoh.handlers import Callback

from dgorl.team.zenoh_transport import NetworkError, open_session


class LocalSession:
    """take: called with each line that comes, from another thread; it must not block.

    endpoint: ``tcp/127.0.0.1:PORT``. Raises NetworkError for one that others could reach, or that is in use.
    """

    def __init__(self, robot: str, endpoint: str, take: Callable[[bytes], None]) -> None:
        port_of(endpoint)
        self._take = take
        self._session = open_session(
            {
                "mode": "peer",
                "listen/endpoints": [endpoint],
                "scouting/multicast/enabled": False,
                "scouting/gossip/enabled": False,
                "transport/shared_memory/enabled": False,
                "transport/link/rx/max_message_size": 2**20,
            }
        )
        self._session.declare_subscriber(f"local/{robot}/measurements", Callback(self._hear, indirect=False))
        self._estimate = self._session.declare_publisher(f"local/{robot}/estimate")
        self._errors = self._session.declare_publisher(f"local/{robot}/errors")

    def estimate(self, line: bytes) -> None:
        """Tell whoever listens."""
        self._estimate.put(line)

    def error(self, line: bytes) -> None:
        """Answer a bad line."""
        self._errors.put(line)

    def close(self) -> None:
        """Let go of the port."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _hear(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            for line in sample.payload.to_bytes().splitlines():
                self._take(line)


def port_of(endpoint: str) -> int:
    """The port of an endpoint on loopback. Raises NetworkError for any other."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    try:
        loopback = host == "localhost" or ip_address(host.strip("[]")).is_loopback
        number = int(port)
    except ValueError:
        loopback, number = False, 0
    if protocol != "tcp" or not loopback:
        raise NetworkError(f"{endpoint!r}: a robot's own measurements enter on loopback alone, like tcp/127.0.0.1:7448")
    return number
