"""The live team's team.yaml: who belongs to it, by which keys, with which settings. One file, the same on all robots.

Beside ``team``, ``robots``, ``insecure``, ``substep``, ``transport``, ``start`` and ``start_stamp`` it holds what
`dgorl config` prints. What must agree between robots is hashed; messages carry the hash.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dgorl.configuration import Configuration, as_dict, merge, nearest
from dgorl.errors import ConfigurationError, MeasurementError
from dgorl.logs.log import Start
from dgorl.logs.team import LONGEST_NAME, key_lines, valid_name
from dgorl.plain_yaml import PlainYamlError, plain_yaml
from dgorl.replay import start_priors
from dgorl.team.keys import KeyFileError, Roster, public_key
from dgorl.team.messages import HASH_BYTES
from dgorl.team.network import Network, read_network

SETTINGS = tuple(as_dict(Configuration()))
KEYS = ("team", "robots", "insecure", "substep", "transport", "start", "start_stamp", *SETTINGS)
MOST_ROBOTS = 64


@dataclass(frozen=True)
class TeamFile:
    """What team.yaml says. path: where it stands; paths in it are relative to its folder."""

    team: str
    robots: Mapping[str, str | None]
    """robot: public half of its key, base64"""
    insecure: bool = False
    """nothing is signed: whoever reaches the network can say anything"""
    substep: float = 0.0
    """odometry in shorter rows is composed to this length before it is sent [s]; 0: as the sensors report it"""
    configuration: Configuration = field(default_factory=Configuration)
    transport: Network = field(default_factory=Network)
    starts: Mapping[str, Start] = field(default_factory=lambda: MappingProxyType({}))
    """robot: where it stood at a stamp, in a common frame"""
    path: Path = Path("team.yaml")

    @staticmethod
    def read(path: Path) -> TeamFile:
        """Raises ConfigurationError: ``FILE:LINE: what is wrong``."""
        return _Reader(path).team_file()

    @cached_property
    def roster(self) -> Roster:
        """Who belongs to the team."""
        return Roster(self.team, self.robots, insecure=self.insecure)

    @cached_property
    def configuration_hash(self) -> bytes:
        """Of all that must be the same on every robot, 8 bytes; the transport need not be."""
        agreed = {
            "team": self.team,
            "robots": None if self.insecure else dict(self.robots),
            "names": sorted(self.robots),
            "substep": self.substep,
            "configuration": as_dict(self.configuration),
            "starts": {robot: [start.stamp, *start.pose] for robot, start in self.starts.items()},
        }
        return blake2b(json.dumps(agreed, sort_keys=True).encode(), digest_size=HASH_BYTES).digest()


class _Reader:
    """One file, its values and the lines of its keys."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            what = getattr(error, "strerror", None) or "not UTF-8 text"
            raise ConfigurationError(f"{path}: cannot be read: {what}") from error
        try:
            self.data, node = plain_yaml(text)
        except PlainYamlError as error:
            raise ConfigurationError(f"{path}:{error.line}: {error}") from error
        if not isinstance(self.data, dict):
            raise ConfigurationError(f"{path}:1: must be a mapping with `team` and `robots`")
        self.lines: dict[str, int] = {}
        for name, number in key_lines(node, ""):
            if name in self.lines:
                first = self.lines[name]
                raise ConfigurationError(f"{path}:{number}: `{name}` stands here twice, first in line {first}")
            self.lines[name] = number

    def team_file(self) -> TeamFile:
        for key in self.data:
            if key not in KEYS:
                raise self.error(str(key), f"unknown key `{key}`{nearest(str(key), KEYS)}")
        team = self.data.get("team")
        if not isinstance(team, str) or not team or len(team) > LONGEST_NAME or "/" in team or set(team) & set("*$#?"):
            raise self.error("team", f"`team` must name the team, without / * $ # ?, got {team!r}")
        insecure = self.data.get("insecure", False)
        if not isinstance(insecure, bool):
            raise self.error("insecure", f"`insecure` must be true or false, got {insecure!r}")
        substep = self.data.get("substep", 0.0)
        if not _number(substep) or not 0.0 <= substep <= 10.0:
            raise self.error("substep", f"`substep` must be from 0 to 10 seconds, got {substep!r}")
        robots = self._robots(insecure)
        return TeamFile(
            team,
            MappingProxyType(robots),
            insecure,
            float(substep),
            self._configuration(robots),
            self._network(robots),
            MappingProxyType(self._starts(robots)),
            self.path,
        )

    def error(self, key: str, what: str) -> ConfigurationError:
        """With the line of a key, or of the nearest one above it."""
        while key not in self.lines and "." in key:
            key = key.rpartition(".")[0]
        line = f":{self.lines[key]}" if key in self.lines else ""
        return ConfigurationError(f"{self.path}{line}: {what}")

    def _robots(self, insecure: bool) -> dict[str, str | None]:
        """Names and keys. An insecure team may list its names alone."""
        listed = self.data.get("robots")
        if isinstance(listed, list) and insecure:
            if len(set(map(str, listed))) < len(listed):
                raise self.error("robots", "`robots` lists a robot twice")
            listed = dict.fromkeys(map(str, listed))
        if not isinstance(listed, dict) or not listed:
            raise self.error("robots", "`robots` must map names to keys, like `r1: {key: BASE64}`; see `dgorl keys`")
        if len(listed) > MOST_ROBOTS:
            raise self.error("robots", f"a team has at most {MOST_ROBOTS} robots, got {len(listed)}")
        robots: dict[str, str | None] = {}
        for name, entry in listed.items():
            where = f"robots.{name}"
            if not valid_name(name):
                raise self.error(where, f"`{name}` cannot be a robot's name (letters, digits, `_`, `-` and dots)")
            if not isinstance(entry or {}, dict) or any(key != "key" for key in entry or {}):
                raise self.error(where, f"`{where}` must be `{{key: BASE64}}`, got {entry!r}")
            robots[name] = self._key(where, name, (entry or {}).get("key"), insecure, robots)
        return robots

    def _key(self, where: str, name: str, key: object, insecure: bool, others: Mapping[str, str | None]) -> str | None:
        if key is not None and not isinstance(key, str):
            raise self.error(where, f"`{where}.key` must be text in base64, got {key!r}")
        if insecure:
            return key
        try:
            public_key(name, key)
        except KeyFileError as error:
            raise self.error(where, str(error)) from error
        for other, known in others.items():
            if known == key:
                raise self.error(where, f"`{name}` has the key of `{other}`; every robot needs its own")
        return key

    def _configuration(self, robots: Mapping[str, object]) -> Configuration:
        changes = {key: self.data[key] for key in SETTINGS if key in self.data}
        try:
            configuration = merge(Configuration(), changes, "")
        except ConfigurationError as error:
            what = str(error).removeprefix(": ")
            named = next((word for word in what.replace("`", " ").split() if word in self.lines), "")
            raise self.error(named, what) from error
        for name in configuration.antennas:
            if name not in (*robots, "default"):
                raise self.error(
                    f"antennas.{name}", f"`antennas` names an unknown robot `{name}`{nearest(name, robots)}"
                )
        return configuration

    def _network(self, robots: Mapping[str, object]) -> Network:
        section = self.data.get("transport") or {}
        if not isinstance(section, dict):
            raise self.error("transport", f"`transport` must be a mapping, got {section!r}")
        try:
            return read_network(section, robots, "")
        except ConfigurationError as error:
            raise self.error("transport", str(error).removeprefix(": ")) from error

    def _starts(self, robots: Mapping[str, object]) -> dict[str, Start]:
        """Known starts: `start: {r1: [x, y, theta]}`, `start_stamp: seconds`, of all or by robot."""
        poses, stamps = self.data.get("start") or {}, self.data.get("start_stamp")
        if not isinstance(poses, dict):
            raise self.error("start", f"`start` must map robots to [x, y, theta], got {poses!r}")
        if stamps is not None and not poses:
            raise self.error("start_stamp", "`start_stamp` needs `start`: the poses at that time")
        starts = {}
        for name, pose in poses.items():
            where = f"start.{name}"
            if name not in robots:
                raise self.error(where, f"`start` names an unknown robot `{name}`{nearest(str(name), robots)}")
            if not isinstance(pose, list) or len(pose) != 3 or not all(map(_number, pose)):
                raise self.error(where, f"`{where}` must be [x, y, theta] in m and rad, got {pose!r}")
            stamp = stamps.get(name) if isinstance(stamps, dict) else stamps
            if stamp is None or not _number(stamp):
                raise self.error(
                    "start_stamp" if stamps else where, f"`{where}` needs a `start_stamp`: when {name} stood there [s]"
                )
            x, y, theta = map(float, pose)
            starts[name] = Start(float(stamp), (x, y, theta))
            try:
                start_priors({name: starts[name]})
            except MeasurementError as error:
                raise self.error(where, str(error)) from error
        return starts


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
