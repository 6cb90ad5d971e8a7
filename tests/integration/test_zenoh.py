"""The Zenoh transport on loopback: given addresses, scouting, a router, mutual TLS, and what strangers can do."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from dgorl.errors import ConfigurationError
from dgorl.team.network import Network, Tls
from dgorl.team.team_file import TeamFile
from dgorl.team.transport import Received
from dgorl.team.zenoh_transport import BURST, PRESENT, RATE, NetworkError, ZenohTransport, open_session

from . import certificates

EXAMPLES = Path(__file__).parents[2] / "examples" / "networks"
QUIET = 0.3
"""Long enough on loopback for anything that comes to have come [s]."""
ROBOTS = ("r1", "r2", "r3", "r4", "r5")
Join = Callable[..., ZenohTransport]


@pytest.fixture
def join() -> Iterator[Join]:
    """Joins robots to networks, all of which they leave when the test ends."""
    with ExitStack() as stack:

        def enter(robot: str, network: Network, folder: Path = Path(), clock: Callable[[], float] = time.monotonic):
            transport = ZenohTransport("lab", robot, network, clock, folder, ROBOTS)
            stack.callback(transport.close)
            return transport

        yield enter


def addresses(*robots: str, protocol: str = "tcp") -> dict[str, str]:
    return {robot: f"{protocol}/127.0.0.1:{free_port()}" for robot in robots}


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(holds: Callable[[], object], seconds: float = 10.0) -> bool:
    """Whether it comes to hold."""
    deadline = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def told(listener: ZenohTransport, count: int = 1, seconds: float = 10.0) -> list[tuple[str, str, bytes]]:
    """The first ``count`` messages a robot hears."""
    heard: list[Received] = []
    until(lambda: heard.extend(listener.poll()) or len(heard) >= count, seconds)
    return [message[:3] for message in heard]


def assert_all_hear_all(robots: dict[str, ZenohTransport]) -> None:
    names = set(robots)
    for name, transport in robots.items():
        assert until(lambda t=transport, others=names - {name}: t.present() == others), (name, transport.present())
    for name, transport in robots.items():
        transport.send("bundles", name.encode())
    for name, transport in robots.items():
        wanted = sorted(("bundles", other, other.encode()) for other in names - {name})
        assert sorted(told(transport, len(wanted))) == wanted


def test_given_addresses(join: Join) -> None:
    network = Network(addresses("r1", "r2", "r3"), multicast=False)
    # The last by name first: it finds nobody yet and keeps trying.
    assert_all_hear_all({name: join(name, network) for name in ("r3", "r2", "r1")})


def test_scouting(join: Join) -> None:
    network = Network(interface="127.0.0.1", group=f"224.0.0.225:{free_port(socket.SOCK_DGRAM)}")
    assert_all_hear_all({name: join(name, network) for name in ("r1", "r2", "r3")})


def test_a_router_between_networks(join: Join) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = {"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    with open_session(settings):
        network = Network(connect=(endpoint,), mode="client", multicast=False)
        assert_all_hear_all({name: join(name, network) for name in ("r1", "r2", "r3")})


def test_a_client_without_its_router_says_so(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dgorl.team.network.ROUTER_PATIENCE_MS", 200)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(NetworkError, match=f"network: .*{endpoint}"):
        join("r1", Network(connect=(endpoint,), mode="client", multicast=False))


def test_one_address_is_enough(join: Join) -> None:
    """r1 and r3 know r2 alone: it introduces them, and does not relay."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ends = Network(connect=(endpoint,), multicast=False)
    middle = Network({"r2": endpoint}, multicast=False)
    robots = {"r1": join("r1", ends), "r2": join("r2", middle), "r3": join("r3", ends)}
    assert_all_hear_all(robots)
    robots["r2"].close()
    robots["r1"].send("bundles", b"straight")
    assert told(robots["r3"]) == [("bundles", "r1", b"straight")]


def test_presence_follows_who_leaves_and_returns(join: Join) -> None:
    network = Network(addresses("r1", "r2"), multicast=False)
    first, second = join("r1", network), join("r2", network)
    assert until(lambda: first.present() == {"r2"})
    second.close()
    assert until(lambda: not first.present())
    second.send("bundles", b"too late")
    assert second.traffic.dropped == 1
    again = join("r2", network)
    assert until(lambda: first.present() == {"r2"} and again.present() == {"r1"})


