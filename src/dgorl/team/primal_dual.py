"""min Σ f_i s.t. c ≤ 0 by consensus on x and μ: the paper's regularised Lagrangian, distributed. METHOD §5, §6.

y_i = Σ A_ij x_j, ν_i = Σ A_ij μ_j; x_i⁺ = Π_B[y_i − α (∇f_i(y_i) + ν_iᵀ∇c(y_i))];
μ_i⁺ = max(0, (1 − αγ) ν_i + α c(y_i)); α = a/√K, γ = δα. The output after K rounds is the running mean, projected once
onto the bounds: its cost and the mean's violation are off by O(K^−¼). After Yuan, Ho and Xu, Regularized primal–dual
subgradient method for distributed constrained optimization (IEEE Trans. Cybernetics 46(9), 2016). A reference: gossip
of the measurements themselves gives the exact optimum in as many rounds as the team is wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dgorl.se2 import Array
from dgorl.team.consensus import Averager, Share
from dgorl.team.local_costs import LocalCost


@dataclass(frozen=True)
class Schedule:
    """rounds K, step a at K = 1, regularisation δ ≥ 2G_c², and the radius of the ball B all points stay in."""

    rounds: int
    step: float
    regularisation: float
    radius: float

    @property
    def alpha(self) -> float:
        return self.step / float(np.sqrt(self.rounds))

    @property
    def gamma(self) -> float:
        return self.regularisation * self.alpha


def smallest_regularisation(cost: LocalCost) -> float:
    """2G_c², G_c ≥ |∇c| everywhere: c's slopes are unit vectors times what turns z into positions."""
    return 2.0 * float(np.linalg.norm(np.concatenate(cost.turns), ord=2) ** 2)


class PrimalDual:
    """One robot's part: it knows its own cost, the bounds all know, and what its neighbours send."""

    def __init__(self, robot: str, cost: LocalCost, start: Array, schedule: Schedule) -> None:
        self._cost, self._schedule, self._size = cost, schedule, len(start)
        self.averager = Averager(robot, np.concatenate([start, np.zeros(len(cost.positions))]))
        self._sum, self._steps = np.zeros(len(start)), 0

    @property
    def mean(self) -> Array:
        """The running mean of x_i; the start before the first step."""
        return self._sum / self._steps if self._steps else self.averager.value[: self._size]

    @property
    def output(self) -> Array:
        """The running mean, projected once onto the bounds."""
        return self._cost.projected(self.mean)

    @property
    def multipliers(self) -> Array:
        return self.averager.value[self._size :]

    def send(self, round: int) -> Share:
        return self.averager.send(round)

    def receive(self, share: Share, round: int) -> None:
        self.averager.receive(share, round)

    def step(self) -> None:
        """One round: average with the neighbours, then descend in x and ascend in μ."""
        mixed, alpha = self.averager.step(), self._schedule.alpha
        y, nu = mixed[: self._size], mixed[self._size :]
        x = y - alpha * (self._cost.gradient(y) + nu @ self._cost.slopes(y))
        x *= min(1.0, self._schedule.radius / max(float(np.linalg.norm(x)), 1e-300))
        mu = np.maximum(0.0, (1.0 - alpha * self._schedule.gamma) * nu + alpha * self._cost.bounds(y))
        self.averager.value = np.concatenate([x, mu])
        self._sum, self._steps = self._sum + x, self._steps + 1
