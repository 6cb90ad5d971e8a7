"""Where a team meets: the ``transport`` section of team.yaml, and the Zenoh configuration it means for one robot."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dgorl.configuration import nearest
from dgorl.errors import ConfigurationError

MODES = ("peer", "client")
ANY_PORT = "{protocol}/0.0.0.0:0"
ROUTER_PATIENCE_MS = 5000


@dataclass(frozen=True)
class Tls:
    """Mutual TLS: who shows no certificate of the authority is turned away. Paths; ``{robot}`` stands for the name."""

    authority: str
    certificate: str
    key: str


@dataclass(frozen=True)
class Network:
    """How robots find one another. Endpoints are Zenoh's, like ``tcp/10.0.0.1:7447`` or ``tls/...``."""

    addresses: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    """where each robot listens; of two robots the later by name connects to the earlier"""
    connect: tuple[str, ...] = ()
    """whom all connect to besides: routers"""
    mode: str = "peer"
    """peer; or client, of a router: robots in different networks hear one another over it alone"""
    multicast: bool = True
    """look for peers on the local network"""
    interface: str = "auto"
    """... on this network interface"""
    group: str = "224.0.0.224:7446"
    """... in this multicast group"""
    tls: Tls | None = None


def read_network(section: Mapping[str, Any], robots: Collection[str], source: str) -> Network:
    """The network a team file describes; without ``multicast`` there is scouting where no address is given.

    robots: the names that may have addresses. source: named in errors. Raises ConfigurationError.
    """
    known = [f.name for f in fields(Network)]
    for key in section:
        _require(key in known, source, f"unknown setting `transport.{key}`{nearest(str(key), known)}")
    addresses = _texts(section.get("addresses", {}), source, "addresses")
    for robot in addresses:
        _require(robot in robots, source, f"`transport.addresses` names an unknown robot `{robot}`")
    connect = section.get("connect", [])
    if not isinstance(connect, list | tuple) or not all(isinstance(endpoint, str) for endpoint in connect):
        raise ConfigurationError(f"{source}: `transport.connect` must be a list of endpoints, got {connect!r}")
    multicast = section.get("multicast", not addresses and not connect)
    _require(isinstance(multicast, bool), source, f"`transport.multicast` must be true or false, got {multicast!r}")
    words = {key: section.get(key, getattr(Network, key)) for key in ("mode", "interface", "group")}
    _texts(words, source, "")
    _require(words["mode"] in MODES, source, f"`transport.mode` must be peer or client, got {words['mode']!r}")
    tls = _tls(section["tls"], source) if section.get("tls") is not None else None
    for endpoint in (*addresses.values(), *connect):
        protocol, _, address = endpoint.partition("/")
        _require(bool(protocol and address), source, f"{endpoint!r} is no endpoint, like tcp/10.0.0.1:7447")
        _require(
            tls is None or protocol in ("tls", "quic"), source, f"{endpoint!r} must begin with tls/, as `tls` is on"
        )
    return Network(MappingProxyType(addresses), tuple(connect), multicast=multicast, tls=tls, **words)


def zenoh_settings(network: Network, robot: str, folder: Path, *, watching: bool = False) -> dict[str, Any]:
    """Zenoh's configuration for ``robot``, slash-separated key → value; relative TLS paths start from ``folder``.

    watching: for one who is no robot of the team; it connects to all and listens nowhere.
    """
    every = watching or robot not in network.addresses
    earlier = [address for name, address in sorted(network.addresses.items()) if every or name < robot]
    protocol = "tcp" if network.tls is None else "tls"
    listen = [network.addresses.get(robot, ANY_PORT.format(protocol=protocol))]
    settings: dict[str, Any] = {
        "mode": network.mode,
        "listen/endpoints": listen if network.mode == "peer" and not watching else [],
        "connect/endpoints": [*earlier, *network.connect] if network.mode == "peer" else list(network.connect),
        # A peer starts whether or not the others are there and keeps trying; a client needs its router to start.
        "connect/timeout_ms": -1 if network.mode == "peer" else ROUTER_PATIENCE_MS,
        "connect/exit_on_failure": network.mode != "peer",
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": network.multicast,
        "scouting/multicast/interface": network.interface,
        "scouting/multicast/address": network.group,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,
        # A peer that is gone is noticed after this long.
        "transport/link/tx/lease": 3000,
        # No message of the team comes near this size [B]; without it a stranger's could fill the memory.
        "transport/link/rx/max_message_size": 2**20,
    }
    if network.tls is not None:
        paths = {name: _path(getattr(network.tls, name), robot, folder) for name in ("authority", "certificate", "key")}
        settings |= {
            "transport/link/tls/root_ca_certificate": paths["authority"],
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/close_link_on_expiration": True,
        }
        for side in ("listen", "connect"):
            settings[f"transport/link/tls/{side}_certificate"] = paths["certificate"]
            settings[f"transport/link/tls/{side}_private_key"] = paths["key"]
    return settings


def _tls(section: object, source: str) -> Tls:
    known = [f.name for f in fields(Tls)]
    if not isinstance(section, Mapping):
        raise ConfigurationError(f"{source}: `transport.tls` must hold {', '.join(known)}, got {section!r}")
    for key in section:
        _require(key in known, source, f"unknown setting `transport.tls.{key}`{nearest(str(key), known)}")
    missing = [name for name in known if name not in section]
    _require(not missing, source, f"`transport.tls` needs {', '.join(missing)}: paths of PEM files")
    return Tls(**_texts(section, source, "tls"))


def _texts(section: object, source: str, name: str) -> dict[str, str]:
    if not isinstance(section, Mapping):
        raise ConfigurationError(f"{source}: `transport.{name}` must be a mapping, got {section!r}")
    for key, value in section.items():
        key_path = ".".join(part for part in ("transport", name, str(key)) if part)
        _require(isinstance(value, str) and bool(value), source, f"`{key_path}` must be text, got {value!r}")
    return dict(section)


def _path(text: str, robot: str, folder: Path) -> str:
    path = folder / text.replace("{robot}", robot)
    if not path.is_file():
        raise ConfigurationError(f"{path}: no such file; `transport.tls` of the team file names it")
    return str(path)


def _require(holds: bool, source: str, what: str) -> None:
    if not holds:
        raise ConfigurationError(f"{source}: {what}")