def test_traffic_and_stamps(join: Join) -> None:
    network = Network(addresses("r1", "r2"), multicast=False)
    first, second = join("r1", network, clock=lambda: 42.0), join("r2", network)
    assert until(lambda: second.present() and first.present())
    second.send("digest", b"abc")
    second.send("requests", b"de")
    heard: list[Received] = []
    assert until(lambda: heard.extend(first.poll()) or len(heard) == 2)
    assert {message.at for message in heard} == {42.0}
    assert (second.traffic.sent_messages, second.traffic.sent_bytes) == (2, 5)
    assert (first.traffic.received_messages, first.traffic.received_bytes) == (2, 5)
    assert second.poll() == []  # nobody hears himself


def test_estimates_travel_to_monitors_alone(join: Join) -> None:
    network = Network(addresses("r1", "r2"), multicast=False)
    first, second = join("r1", network), join("r2", network)
    assert until(lambda: first.present() and second.present())
    first.send("estimate", b"where")
    first.send("bundles", b"what")
    assert told(second) == [("bundles", "r1", b"what")]
    assert first.traffic.sent_messages == 1
    seen: list[bytes] = []
    with open_session({"mode": "client", "connect/endpoints": [network.addresses["r1"]]}) as monitor:
        monitor.declare_subscriber("dgorl/lab/*/estimate", lambda sample: seen.append(sample.payload.to_bytes()))
        assert until(lambda: first.send("estimate", b"there") or seen)
    assert seen[0] == b"there"


