"""What one live agent costs: CPU, memory, how long after a tick its estimate is out. A real process, 5 robots, 2 Hz.

    python benchmarks/live_agent.py [--seconds 60] [--warm 30] [--robots 5] [--sensors rssi,range]

The first ``--warm`` seconds do not count: the start, and windows that are not full yet. Asked: at most 5 % of a core,
80 MB, and 25 ms from a tick to its estimate, 99 of 100 times. On a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from real_agent import Scene, among_others, by_thread, lags, spent

ASKED_CPU, ASKED_MB, ASKED_MS = 0.05, 80.0, 25.0
LOCATED = ("position", "tracked")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--warm", type=float, default=30.0)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--sensors", default="rssi,range")
    parser.add_argument("--twists", action="store_true", help="odometry every 0.1 s, not one row a step")
    parser.add_argument("--latency", type=float, default=0.0, help="sensors tell so late [s]")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        seconds, sensors = given.warm + given.seconds + 1.0, tuple(given.sensors.split(","))
        scene = Scene(Path(folder), seconds, given.robots, sensors, given.twists, given.latency)
        with among_others(scene) as agent:
            fleet = agent.fleet
            begin, end = fleet.first + given.warm, fleet.first + given.warm + given.seconds
            time.sleep(max(begin - agent.log_time(), 0.0))
            before, most = agent.cost(), 0.0
            while agent.log_time() < end:
                most = max(most, agent.rss())
                time.sleep(min(0.25, max(end - agent.log_time(), 0.0)))
            after = agent.cost()
            time.sleep(0.3)
            said = agent.during(begin, end)
    delay, ticks = lags(said), 1e3 * np.array([one.report.tick_s for one in said])
    due = round(given.seconds / fleet.configuration.period)
    peers = [peer for one in said for name, peer in one.report.peers.items() if name in fleet.log.robots]
    located = np.mean([peer.status in LOCATED for peer in peers])
    age = [np.inf if peer.age is None else peer.age for peer in peers]
    p50, p99 = np.quantile(delay, (0.5, 0.99))
    rows = [
        ("CPU, share of a core", f"{ASKED_CPU:.0%}", f"{spent(before, after):.1%}"),
        ("... by thread", "–", by_thread(before, after)),
        ("memory, RSS, most", f"{ASKED_MB:.0f} MB", f"{most:.1f} MB"),
        ("tick to published estimate, median", "–", f"{p50:.1f} ms"),
        ("... 99 %", f"{ASKED_MS:.0f} ms", f"{p99:.1f} ms, most {delay.max():.1f} ms"),
        ("CPU of an estimate, median, 99 %", "–", "{:.1f}, {:.1f} ms".format(*np.quantile(ticks, (0.5, 0.99)))),
        ("ticks made", "all", f"{len(said)} of {due}"),
        ("peers located; age of what they told, median, 99 %", "–",
         "{:.1%}; {:.1f}, {:.1f} s".format(located, *np.quantile(age, (0.5, 0.99)))),
        ("threads; load of the machine", "–", f"{sum(1 for _ in after.threads)} kinds; {os.getloadavg()[0]:.1f}"),
    ]  # fmt: skip
    odometry = "odometry at 10 Hz" if given.twists else "a row of odometry a step"
    print(
        f"{given.robots} robots, {given.sensors}, {odometry}, "
        f"sensors {1e3 * given.latency:.0f} ms late; {given.seconds:.0f} s\n"
    )
    print("| what | asked | measured |\n|---|---|---|")
    for row in rows:
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
