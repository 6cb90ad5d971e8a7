"""team.yaml of a dgorl log: the robots, when they were carried, where they started, what they sense with."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dgorl.configuration import Configuration, as_dict, merge, nearest
from dgorl.errors import ConfigurationError, LogError, brief, quoted
from dgorl.logs.text import text_of
from dgorl.measurements import WORLD
from dgorl.plain_yaml import PlainYamlError, plain_yaml, yaml_text

SECTIONS = ("antennas", "radio", "ranging", "bearings", "motion")
"""Sections of the configuration a log may state about itself."""
LONGEST_NAME = 64
KEYS = ("robots", "epochs", "start", "start_stamp", *SECTIONS)


@dataclass(frozen=True)
class Team:
    """What team.yaml says. start is None where it says nothing of starts; start_stamp [s] by robot."""

    robots: tuple[str, ...]
    epochs: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    start: Mapping[str, tuple[float, float, float]] | None = None
    start_stamp: Mapping[str, float] = field(default_factory=dict)
    configuration: Mapping[str, Any] = field(default_factory=dict)
    lines: Mapping[str, int] = field(default_factory=dict, compare=False)
    """of its keys, in the file it was read from"""

    def epoch(self, robot: str, start: float) -> int:
        """The epoch of odometry that begins at ``start`` [s]: how often the robot was carried before."""
        return bisect_right(self.epochs.get(robot, ()), start)

    def carried_within(self, robot: str, start: float, end: float) -> bool:
        """Whether the robot was carried inside (start, end): such odometry belongs to no epoch."""
        return any(start < stamp < end for stamp in self.epochs.get(robot, ()))


def valid_name(name: object) -> bool:
    """A robot's name stands in CSV rows, file names and keys: up to 64 letters, digits, `_`, `-` and dots."""
    if not isinstance(name, str) or len(name) > LONGEST_NAME or name == WORLD:
        return False
    return re.fullmatch(r"\w[\w.-]*", name) is not None


def read_team(path: Path) -> Team:
    """Raises LogError with the line of the key that is wrong."""
    return _Reader(path).team()


def team_text(team: Team) -> str:
    """The YAML of a team; :func:`read_team` gives the same team back."""
    data: dict[str, Any] = {"robots": list(team.robots)}
    if team.epochs:
        data["epochs"] = {robot: list(stamps) for robot, stamps in team.epochs.items()}
    if team.start is not None:
        data["start"] = {robot: list(pose) for robot, pose in team.start.items()}
    if team.start_stamp:
        stamps = set(team.start_stamp.values())
        everyone = set(team.start_stamp) == set(team.start or {})
        data["start_stamp"] = stamps.pop() if len(stamps) == 1 and everyone else dict(team.start_stamp)
    data |= as_dict(dict(team.configuration))
    return yaml_text(data)


class _Reader:
    """One team.yaml, its values and the lines of its keys."""

    def __init__(self, path: Path) -> None:
        self.path = path
        text = text_of(path)
        try:
            self.data, node = plain_yaml(text)
        except PlainYamlError as error:
            raise LogError(path, error.line, str(error)) from error
        if not isinstance(self.data, dict):
            raise LogError(path, 1, "must say `robots: [r1, r2]` and may say more, got no mapping")
        self.lines: dict[str, int] = {}
        for name, line in key_lines(node, ""):
            if name in self.lines:
                raise LogError(path, line, f"`{name}` stands here twice (first in line {self.lines[name]})")
            self.lines[name] = line

    def team(self) -> Team:
        for key in self.data:
            if key not in KEYS:
                raise self.error(str(key), f"unknown key {quoted(key)}{nearest(str(key), KEYS)}")
        robots = self._robots()
        epochs = {name: self._stamps(name, value) for name, value in self._by_robot("epochs", robots).items()}
        start = None
        if "start" in self.data:
            start = {name: self._pose(name, value) for name, value in self._by_robot("start", robots).items()}
        stamps, configuration = self._start_stamp(robots, start), self._configuration(robots)
        return Team(robots, epochs, start, stamps, configuration, self.lines)

    def error(self, key: str, what: str) -> LogError:
        return LogError(self.path, self.lines.get(key), what)

    def _robots(self) -> tuple[str, ...]:
        robots = self.data.get("robots")
        if not isinstance(robots, list) or not robots:
            raise self.error("robots", "`robots` must list the robots' names, like [r1, r2]")
        for name in robots:
            if not valid_name(name):
                hint = "letters, digits, `_`, `-` and dots; quote what YAML takes for a number; not `world`"
                raise self.error("robots", f"{quoted(name)} cannot be a robot's name ({hint})")
            if robots.count(name) > 1:
                raise self.error("robots", f"robot `{name}` is listed twice")
        return tuple(robots)

    def _by_robot(self, key: str, robots: tuple[str, ...]) -> Mapping[str, Any]:
        values = self.data.get(key, {})
        if not isinstance(values, dict):
            raise self.error(key, f"`{key}` must map robots to values, got {values!r}")
        for name in values:
            if name not in robots:
                hint = f"{nearest(str(name), robots)}; the robots are {', '.join(robots)}"
                raise self.error(f"{key}.{name}", f"`{key}` names an unknown robot {quoted(name)}{hint}")
        return values

    def _number(self, key: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
            raise self.error(key, f"`{key}` must hold finite numbers, got {brief(repr(value))}")
        return float(value)

    def _stamps(self, robot: str, value: object) -> tuple[float, ...]:
        key = f"epochs.{robot}"
        if not isinstance(value, list):
            raise self.error(
                key, f"`{key}` must list the times the robot was carried, like [12.5], got {brief(repr(value))}"
            )
        stamps = tuple(self._number(key, stamp) for stamp in value)
        if list(stamps) != sorted(stamps):
            raise self.error(key, f"`{key}`: time runs backwards; sort the times")
        return stamps

    def _pose(self, robot: str, value: object) -> tuple[float, float, float]:
        key = f"start.{robot}"
        if not isinstance(value, list) or len(value) != 3:
            raise self.error(key, f"`{key}` must be [x, y, theta] in m and rad, got {brief(repr(value))}")
        x, y, theta = (self._number(key, number) for number in value)
        return x, y, theta

    def _start_stamp(self, robots: tuple[str, ...], start: Mapping[str, Any] | None) -> Mapping[str, float]:
        key = "start_stamp"
        if key not in self.data:
            return {}
        if start is None:
            raise self.error(key, "`start_stamp` needs `start`: the poses at that time")
        if not isinstance(self.data[key], dict):
            return dict.fromkeys(start, self._number(key, self.data[key]))
        return {name: self._number(f"{key}.{name}", value) for name, value in self._by_robot(key, robots).items()}

    def _configuration(self, robots: tuple[str, ...]) -> Mapping[str, Any]:
        configuration = {key: self.data[key] for key in SECTIONS if key in self.data}
        try:
            merge(Configuration(), configuration, "")
        except ConfigurationError as error:
            what = str(error).removeprefix(": ")
            named = next((word for word in re.findall(r"[\w.-]+", what) if word in self.lines), "")
            raise self.error(named, what) from error
        for name in configuration.get("antennas", {}):
            if name not in (*robots, "default"):
                raise self.error(f"antennas.{name}", f"`antennas` names an unknown robot {quoted(name)}")
        return configuration


def key_lines(node: yaml.Node | None, prefix: str) -> Iterator[tuple[str, int]]:
    """Dotted names of all keys with their lines."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            name = f"{prefix}{key.value}"
            yield name, key.start_mark.line + 1
            yield from key_lines(value, f"{name}.")
