"""The solver beside its peers: CPU time of a graph of 5 robots and 60 keyframes, to the same cost.

    pip install '.[peers]' cmeel-eigen
    python benchmarks/solver.py --graphs 20

Graphs of the paper's experiment, known starts; from the last node's poses extended by odometry, as
a tick starts, and from dead reckoning. Peers: g2o in C++ with a range edge (compiled once, half a minute), g2o from
Python with that edge in Python, GTSAM from Python. The paper's solver takes 10.2 ± 2.7 ms.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dgorl.evaluation.solvers import PEERS, compare_solvers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--graphs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the first graph")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--sensors", nargs="+", default=["rssi", "range"], choices=("rssi", "range"))
    parser.add_argument("--peers", nargs="*", default=list(PEERS), choices=tuple(PEERS))
    parser.add_argument("--json", type=Path, help="write all rows here")
    given = parser.parse_args()
    table = compare_solvers(given.graphs, given.seed, given.sensors, given.peers, given.repeats)
    print(table.text())
    print(f"CPU ms, medians over {given.graphs} graphs; ± std and the paper's 10.2 ± 2.7 ms are of optimise alone;")
    print("reached: graphs on which it finds the best optimum known; off by: largest relative distance from its cost")
    if given.json:
        given.json.write_text(json.dumps(table.as_dict(), indent=1))


if __name__ == "__main__":
    main()
