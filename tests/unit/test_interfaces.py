"""Which changes of a machine's addresses matter to a team."""

from __future__ import annotations

import socket

import pytest

from dgorl.team import interfaces
from dgorl.team.interfaces import Addresses, Advice, Interfaces, addresses
from dgorl.team.network import Network

LO, WIFI, WIRE = ("lo", "127.0.0.1"), ("wlan0", "192.168.7.4"), ("eth0", "10.1.1.1")


def there(*found: tuple[str, str]) -> Addresses:
    return frozenset(found)


def test_an_address_that_comes_late_and_goes_and_comes() -> None:
    seen = Interfaces(Network())
    assert seen.look(there(LO)) is Advice.WAIT
    assert seen.look(there(LO, WIFI)) is Advice.JOIN
    assert seen.look(there(LO, WIFI)) is None
    assert seen.look(there(LO)) is Advice.WAIT
    assert seen.look(there(LO, WIFI)) is None, "its sockets are those of the same address"
    assert seen.look(there(LO, WIFI, WIRE)) is Advice.BEGIN_ANEW
    assert seen.look(there(LO, WIRE)) is Advice.BEGIN_ANEW


@pytest.mark.parametrize("named", ["wlan0", "192.168.7.4"])
def test_only_the_interface_that_is_scouted_on_matters(named: str) -> None:
    seen = Interfaces(Network(interface=named))
    assert seen.look(there(LO, WIRE)) is Advice.WAIT
    assert seen.look(there(LO, WIFI)) is Advice.JOIN
    assert seen.look(there(LO, WIFI, WIRE)) is None


def test_a_loopback_interface_may_be_named() -> None:
    assert Interfaces(Network(interface="lo")).look(there(LO)) is Advice.JOIN


def test_without_scouting_nothing_matters() -> None:
    seen = Interfaces(Network(multicast=False))
    assert seen.look(there()) is Advice.JOIN
    assert seen.look(there(WIFI)) is None


def test_this_machines_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    found = addresses("224.0.0.224:7446")
    assert all(socket.inet_aton(address) for _, address in found)
    monkeypatch.setattr(interfaces.sys, "platform", "other")
    (other,) = addresses("127.0.0.1:9") or [("", "")]
    assert other == ("", "127.0.0.1")