def test_a_full_queue_drops_and_counts(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dgorl.team.zenoh_transport.QUEUE", 5)
    network = Network(addresses("r1", "r2"), multicast=False)
    first, second = join("r1", network), join("r2", network)
    assert until(lambda: second.present() and first.present())
    for k in range(8):
        second.send("bundles", bytes([k]))
    assert until(lambda: first.traffic.dropped == 3)
    assert [message.payload for message in first.poll()] == [bytes([k]) for k in range(5)]
    second.send("bundles", b"room again")
    assert told(first) == [("bundles", "r2", b"room again")]


def test_a_robot_that_hangs_holds_up_nobody(join: Join) -> None:
    network = Network(addresses("r1", "r2", "r3"), multicast=False)
    stuck = False

    def clock() -> float:
        while stuck:
            time.sleep(0.01)
        return 0.0

    slow, fast, sender = join("r1", network, clock=clock), join("r2", network), join("r3", network)
    for transport in (slow, fast, sender):
        assert until(lambda t=transport: len(t.present()) == 2)
    stuck = True
    try:
        began = time.monotonic()
        for _ in range(200):
            sender.send("bundles", bytes(50_000))  # 10 MB, more than the sockets' buffers hold
        assert time.monotonic() - began < 5.0
        assert told(fast)[0][1] == "r3"
    finally:
        stuck = False


class TestTls:
    @pytest.fixture
    def network(self, tmp_path: Path) -> Network:
        certificates.make(tmp_path, ("r1", "r2"))
        return Network(
            addresses("r1", "r2", protocol="tls"), multicast=False, tls=Tls("ca.pem", "{robot}.pem", "{robot}.key.pem")
        )

    def test_the_team_hears_one_another(self, join: Join, network: Network, tmp_path: Path) -> None:
        assert_all_hear_all({name: join(name, network, tmp_path) for name in ("r1", "r2")})

    @pytest.mark.parametrize("own", [False, True], ids=["without certificate", "of another authority"])
    def test_a_stranger_reads_and_writes_nothing(self, join: Join, network: Network, tmp_path: Path, own: bool) -> None:
        robots = {name: join(name, network, tmp_path) for name in ("r1", "r2")}
        certificates.make(tmp_path / "other", ("mallory",), "other")
        tls = {"root_ca_certificate": str(tmp_path / "ca.pem"), "verify_name_on_connect": False}
        if own:
            tls |= {
                "enable_mtls": True,
                "connect_certificate": str(tmp_path / "other" / "mallory.pem"),
                "connect_private_key": str(tmp_path / "other" / "mallory.key.pem"),
            }
        settings = {f"transport/link/tls/{key}": value for key, value in tls.items()}
        settings |= {
            "mode": "client",
            "connect/endpoints": [network.addresses["r1"]],
            "scouting/multicast/enabled": False,
            "connect/timeout_ms": 1000,
        }
        with pytest.raises(NetworkError):
            open_session(settings)
        # ... and as a peer, which is let open without a connection and keeps trying.
        settings |= {"mode": "peer", "listen/endpoints": [], "connect/exit_on_failure": False, "connect/timeout_ms": -1}
        overheard: list[str] = []
        with open_session(settings) as stranger:
            stranger.declare_subscriber("**", lambda sample: overheard.append(str(sample.key_expr)))
            stranger.put("dgorl/lab/r9/bundles", b"forged")
            assert_all_hear_all(robots)
            time.sleep(QUIET)
            stranger.put("dgorl/lab/r9/bundles", b"forged")
            time.sleep(QUIET)
            assert stranger.info.peers_zid() == []
        assert set(overheard) == {"dgorl/lab/r9/bundles"}  # its own
        assert [robot.poll() for robot in robots.values()] == [[], []]

    def test_missing_files_are_named(self, join: Join, network: Network, tmp_path: Path) -> None:
        (tmp_path / "r2.key.pem").unlink()
        with pytest.raises(ConfigurationError, match=r"r2\.key\.pem: no such file"):
            join("r2", network, tmp_path)


@pytest.mark.parametrize("name", ["scouting", "addresses", "router", "tls"])
def test_examples(join: Join, tmp_path: Path, name: str) -> None:
    """Every example network, on ports that are free."""
    text = (EXAMPLES / f"{name}.yaml").read_text()
    for endpoint in sorted(set(re.findall(r"127\.0\.0\.1:\d+", text))):
        text = text.replace(endpoint, f"127.0.0.1:{free_port()}")
    group = f"224.0.0.225:{free_port(socket.SOCK_DGRAM)}"
    text = text.replace("224.0.0.224:7446", group).replace("interface: auto", "interface: 127.0.0.1")
    path = tmp_path / "team.yaml"
    path.write_text(text)
    team = TeamFile.read(path)
    certificates.make(tmp_path, tuple(team.robots))
    with ExitStack() as stack:
        if name == "router":
            listen = list(team.transport.connect)
            settings = {"mode": "router", "listen/endpoints": listen, "scouting/multicast/enabled": False}
            stack.enter_context(open_session(settings))
        assert_all_hear_all({robot: join(robot, team.transport, tmp_path) for robot in team.robots})


def test_strange_messages_are_not_the_teams(join: Join) -> None:
    network = Network(addresses("r1"), multicast=False)
    robot = join("r1", network)
    settings = {"mode": "client", "connect/endpoints": [network.addresses["r1"]]}
    with open_session(settings) as stranger:
        stranger.put("dgorl/other/r2/bundles", b"another team")
        stranger.put("dgorl/lab/r2/nonsense", b"no such channel")
        stranger.put("dgorl/lab/r1/bundles", b"in our own name")
        stranger.delete("dgorl/lab/r2/bundles")
        stranger.put("dgorl/lab/r2/bundles", b"well formed")
        assert told(robot)[-1] == ("bundles", "r2", b"well formed")
        time.sleep(QUIET)
    assert robot.poll() == []


def test_many_names_of_strangers_take_nothing_from_the_team(join: Join) -> None:
    network = Network(addresses("r1"), multicast=False)
    robot = join("r1", network)
    settings = {"mode": "client", "connect/endpoints": [network.addresses["r1"]]}
    with open_session(settings) as stranger:
        tokens = [stranger.liveliness().declare_token(f"dgorl/lab/x{k}/alive") for k in range(2 * PRESENT)]
        for k in range(1000):
            stranger.put(f"dgorl/lab/x{k}/bundles", b"whoever")
        other = join("r2", network)
        assert until(lambda: "r2" in robot.present())
        assert len(robot.present()) <= PRESENT + len(ROBOTS)
        assert until(lambda: other.present())
        for k in range(50):
            other.send("bundles", b"%d" % k)
        heard: list[Received] = []
        assert until(lambda: heard.extend(robot.poll()) or sum(m.sender == "r2" for m in heard) == 50)
        assert sum(m.sender != "r2" for m in heard) <= BURST + 10 * RATE
        assert tokens


def test_a_port_in_use_is_said_in_one_line(join: Join) -> None:
    network = Network(addresses("r1"), multicast=False)
    join("r1", network)
    with pytest.raises(NetworkError, match=r"network: cannot be opened \(tcp/127\.0\.0\.1:\d+\): .+") as error:
        join("r1", network)
    assert "\n" not in str(error.value)


def test_settings_are_zenohs() -> None:
    """A key that this Zenoh does not know is refused, so a renamed setting cannot go unnoticed."""
    with pytest.raises(zenoh.ZError):
        zenoh.Config().insert_json5("transport/link/tls/no_such_setting", json.dumps(True))
