"""How fast the team agrees: the paper's regularised primal–dual with consensus, beside gossip of the measurements.

    pip install '.[plot]'
    python benchmarks/convergence.py --out out/convergence

The simulator's default team, RSSI of 2 dB, 6 keyframes each, starts known to 1.5 m and 0.1 rad, on a ring of which
30 % of the links fail in every round, in both directions. Costs are linearised at the core's optimum under a disc that
binds, so that is their optimum; robots start from dead reckoning. Figure (PNG and PDF): relative cost gap of the
projected running mean and violation of the running mean [m], worst robot, over K, beside K^−¼. Table: rounds until the
worst robot is within a share of the optimum's cost, without the disc.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dgorl import Configuration, se2
from dgorl.configuration import Limits, merge
from dgorl.history import History
from dgorl.limits import constraints
from dgorl.optimization.lagrangian import constrained
from dgorl.optimization.solver import solve
from dgorl.replay import known_starts
from dgorl.se2 import Array
from dgorl.simulation import Scenario, simulate
from dgorl.team.local_costs import LocalCost, local_costs, preconditioned
from dgorl.team.primal_dual import PrimalDual, Schedule, smallest_regularisation
from dgorl.window import Window, assemble, grow

NOBODY = np.zeros(0, np.int64)
KEYFRAMES = 6
START_SIGMA = np.array([1.5, 1.5, 0.1])
"""Of known starts [m, m, rad]."""
TIGHT = 0.97
"""Radius of the disc, in shares of the one that just holds the plain optimum."""
STEP = 0.3
"""a, in coordinates in which the team's mean Hessian is near the identity. A longer one raises γ and the violation."""
FREE_STEPS = (0.3, 1.0, 3.0)
"""Without the disc there is no violation to raise: the best of these."""
RADIUS = 1e3
"""Of the ball B, in those coordinates."""
LOSS = 0.3

Team = Sequence[PrimalDual]


@dataclass(frozen=True)
class Agreement:
    """What each robot knows, in common coordinates whose optimum is 0, where they start, and the optimum's cost."""

    costs: tuple[LocalCost, ...]
    start: Array
    optimum: float

    def gap(self, z: Array) -> float:
        """Relative distance from the optimum's cost."""
        return sum(cost.value(z) for cost in self.costs) / self.optimum - 1


def window(robots: int, seed: int) -> Window:
    """A short window with uncertain starts."""
    steps = KEYFRAMES - 1
    log = simulate(Scenario(robots=robots, steps=steps, seed=seed))
    history = History(merge(Configuration(), log.configuration, "the simulated log"))
    for measurement in [*known_starts(log), *log.measurements]:
        history.add(measurement)
    history.admit(steps / 2, node_due=True)
    (component,) = grow(history, (), 0.0, steps / 2)
    found = assemble(history, component, 0.0, steps / 2, None)
    known = found.problem.relative_poses
    assert known is not None
    off = np.random.default_rng([seed, robots]).normal(0.0, START_SIGMA, known.delta.shape)
    delta, initial = se2.compose(known.delta, off), np.array(found.problem.initial)
    for start, T_w_r in zip(known.j, delta, strict=True):
        track = slice(start, start + KEYFRAMES)
        initial[track] = se2.compose(T_w_r, se2.between(initial[start], initial[track]))
    information = np.tile(np.diag(START_SIGMA**-2), (robots, 1, 1))
    weak = replace(known, delta=delta, information=information)
    return replace(found, problem=replace(found.problem, initial=initial, relative_poses=weak))


def agreement(robots: int, seed: int, bound: bool = True) -> Agreement:
    """The window's constrained optimum by the core, and the same problem cut into what each robot knows."""
    given = window(robots, seed)
    problem = given.problem
    free = ~problem.fixed
    plain = solve(problem, NOBODY, 1e-9)
    positions = plain.poses[free, :2]
    middle = positions.mean(axis=0)
    limit = (TIGHT if bound else 1e3) * float(np.linalg.norm(positions - middle, axis=1).max())
    disc = constraints(Limits(disc=(*middle.tolist(), limit)), given)
    best = constrained(problem, disc, NOBODY, 1e-9).solution
    owner = np.full(len(problem.initial), -1)
    for robot, (offset, _, count) in enumerate(given.layout.values()):
        owner[offset : offset + count] = robot
    costs = local_costs(problem, best.poses, owner, (float(middle[0]), float(middle[1])), limit)
    costs = preconditioned(costs, owner[free])
    reckoned = se2.between(best.poses, problem.initial)[free].ravel()
    return Agreement(costs, np.linalg.solve(costs[0].scale, reckoned), best.cost)


def ring(robots: int) -> list[tuple[int, int]]:
    return sorted({(min(k, (k + 1) % robots), max(k, (k + 1) % robots)) for k in range(robots)})


def primal_dual(
    problem: Agreement,
    rounds: int,
    rng: np.random.Generator,
    step: float = STEP,
    stop: Callable[[Team], bool] = lambda team: False,
) -> tuple[Team, int]:
    """The team after K rounds on the ring, or earlier, when ``stop`` says so, and the rounds taken."""
    regularisation = smallest_regularisation(problem.costs[0])
    schedule = Schedule(rounds, step, regularisation, RADIUS)
    team = [PrimalDual(f"r{k + 1:02d}", cost, problem.start, schedule) for k, cost in enumerate(problem.costs)]
    links = ring(len(team))
    for k in range(rounds):
        shares = [robot.send(k) for robot in team]
        for i, j in links:
            if rng.random() >= LOSS:
                team[i].receive(shares[j], k)
                team[j].receive(shares[i], k)
        for robot in team:
            robot.step()
        if stop(team):
            return team, k + 1
    return team, rounds


