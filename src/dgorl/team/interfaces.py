"""This machine's network: the addresses of its interfaces, and what it means for a team that they change.

Zenoh looks for interfaces once in the life of a process, when its first session is opened: one that gets its address
later is never scouted on.
"""

from __future__ import annotations

import socket
import struct
import sys
from enum import StrEnum

from dgorl.team.network import Network

Addresses = frozenset[tuple[str, str]]
"""Interfaces with their IPv4 addresses."""

SIOCGIFADDR = 0x8915
"""Linux: the address of an interface."""


class Advice(StrEnum):
    """What is to be done."""

    WAIT = "wait"
    """scouting reaches nobody"""
    JOIN = "join"
    """there is a network now"""
    BEGIN_ANEW = "begin anew"
    """there is an address that this process's sessions will never know"""


class Interfaces:
    """What an agent knows of its network. Only scouting needs it: the team file's addresses are tried anyway."""

    def __init__(self, network: Network) -> None:
        self.watched = network.multicast
        self._interface = network.interface
        self._joined: Addresses | None = None

    def look(self, now: Addresses) -> Advice | None:
        """Which advice follows from the addresses there are; it is taken."""
        there = self._of_use(now)
        if self.watched and not there:
            return Advice.WAIT
        if self._joined is None:
            self._joined = there
            return Advice.JOIN
        return Advice.BEGIN_ANEW if self.watched and there - self._joined else None

    def _of_use(self, addresses: Addresses) -> Addresses:
        """Those scouted on."""
        if self._interface != "auto":
            return frozenset((name, address) for name, address in addresses if self._interface in (name, address))
        return frozenset((name, address) for name, address in addresses if not address.startswith("127."))


def addresses(group: str) -> Addresses:
    """The addresses this machine has now; where they cannot be listed, the one from which a group would be reached."""
    if sys.platform == "linux":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            return frozenset(
                (name, found) for _, name in socket.if_nameindex() if (found := _address(probe, name)) is not None
            )
    return _towards(group)


def _address(probe: socket.socket, interface: str) -> str | None:
    import fcntl

    try:
        answer = fcntl.ioctl(probe, SIOCGIFADDR, struct.pack("256s", interface.encode()[:15]))
    except OSError:
        return None
    return socket.inet_ntoa(answer[20:24])


def _towards(group: str) -> Addresses:
    host, _, port = group.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, int(port)))  # says nothing yet
        except (OSError, ValueError):
            return frozenset()
        return frozenset({("", probe.getsockname()[0])})
