"""Does the search find the best graph of the whole team? Cost of our best one beside the optimum found from the truth.

    python benchmarks/team_graph.py --trials 100

Simulator's default team, unknown starts, all data kept (window all), at step 100: the joined component where everybody
is joined, else the most probable hypothesis about the cluster that holds the team. Both it and the true poses are
starts of the same graph, of all readings between these robots, optimised until the last step is below 1e-9.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import repeat

import numpy as np

from dgorl import Configuration, Team
from dgorl.configuration import merge
from dgorl.evaluation.records import truth_at
from dgorl.expansion.cluster_graph import cluster_graph
from dgorl.measurements import known_at
from dgorl.nodes import Memo
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate
from dgorl.tracks import KEYFRAMES_PER_SECOND
from dgorl.window import Component

TIE = 1e-6
"""Costs that differ by less than this share are one optimum."""


def trial(seed: int, scenario: Scenario) -> Mapping[str, float]:
    """Costs of the best graph found and of the optimum from the truth, robots in it, and whether all are joined."""
    log = simulate(replace(scenario, seed=seed))
    configuration = replace(merge(Configuration(), log.configuration, "the simulated log"), window="all")
    team = Team(configuration)
    waiting = sorted(log.measurements, key=known_at)
    k, end = 0, scenario.steps * scenario.period
    for now in np.arange(scenario.period, end + 1.5, scenario.period):
        while k < len(waiting) and known_at(waiting[k]) <= now:
            team.add(waiting[k])
            k += 1
        team.update(float(now))
    node = team._memo.node(Memo.due(end + 1.0))
    candidates = list(node.components) + [c.hypotheses[0].component for c in node.clusters]
    best = max(candidates, key=lambda c: len(c.tracks))
    alone = Component(best.stretches, tuple(p for p in best.priors if p.gradient.any()))
    first = min(s.first for s in alone.stretches.values())
    graph = cluster_graph(team.history, alone, [(key,) for key in alone.tracks], first, node.stamp)
    truth = np.concatenate([_truth(log.truth, key.robot, alone.stretches[key].first, len(alone.stretches[key].poses),
                                   key.begin) for key in graph.keys])  # fmt: skip
    ours, theirs = (
        float(graph.graph.optimize(start[None], max_iterations=200).cost[0]) for start in (graph.start(alone), truth)
    )
    joined = any(len(c.tracks) == scenario.robots for c in node.components)
    return {"ours": ours, "truth": theirs, "robots": len(alone.tracks), "joined": float(joined)}


def _truth(truth: Mapping[str, Array], robot: str, first: int, count: int, begin: float) -> Array:
    stamps = np.maximum(np.arange(first, first + count) / KEYFRAMES_PER_SECOND, begin)
    return truth_at(truth, robot, stamps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--sensor", default="rssi", choices=("rssi", "range"))
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    scenario = Scenario(steps=given.steps, sensors=(given.sensor,))
    seeds = range(given.seed, given.seed + given.trials)
    with ProcessPoolExecutor(given.workers) as pool:
        found = list(pool.map(trial, seeds, repeat(scenario)))
    worse = [(s, t["ours"] - t["truth"]) for s, t in zip(seeds, found, strict=True)
             if t["ours"] > t["truth"] * (1 + TIE)]  # fmt: skip
    better = sum(t["ours"] < t["truth"] * (1 - TIE) for t in found)
    whole = sum(t["robots"] == scenario.robots for t in found)
    share = 100 * (1 - len(worse) / len(found))
    print(f"{given.trials} trials, step {given.steps}, {given.sensor}:")
    print(f"cost ≤ that of the optimum found from the truth in {share:.1f} % (required: ≥ 98); better in {better},")
    print(f"all robots in it in {whole}, all joined in {sum(t['joined'] for t in found):.0f}")
    for seed, difference in worse:
        print(f"  seed {seed}: cost {difference:.3f} above")


if __name__ == "__main__":
    main()
