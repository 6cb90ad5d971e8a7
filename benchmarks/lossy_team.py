"""Nine of ten messages are lost: what is left of the estimates? The real gossip and agents, in virtual time.

    python benchmarks/lossy_team.py --trials 3

Every trial runs one simulated team of 5 twice in memory, without loss and with it; every robot is an agent with its own
journal. Asked: peers are located in at least 0.8 times as many ticks as without loss, at least 90 % of the located lie
inside their 95 % ellipse, and ``age`` says how old what is known of a peer is.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from virtual_team import VirtualTeam

from dgorl import Configuration, se2
from dgorl.configuration import merge
from dgorl.evaluation.metrics import CHI2_95_2DOF
from dgorl.evaluation.records import LOCATED, truth_at
from dgorl.logs.log import Log
from dgorl.simulation import Scenario, simulate
from dgorl.team.faults import Faults
from dgorl.team.journal_data import parse

SKIPPED = 5.0
"""The first seconds do not count. With nine of ten lost it takes 3 to 6 s until all have admitted all."""


@dataclass(frozen=True)
class Seen:
    """Of all ticks and pairs: located, inside the 95 % ellipse (of the located), RMSE [m], ages [s], and how far an
    age is off: from the newest bundle of the peer's the estimate was made of, cut at every tick."""

    located: float
    inside: float
    rmse: float
    ages: tuple[float, float]
    age_off: float
    tick_ms: float


def watched(log: Log, faults: Faults, until: float, skipped: float = SKIPPED) -> Seen:
    """A team in virtual time under these faults, starts known as the log says; ticks count from ``skipped`` [s] on."""
    configuration = merge(Configuration(), log.configuration, "the simulated log")
    located, squares, normal, ages, off, spent = [], [], [], [], [], []
    with TemporaryDirectory() as folder:
        team = VirtualTeam(log, configuration, Path(folder), faults, log.robots)
        for report in team.run(until):
            spent.append(1e3 * report.tick_s)
            if report.stamp <= skipped:
                continue
            newest = {robot: list(ranges)[-1][1] for (robot, _), ranges in parse(report.data).items()}
            for name in log.robots:
                if name == report.robot:
                    continue
                peer = report.peers.get(name)
                known = peer is not None and peer.status in LOCATED
                located.append(known)
                if peer is not None and peer.age is not None and name in newest:
                    ages.append(peer.age)
                    cut = (newest[name] + 1) * configuration.period
                    off.append(peer.age - (report.stamp - cut))
                if not known or peer is None or peer.pose is None or peer.covariance is None:
                    continue
                stamp = np.array([report.stamp])
                mine, other = (truth_at(log.truth, robot, stamp)[0] for robot in (report.robot, name))
                error = np.array(peer.pose[:2]) - se2.between(mine, other)[:2]
                xx, xy, _, yy, _, _ = peer.covariance
                squares.append(float(error @ error))
                normal.append(float(error @ np.linalg.solve([[xx, xy], [xy, yy]], error)))
        team.close()
    return Seen(
        float(np.mean(located)),
        float(np.mean(np.array(normal) <= CHI2_95_2DOF)),
        float(np.sqrt(np.mean(squares))),
        (float(np.median(ages)), float(np.max(ages))),
        float(np.max(np.abs(off))),
        float(np.mean(spent)),
    )


def trial(seed: int, steps: int, loss: float, sensor: str, robots: int = 5) -> tuple[Seen, Seen]:
    """One team without and with loss."""
    log = simulate(Scenario(robots=robots, area=30.0, steps=steps, seed=seed, sensors=(sensor,)))
    until = steps * 0.5
    return watched(log, Faults(), until), watched(log, Faults(seed=seed, loss=loss), until)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--steps", type=int, default=240)
    parser.add_argument("--loss", type=float, default=0.9)
    parser.add_argument("--sensor", default="rssi", choices=("rssi", "range"))
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    one = partial(trial, steps=given.steps, loss=given.loss, sensor=given.sensor)
    with ProcessPoolExecutor(given.workers) as pool:
        pairs = list(pool.map(one, range(given.seed, given.seed + given.trials)))
    for name, seen in (("no loss", [p[0] for p in pairs]), (f"{100 * given.loss:.0f} % loss", [p[1] for p in pairs])):
        print(
            f"{name:9} located {np.mean([s.located for s in seen]):.3f}"
            f"  inside the 95 % ellipse {100 * np.mean([s.inside for s in seen]):.1f} %"
            f"  RMSE {np.sqrt(np.mean([s.rmse**2 for s in seen])):.2f} m"
            f"  age median {np.median([s.ages[0] for s in seen]):.1f} s, most {max(s.ages[1] for s in seen):.1f} s"
            f" (off by at most {max(s.age_off for s in seen):.2f} s)  tick {np.mean([s.tick_ms for s in seen]):.1f} ms"
        )
    share = np.mean([p[1].located for p in pairs]) / np.mean([p[0].located for p in pairs])
    print(f"located with loss ÷ without: {share:.3f} (required: 0.8)")


if __name__ == "__main__":
    main()
