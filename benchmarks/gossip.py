"""Bytes and delays of gossip, simulated: how large bundles are, what a robot sends, how long bundles take.

Usage: python benchmarks/gossip.py [--robots 5 10 20] [--topology full line ring] [--loss 0.0] [--seconds 20]

Every robot sends at 2 Hz five twists of 0.1 s and an RSSI of each robot it hears, signed; messages take 10 to 30 ms.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.team_network import Network

from dgorl.team.faults import Faults, topology

WARM = 10.0
"""Time to meet before anything is measured [s]."""


def measured(count: int, shape: str, loss: float, seconds: float) -> str:
    """One row of the table."""
    names = [f"r{k + 1}" for k in range(count)]
    faults = Faults(loss=loss, delay=(0.01, 0.03), reaches=topology(shape, names))
    network = Network(count, faults, signed=True)
    network.start(*names)
    network.run(WARM)
    before = {name: robot.air.traffic.sent_bytes for name, robot in network.robots.items()}
    began = time.process_time()
    network.run(seconds)
    cpu = (time.process_time() - began) / seconds / count
    sent = [(r.air.traffic.sent_bytes - before[name]) / seconds for name, r in network.robots.items()]
    sizes = [len(s.data) for r in network.robots.values() for s in r.journal.values() if s.bundle.robot == r.name]
    took = [
        stamp - robot.journal[name].bundle.cut
        for robot in network.robots.values()
        for name, stamp in robot.arrivals.items()
        if name.robot != robot.name and robot.journal[name].bundle.cut > WARM
    ]
    median, late = np.quantile(took, [0.5, 0.95])
    equal = network.until_equal(60.0)
    return (
        f"| {count} | {shape} | {loss:.0%} | {np.mean(sizes):.0f} | {np.mean(sent):.0f} | {max(sent):.0f} "
        f"| {median:.2f} / {late:.2f} | {equal:.1f} | {1e3 * cpu:.0f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[5, 10, 20])
    parser.add_argument("--topology", nargs="+", default=["full", "line", "ring"], choices=["full", "line", "ring"])
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0])
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    columns = "robots", "topology", "loss", "bytes/bundle", "sent B/s", "most", "s 50/95 %", "equal after s", "CPU ms/s"
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for count in options.robots:
        for shape in options.topology:
            for loss in options.loss:
                print(measured(count, shape, loss, options.seconds), flush=True)


if __name__ == "__main__":
    main()
