"""Teams too large to be searched at once, from a cold start: what a node and a tick cost, who is located, how honestly.

    python benchmarks/large_teams.py --robots 50 --area 100 --seeds 3
    python benchmarks/large_teams.py --robots 20 --area 63 --nlos 0.3 --seeds 3

Nobody knows a start, and links reach 25 m: at these densities a robot hears about ten others. One team is taken from
node to node, each once its data is there, with one tick after it; CPU times are of the process, Python included. The
peak of memory is the process's, earlier trials included. Located and wrong (off by more than 5σ and 2 m) count as in
`unknown.py`, of what a few robots spread over the team see in the tick after each node.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dgorl import Configuration, Team, se2
from dgorl.configuration import merge
from dgorl.estimate import Estimate
from dgorl.evaluation.metrics import CHI2_95_2DOF
from dgorl.evaluation.records import truth_at
from dgorl.expansion.step import SPACING
from dgorl.logs.log import Log
from dgorl.measurements import known_at
from dgorl.nodes import DELAY
from dgorl.simulation import Scenario, simulate

EGOS = 5
"""Robots whose view is judged."""
NEAR, SIGMAS = 2.0, 5.0
"""An estimate is wrong farther off than this many metres and σ."""
LOCATED = ("position", "tracked")


@dataclass(frozen=True)
class Peer:
    """A peer as one robot saw it: error [m] and σ [m] of a located one, whether it was inside the 95 % ellipse."""

    located: bool
    error: float = 0.0
    sigma: float = 0.0
    inside: bool = False

    @property
    def wrong(self) -> bool:
        return self.error > max(NEAR, SIGMAS * self.sigma)


@dataclass(frozen=True)
class Row:
    """One node: stamp [s], CPU of it and of the tick after it [s], tracks of the largest component, peers seen."""

    stamp: float
    node_s: float
    tick_s: float
    largest: int
    peers: Sequence[Peer]


def nodes(scenario: Scenario) -> Iterator[Row]:
    """A team from node to node."""
    log = simulate(scenario)
    team = Team(merge(Configuration(), log.configuration, "the simulated log"))
    waiting = sorted(log.measurements, key=known_at, reverse=True)
    egos = log.robots[:: max(len(log.robots) // EGOS, 1)][:EGOS]
    for g in np.arange(SPACING, scenario.steps * scenario.period - DELAY + 1e-9, SPACING):
        now = float(g + DELAY)
        while waiting and known_at(waiting[-1]) <= now:
            team.add(waiting.pop())
        began = time.process_time()
        while team.prepare(now):
            continue
        reached = time.process_time()
        state = team.update(now)
        done = time.process_time()
        largest = max((len(joined.members) for joined in state.joined), default=0)
        peers = [peer for ego in egos for peer in seen(log, ego, team.view(ego, state, now), now)]
        yield Row(float(g), reached - began, done - reached, largest, peers)


def seen(log: Log, ego: str, estimate: Estimate, now: float) -> Iterator[Peer]:
    """Every peer beside the truth."""
    at = {robot: truth_at(log.truth, robot, np.array([now]))[0] for robot in log.robots}
    for name in log.robots:
        peer = estimate.get(name)
        if name == ego:
            continue
        if peer is None or peer.pose is None or str(peer.status) not in LOCATED:
            yield Peer(False)
            continue
        off = (peer.pose - se2.between(at[ego], at[name]))[:2]
        covariance = peer.covariance[:2, :2]
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        inside = bool(off @ np.linalg.solve(covariance, off) <= CHI2_95_2DOF)
        yield Peer(True, float(np.hypot(*off)), sigma, inside)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--area", type=float, default=100.0)
    parser.add_argument("--comm-range", type=float, default=25.0)
    parser.add_argument("--sensor", default="range", choices=("rssi", "range"))
    parser.add_argument("--nlos", type=float, default=0.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    given = parser.parse_args()
    rows: list[Row] = []
    for seed in range(given.seed, given.seed + given.seeds):
        steps = int(given.seconds / 0.5) + 2
        scenario = Scenario(robots=given.robots, area=given.area, sensors=(given.sensor,), steps=steps,
                            nlos=given.nlos, comm_range=given.comm_range, seed=seed)  # fmt: skip
        print(f"seed {seed}\n  node    CPU   tick  joined  located  wrong")
        for row in nodes(scenario):
            rows.append(row)
            share = 100 * np.mean([peer.located for peer in row.peers])
            wrong = sum(peer.wrong for peer in row.peers)
            spent = f"{row.stamp:4.0f} s {row.node_s:4.2f} s {row.tick_s:4.2f} s"
            print(f"{spent} {row.largest:7d} {share:6.1f} % {wrong:6d}", flush=True)
    report(rows)


def report(rows: Sequence[Row]) -> None:
    """The figures of all trials together."""
    spent, ticks = [row.node_s for row in rows], [row.tick_s for row in rows]
    peers = [peer for row in rows for peer in row.peers]
    located = [peer for peer in peers if peer.located]
    print(f"node: median {np.median(spent):.2f} s, largest {max(spent):.2f} s CPU")
    print(f"tick: median {np.median(ticks):.2f} s, largest {max(ticks):.2f} s CPU")
    print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    print(f"located: {100 * len(located) / len(peers):.1f} % of all")
    if located:
        print(f"wrong: {100 * np.mean([peer.wrong for peer in located]):.2f} % of the located")
        print(f"RMSE: {np.sqrt(np.mean([peer.error**2 for peer in located])):.2f} m")
        print(f"inside the 95 % ellipse: {100 * np.mean([peer.inside for peer in located]):.1f} %")


if __name__ == "__main__":
    main()
