"""A fleet of real agents that is fed by hand, so that things can be done to its network meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml

from dgorl.configuration import Configuration, merge
from dgorl.simulation import Scenario, simulate
from dgorl.team import fleet as fleets
from dgorl.team.agent_process import AgentProcess
from dgorl.team.fleet import Fleet

BEGINNING = frozenset({"epoch not live"})
"""What is rejected without anybody's fault: relays by a robot that is not admitted itself yet."""


def simulated(folder: Path, seconds: float, settle: float, rate: float = 1.0) -> Fleet:
    """Three robots with known starts."""
    log = simulate(Scenario(robots=3, steps=round(2 * seconds), area=20.0, sensors=("rssi", "range")))
    configuration = merge(Configuration(), log.configuration, "log")
    return Fleet(log, configuration, folder, log.starts, rate, settle=settle)


def prepare(fleet: Fleet, **transport: object) -> None:
    """Keys and team.yaml, with another ``transport`` section if one is given."""
    fleets.prepare(fleet)
    if transport:
        path = fleet.folder / "team.yaml"
        path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "transport": transport}))


@contextmanager
def agents(fleet: Fleet, command: Callable[[str], list[str]] | None = None) -> Iterator[dict[str, AgentProcess]]:
    """Its agents, ready to begin; none stays behind."""
    lives = {}
    try:
        for robot in fleet.log.robots:
            words = (command or fleet.command)(robot)
            lives[robot] = AgentProcess(words, fleet.reports(robot), fleet.messages(robot))
        for life in lives.values():
            life.ready()
        yield lives
    finally:
        for life in lives.values():
            life.kill()


def played(fleet: Fleet, lives: dict[str, AgentProcess], lead: float = 1.0) -> Iterator[float]:
    """Tell all agents what the log says as it passes, from ``lead`` [s] on; the log's time whenever a line was told.

    At its end wait until they have left, all of them well.
    """
    at = time.monotonic() + lead
    for life in lives.values():
        life.begin(at)
    for stamp, (robot, line) in fleets.in_order(fleet):
        fleets.wait(stamp, fleet, at)
        lives[robot].say(line)
        yield stamp
    for life in lives.values():
        life.no_more()
    deadline = at + (fleet.last + fleet.quiet - fleet.first) / fleet.rate + fleets.PATIENCE
    for robot, life in lives.items():
        assert life.leaves(deadline), fleet.messages(robot).read_text()
