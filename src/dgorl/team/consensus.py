"""Averages over the team without a centre: one state machine a robot, rounds of team time as argument. METHOD §6.

In round k every robot sends ``send(k)`` to whom it may reach, takes what arrives of round k and then steps. What
arrives later counts as lost.

:class:`Averager` keeps the average while every link that fails does so in both directions: then its weights are doubly
stochastic. Where one direction alone fails no acknowledgement helps, as the last message of any exchange may be the
lost one, and the average drifts. :class:`PushSum` keeps it all the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dgorl.se2 import Array


@dataclass(frozen=True)
class Share:
    """A robot's value in a round, and whom it heard in the round before."""

    robot: str
    round: int
    value: Array
    heard: frozenset[str]


class Averager:
    """Average consensus with Metropolis–Hastings weights 1/(1 + max(d_i, d_j)), d the robots one heard.

    A link counts in a round when both ends heard one another in the round before and now.
    """

    def __init__(self, robot: str, value: ArrayLike) -> None:
        self.robot = robot
        self.value: Array = np.array(value, dtype=float)
        self.weights: Mapping[str, float] = {robot: 1.0}
        """of the last step, this robot's row of A(t)"""
        self._heard: frozenset[str] = frozenset()
        self._inbox: dict[str, Share] = {}

    def send(self, round: int) -> Share:
        """What everybody who hears this robot should get."""
        self._inbox = {}
        return Share(self.robot, round, self.value, self._heard)

    def receive(self, share: Share, round: int) -> None:
        """Take a share of this round, twice without harm."""
        if share.round == round and share.robot != self.robot:
            self._inbox[share.robot] = share

    def step(self) -> Array:
        """The new value, Σ A_ij x_j."""
        degree = len(self._heard)
        linked = [s for name, s in sorted(self._inbox.items()) if name in self._heard and self.robot in s.heard]
        weights = {share.robot: 1.0 / (1 + max(degree, len(share.heard))) for share in linked}
        change = sum((weights[s.robot] * (s.value - self.value) for s in linked), np.zeros_like(self.value))
        self.weights = {**weights, self.robot: 1.0 - sum(weights.values())}
        self.value = self.value + change
        self._heard = frozenset(self._inbox)
        return self.value


@dataclass(frozen=True)
class Sums:
    """All that a robot has ever given to each peer, value and weight, and the weight it has ever taken of each."""

    robot: str
    round: int
    given: Mapping[str, tuple[Array, float]]
    taken: Mapping[str, float]


class PushSum:
    """Ratio consensus for links that lose messages in one direction: nothing is lost, for sums are sent, not shares.

    Every robot holds a value and a weight, at first 1, gives equal parts of both to itself and to the peers that said
    they hear it, and takes what a peer's sums have grown by since it last heard them. The ratio goes to the average.
    After Hadjicostis, Vaidya and Domínguez-García, Robust distributed average consensus via exchange of running sums
    (IEEE TAC 61(6), 2016). A peer that has more than one such part to confirm gets no other until it does, so that
    one that is gone takes little with it.
    """

    def __init__(self, robot: str, value: ArrayLike) -> None:
        self.robot = robot
        self._value: Array = np.array(value, dtype=float)
        self._weight = 1.0
        self._given: dict[str, tuple[Array, float]] = {}
        self._taken: dict[str, tuple[Array, float]] = {}
        self._confirmed: dict[str, float] = {}

    @property
    def ratio(self) -> Array:
        """The average, as far as it is known."""
        return self._value / self._weight

    @property
    def weight(self) -> float:
        return self._weight

    @property
    def unconfirmed(self) -> float:
        """Weight given that no peer has said to have taken: all of it may be under way, or lost for good."""
        return sum(self._under_way(peer) for peer in self._given)

    def send(self, round: int) -> Sums:
        """Give parts to the peers that hear this robot, and what everybody who hears it should get."""
        part = self._weight / (len(self._confirmed) + 1)
        peers = sorted(peer for peer in self._confirmed if self._under_way(peer) <= part)
        value = self._value / (len(self._confirmed) + 1)
        for peer in peers:
            before, weight = self._given.get(peer, (np.zeros_like(value), 0.0))
            self._given[peer] = before + value, weight + part
        self._value, self._weight = self._value - len(peers) * value, self._weight - len(peers) * part
        return Sums(self.robot, round, dict(self._given), {p: weight for p, (_, weight) in self._taken.items()})

    def receive(self, sums: Sums, round: int) -> None:
        """Take what a peer's sums have grown by: of any round, in any order, twice without harm."""
        peer = sums.robot
        if self.robot in sums.taken:
            self._confirmed[peer] = max(self._confirmed.get(peer, 0.0), sums.taken[self.robot])
        before = self._taken.setdefault(peer, (np.zeros_like(self._value), 0.0))
        value, weight = sums.given.get(self.robot, before)
        if weight > before[1]:
            self._value, self._weight = self._value + value - before[0], self._weight + weight - before[1]
            self._taken[peer] = value, weight

    def _under_way(self, peer: str) -> float:
        return self._given.get(peer, (None, 0.0))[1] - self._confirmed.get(peer, 0.0)


def deviation_bound(missing: float, robots: int, spread: float) -> float:
    """How far the ratio may be from the average while ``missing`` of the weight, of n = ``robots``, is held by nobody.

    spread: largest less smallest of the first values. What is missing, under way or gone with a robot, is a mixture of
    them: it shifts the mean of the rest by at most missing · spread / (n − missing).
    """
    return float("inf") if missing >= robots else missing * spread / (robots - missing)
