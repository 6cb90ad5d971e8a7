"""Hours of a live team in minutes: does anything grow? One agent with its journal and 4 robots that tell, in memory.

    python benchmarks/soak.py --hours 2

Virtual time, 2 Hz, a tenth of all messages lost. Asked: memory, journal, CPU a tick are flat from the first half hour
to the end. ``--trace`` names the lines whose memory grew most since then (slow).
"""

from __future__ import annotations

import argparse
import gc
import os
import tracemalloc
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from virtual_team import VirtualTeam

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.evaluation.records import LOCATED
from dgorl.simulation import Scenario, simulate
from dgorl.team.faults import Faults

PERIOD = 0.5


def resident_mb() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--every", type=float, default=5.0, help="minutes between two lines")
    parser.add_argument("--begin", type=float, default=30.0, help="minutes after which all should be flat")
    parser.add_argument("--limit", type=float, default=8.0, help="size the journal may have [MB]")
    parser.add_argument("--loss", type=float, default=0.1)
    parser.add_argument("--trace", action="store_true")
    given = parser.parse_args()
    log = simulate(Scenario(area=30.0, steps=round(given.hours * 3600 / PERIOD), period=PERIOD))
    settings = merge(Configuration(), log.configuration, "the simulated log")
    lines, base = [], None
    with TemporaryDirectory() as folder:
        limit = int(given.limit * 1e6)
        team = VirtualTeam(log, settings, Path(folder), Faults(loss=given.loss, delay=(0.0, 0.2)), ("r1",), limit)
        if given.trace:
            tracemalloc.start(8)
        print("minutes  memory MB  journal MB  objects  CPU ms a tick  located")
        for k in range(1, round(given.hours * 60 / given.every) + 1):
            reports = [
                (1e3 * report.tick_s, sum(peer.status in LOCATED for peer in report.peers.values()))
                for report in team.run(k * given.every * 60)
            ]
            gc.collect()
            size = sum(path.stat().st_size for path in Path(folder).iterdir()) / 1e6
            spent, located = np.mean(reports, axis=0)
            lines.append((k * given.every, resident_mb(), size, float(len(gc.get_objects())), spent, located))
            print("{:7.1f}  {:9.1f}  {:10.2f}  {:7.0f}  {:13.2f}  {:7.2f}".format(*lines[-1]), flush=True)
            if given.trace and base is None and k * given.every >= given.begin:
                base = tracemalloc.take_snapshot()
        if base is not None:
            for grown in tracemalloc.take_snapshot().compare_to(base, "lineno")[:12]:
                print(grown)
        team.close()
    table = np.array(lines)
    flat = table[table[:, 0] >= min(given.begin, table[-1, 0] / 2)]
    for name, column in (("memory", 1), ("journal", 2), ("objects", 3), ("CPU a tick", 4)):
        slope = np.polyfit(flat[:, 0] / 60, flat[:, column], 1)[0] if len(flat) > 2 else np.nan
        change = 100 * (flat[-1, column] / flat[0, column] - 1)
        print(f"{name}: {change:+.1f} % from {flat[0, 0]:.0f} to {flat[-1, 0]:.0f} min, {slope:+.3g} an hour")


if __name__ == "__main__":
    main()