def errors(problem: Agreement, team: Team) -> tuple[float, float]:
    """Of the worst robot: cost gap of the projected mean, violation of the mean [m]."""
    gap = max(abs(problem.gap(robot.output)) for robot in team)
    return gap, max(0.0, *(float(cost.bounds(r.mean).max()) for cost, r in zip(problem.costs, team, strict=True)))


def slope(rounds: Sequence[int], values: Sequence[float]) -> float:
    """Of log value over log K."""
    return float(np.polyfit(np.log(rounds), np.log(values), 1)[0])


def gossip(robots: int, rng: np.random.Generator) -> int:
    """Rounds until everybody has everybody's measurements; each solves the same graph then, exactly."""
    held = np.eye(robots, dtype=bool)
    links, rounds = ring(robots), 0
    while not held.all():
        before, rounds = held.copy(), rounds + 1
        for i, j in links:
            if rng.random() >= LOSS:
                held[i] |= before[j]
                held[j] |= before[i]
    return rounds


def rounds_to(problem: Agreement, share: float, most: int, rng: np.random.Generator) -> int | None:
    """The fewest rounds of any schedule K = 100 · 4^m ≤ most after which the worst robot's mean is within ``share``."""

    def near(team: Team) -> bool:
        return all(abs(problem.gap(robot.mean)) <= share for robot in team)

    best = None
    for planned in (100 * 4**m for m in range(10) if 100 * 4**m <= most):
        for step in FREE_STEPS:
            team, taken = primal_dual(problem, planned, rng, step, near)
            if near(team):
                best = min(taken, best or taken)
    return best


def draw(rounds: Sequence[int], gaps: Array, violations: Array, path: Path) -> None:
    from dgorl.plotting.style import ROBOTS, TRUTH, picture

    with picture(path, 5.2, 3.6) as figure:
        axes = figure.subplots()
        for values, color, label in (
            (gaps, ROBOTS[0], "cost gap of the projected mean"),
            (violations, ROBOTS[1], "violation of the mean [m]"),
        ):
            middle = np.median(values, axis=0)
            fitted = slope(rounds, middle.tolist())
            axes.loglog(rounds, middle, "o-", color=color, label=f"{label}, slope {fitted:.2f}".replace("-", "−"))
            axes.fill_between(rounds, values.min(axis=0), values.max(axis=0), color=color, alpha=0.15, linewidth=0)
        top = float(np.median(violations, axis=0)[0]) * 1.3
        axes.loglog(rounds, top * (np.array(rounds) / rounds[0]) ** -0.25, "--", color=TRUTH, label="$K^{-1/4}$")
        axes.set_xlabel("rounds K")
        axes.set_ylabel("gap, violation of the worst robot")
        axes.set_title("Regularised primal–dual with consensus")
        axes.legend()
        figure.tight_layout()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path.with_suffix(".pdf"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--most", type=int, default=6400, help="rounds K of the longest run")
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--gossip", type=int, nargs="*", default=[5, 20], help="rings to count rounds of gossip on")
    parser.add_argument("--table", type=int, nargs="*", default=[5], help="rings to count rounds of primal–dual on")
    parser.add_argument("--table-most", type=int, default=1600, help="rounds K of the longest schedule there")
    parser.add_argument("--out", type=Path, default=Path("out/convergence"))
    given = parser.parse_args()
    rounds = [100 * 2**m for m in range(int(np.log2(max(given.most, 100) / 100)) + 1)]
    found = np.empty((given.trials, len(rounds), 2))
    for trial in range(given.trials):
        problem = agreement(given.robots, given.seed + trial)
        for column, planned in enumerate(rounds):
            team, _ = primal_dual(problem, planned, np.random.default_rng([given.seed + trial, planned]))
            found[trial, column] = errors(problem, team)
    for name, values in (("cost gap", found[..., 0]), ("violation [m]", found[..., 1])):
        middle = np.median(values, axis=0)
        shown = ", ".join(f"{k}: {value:.3g}" for k, value in zip(rounds, middle, strict=True))
        print(f"{name}, median of {given.trials} trials: {shown}; slope {slope(rounds, middle.tolist()):.2f}")
    path = given.out / "convergence.png"
    draw(rounds, found[..., 0], found[..., 1], path)
    print(f"Pictures: {path} and {path.with_suffix('.pdf').name}")
    for robots in given.gossip:
        rng = np.random.default_rng([given.seed, robots])
        told = np.median([gossip(robots, rng) for _ in range(1000)])
        print(f"ring of {robots}: gossip is exact after {told:g} rounds (median of 1000)")
    for robots in given.table:
        problem, rng = agreement(robots, given.seed, bound=False), np.random.default_rng([given.seed, robots])
        for share in (0.01, 0.0001):
            taken = rounds_to(problem, share, given.table_most, rng)
            print(f"ring of {robots}: primal–dual within {share:.2%} after", taken or f"more than {given.table_most}")


if __name__ == "__main__":
    main()
