"""A real agent while a stranger floods its network: CPU, memory, ticks, what was counted, whether peers are heard.

    python benchmarks/flood.py [--rate 10000] [--seconds 15]

One phase after another, with a rest between them; the agent goes on. CPU is a share of a core. Lag: from a tick to its
published estimate. Age: how long ago a peer measured the newest that the estimate holds. A flood under a member's name
drowns that member where it is heard, and its bundles come through others; under all names it drowns all.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from math import inf
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np
from real_agent import ROBOT, Cost, Measured, Scene, among_others, by_thread, lags, spent

from dgorl.team.keys import generate
from dgorl.team.messages import Digest, write
from dgorl.team.report import Report
from dgorl.team.team_file import TeamFile
from dgorl.team.zenoh_transport import open_session

REST = 4.0
"""Between two phases [s]."""
WARM = 8.0
"""Before the first [s]."""
BEGIN = 1.5
"""The stranger starts meanwhile [s]."""
GARBAGE = 200
"""Bytes of a message of garbage."""
DIFFERENT = 500
"""So many different messages are sent, over and over."""
COLUMNS = (
    "phase", "arrived /s", "CPU", "RSS, before → most, MB", "lag, median, 99 %, ms", "ticks", "age, median, 99 %, s",
    "rejected /s", "dropped /s",
)  # fmt: skip
Flood = list[tuple[str, bytes]]
"""Keys and payloads, sent in turn."""


def garbage(team: TeamFile, names: Sequence[str]) -> Flood:
    """Nothing that could be read."""
    random = Random(1)
    channels = cycle(("digest", "requests", "bundles"))
    return [
        (f"dgorl/{team.team}/{name}/{channel}", random.randbytes(GARBAGE))
        for _, name, channel in zip(range(DIFFERENT), cycle(names), channels, strict=False)
    ]


def forged(team: TeamFile, names: Sequence[str]) -> Flood:
    """Well made digests, newer than any, not signed by whom they are said to be of: all checks are needed."""
    key = generate()
    flood = []
    for number, name in zip(range(DIFFERENT), cycle(names), strict=False):
        head = (team.team, name, 1, 1e6 + number, number % 128, team.configuration_hash)
        flood.append((f"dgorl/{team.team}/{name}/digest", write(Digest(*head, [], [ROBOT]), key)))
    return flood


def phases(team: TeamFile) -> dict[str, Flood]:
    """What is sent in each; nothing in the first."""
    others = [robot for robot in team.robots if robot != ROBOT]
    return {
        "no flood": [],
        "garbage as r2": garbage(team, ["r2"]),
        "forged as r2": forged(team, ["r2"]),
        "forged as unknown r9": forged(team, ["r9"]),
        "forged as its own": forged(team, [ROBOT]),
        "forged as all others": forged(team, others),
    }


def flooding(endpoint: str, flood: Flood, rate: float, seconds: float) -> None:
    """Send at a rate [1/s], in bursts of 10 ms."""
    settings = {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }
    sent, messages = 0, cycle(flood)
    with open_session(settings) as session:
        began = time.monotonic()
        while (passed := time.monotonic() - began) < seconds:
            while flood and sent < rate * passed:
                session.put(*next(messages))
                sent += 1
            time.sleep(0.01)


@dataclass(frozen=True)
class Moment:
    """The agent's costs and counters at a time of the log [s]."""

    stamp: float
    cost: Cost
    report: Report


def now(agent: Measured) -> Moment:
    """Counters as of the last tick."""
    return Moment(agent.log_time(), agent.cost(), agent.said[-1].report)


def flooded(agent: Measured, flood: Flood, rate: float, seconds: float) -> tuple[Moment, Moment, float]:
    """The moments before and after a flood, and the most memory in between [MB]."""
    endpoint = TeamFile.read(agent.fleet.folder / "team.yaml").transport.addresses[ROBOT]
    stranger = multiprocessing.get_context("spawn").Process(
        target=flooding, args=(endpoint, flood, rate, seconds), daemon=True
    )
    stranger.start()
    time.sleep(BEGIN)
    before, most = now(agent), 0.0
    until = time.monotonic() + seconds - BEGIN
    while time.monotonic() < until:
        most = max(most, agent.rss())
        time.sleep(0.1)
    after = now(agent)
    stranger.join()
    return before, after, most


def arrived(report: Report) -> int:
    """Messages so far, those the full inbox dropped included."""
    return report.traffic.received_messages + report.traffic.dropped


def row(agent: Measured, name: str, before: Moment, after: Moment, most: float) -> list[str]:
    """Cells of the table."""
    seconds = after.cost.at - before.cost.at
    ticked = after.report.stamp - before.report.stamp
    a, b = before.report, after.report
    said = agent.during(before.stamp, after.stamp)
    ages = [p.age for one in said for n, p in one.report.peers.items() if n in agent.fleet.log.robots]
    rejected = Counter(b.rejected)
    rejected.subtract(a.rejected)
    return [
        name,
        f"{(arrived(b) - arrived(a)) / ticked:.0f}",
        f"{spent(before.cost, after.cost):.1%} ({by_thread(before.cost, after.cost)})",
        f"{before.cost.rss:.1f} → {most:.1f}",
        "{:.0f}, {:.0f}".format(*np.quantile(lags(said), (0.5, 0.99))),
        f"{len(said)} of {seconds / agent.fleet.configuration.period:.0f}",
        "{:.1f}, {:.1f}".format(*np.quantile([inf if age is None else age for age in ages], (0.5, 0.99))),
        ", ".join(f"{reason} {count / ticked:.0f}" for reason, count in rejected.most_common() if count) or "–",
        f"{(b.traffic.dropped - a.traffic.dropped) / ticked:.0f}",
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=10_000.0)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--only", nargs="+", metavar="PHASE", help="instead of all")
    given = parser.parse_args()
    with TemporaryDirectory() as folder, among_others(Scene(Path(folder), 15 * (given.seconds + REST))) as agent:
        time.sleep(max(agent.fleet.first + WARM - agent.log_time(), 0.0))
        load = os.getloadavg()[0]
        print(f"{given.rate:.0f} messages/s for {given.seconds:.0f} s each; load of the machine {load:.1f}\n")
        print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
        for name, flood in phases(TeamFile.read(Path(folder) / "team.yaml")).items():
            if given.only and name not in given.only:
                continue
            print(f"| {' | '.join(row(agent, name, *flooded(agent, flood, given.rate, given.seconds)))} |", flush=True)
            time.sleep(REST)
        time.sleep(REST)
        last = agent.said[-1].report
        ages = [peer.age for name, peer in last.peers.items() if name in agent.fleet.log.robots]
        print(f"\nAfterwards: {agent.rss():.1f} MB, lag {lags(agent.said[-4:]).max():.0f} ms, ages {ages}")


if __name__ == "__main__":
    main()
