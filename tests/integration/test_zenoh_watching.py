"""Watching a team over Zenoh: it is heard, not disturbed, and bulletins cost nothing unless somebody watches."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from dgorl.team.network import Network, Tls, zenoh_settings
from dgorl.team.zenoh_transport import ZenohTransport, open_session

from . import certificates
from .test_zenoh import QUIET, ROBOTS, addresses, free_port, told, until

Join = Callable[..., ZenohTransport]


@pytest.fixture
def join() -> Iterator[Join]:
    with ExitStack() as stack:

        def enter(robot: str, network: Network, folder: Path = Path(), *, watching: bool = False) -> ZenohTransport:
            transport = ZenohTransport("lab", robot, network, time.monotonic, folder, ROBOTS, watching=watching)
            stack.callback(transport.close)
            return transport

        yield enter


def assert_watched(robots: dict[str, ZenohTransport], watcher: ZenohTransport) -> None:
    """The watcher hears digests and bulletins of all, the robots no bulletin and nothing of the watcher."""
    assert until(lambda: watcher.present() == set(robots))
    for robot, transport in robots.items():
        others = set(robots) - {robot}
        assert until(lambda t=transport, others=others: t.present() == others)
    heard: set[tuple[str, str, bytes]] = set()
    wanted = {(channel, robot, channel.encode()) for channel in ("digest", "estimate") for robot in robots}

    def all_heard() -> bool:
        for transport in robots.values():
            for channel in ("digest", "estimate", "bundles"):
                transport.send(channel, channel.encode())
        time.sleep(0.05)
        heard.update(message[:3] for message in watcher.poll())
        return wanted <= heard

    assert until(all_heard)
    assert heard == wanted
    time.sleep(QUIET)
    for robot, transport in robots.items():
        messages = transport.poll()
        assert {message.channel for message in messages} == {"digest", "bundles"}
        assert {message.sender for message in messages} == set(robots) - {robot}
        assert transport.present() == set(robots) - {robot}
    watcher.send("digest", b"nothing")
    assert watcher.traffic.sent_messages == 0


def test_at_given_addresses(join: Join) -> None:
    network = Network(addresses("r1", "r2"), multicast=False)
    robots = {name: join(name, network) for name in ("r1", "r2")}
    assert_watched(robots, join("monitor", network, watching=True))


def test_by_scouting(join: Join) -> None:
    network = Network(interface="127.0.0.1", group=f"224.0.0.225:{free_port()}")
    robots = {name: join(name, network) for name in ("r1", "r2")}
    assert_watched(robots, join("monitor", network, watching=True))


def test_over_a_router(join: Join) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session({"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}):
        network = Network(connect=(endpoint,), mode="client", multicast=False)
        robots = {name: join(name, network) for name in ("r1", "r2")}
        assert_watched(robots, join("monitor", network, watching=True))


def test_with_its_own_certificate(join: Join, tmp_path: Path) -> None:
    certificates.make(tmp_path, ("r1", "r2", "monitor"))
    tls = Tls("ca.pem", "{robot}.pem", "{robot}.key.pem")
    network = Network(addresses("r1", "r2", protocol="tls"), multicast=False, tls=tls)
    robots = {name: join(name, network, tmp_path) for name in ("r1", "r2")}
    assert_watched(robots, join("monitor", network, tmp_path, watching=True))


def test_bulletins_cost_nothing_unless_watched(join: Join) -> None:
    network = Network(addresses("r1", "r2"), multicast=False)
    first, second = join("r1", network), join("r2", network)
    assert until(lambda: second.present() and first.present())
    first.send("estimate", b"to nobody")
    assert (first.traffic.sent_messages, first.traffic.dropped) == (0, 0)
    watcher = join("monitor", network, watching=True)

    def counts() -> int:
        first.send("estimate", b"to somebody")
        return first.traffic.sent_messages

    assert until(counts)
    watcher.close()
    assert until(lambda: (before := counts()) == counts() == before)


def test_a_robot_without_an_address_connects_to_all(join: Join) -> None:
    known = addresses("r2", "r3")
    network = Network(known, multicast=False)
    assert zenoh_settings(network, "r1", Path())["connect/endpoints"] == list(known.values())
    assert zenoh_settings(network, "r3", Path())["connect/endpoints"] == [known["r2"]]
    assert zenoh_settings(network, "r3", Path(), watching=True)["connect/endpoints"] == list(known.values())
    robots = {name: join(name, network) for name in ("r1", "r2", "r3")}
    for name, transport in robots.items():
        assert until(lambda t=transport, others=set(robots) - {name}: t.present() == others)
    robots["r1"].send("digest", b"hello")
    assert told(robots["r3"]) == [("digest", "r1", b"hello")]


def test_keys_with_wildcards_are_not_the_teams(join: Join, capfd: pytest.CaptureFixture[str]) -> None:
    network = Network(addresses("r1", "r2"), multicast=False)
    robot = join("r1", network)
    with open_session(zenoh_settings(network, "r2", Path())) as stranger:
        publish = stranger.declare_publisher("dgorl/lab/r2/digest")
        assert until(lambda: publish.matching_status.matching)
        tokens = [stranger.liveliness().declare_token(key) for key in ("dgorl/lab/r2/alive", "dgorl/lab/*/alive")]
        for key in ("dgorl/**", "**/digest", "dgorl/lab/**", "dgorl/lab/*/digest"):
            stranger.put(key, b"odd")
        publish.put(b"even")
        assert until(lambda: robot.present() == {"r2"})
        assert told(robot) == [("digest", "r2", b"even")]
        assert len(tokens) == 2
    assert "Traceback" not in capfd.readouterr().err
