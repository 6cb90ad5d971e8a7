"""A team that lives through what teams live through, in virtual time, and the estimator that is told of it.

The truth moves exactly as odometry says and readings are exact. Stamps, arrivals and what is lost are up to the test.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations, count
from math import atan2, floor, hypot, inf
from random import Random

import numpy as np

from dgorl import Bearing, Configuration, Displacement, Odometry, Range, RelativePose, Rssi, Team, se2
from dgorl.estimate import Estimate
from dgorl.history import LATE
from dgorl.measurements import WORLD, Measurement, known_at
from dgorl.radio import range_to_rssi

from .integration.driven import KNOWN, bits, explains_itself

Array = np.ndarray
SENSORS = ("range", "bearing", "rssi")
RANGE_SIGMA, BEARING_SIGMA = 0.1, 0.05
START = (0.0025, 0.0, 0.0, 0.0025, 0.0, 0.0003)
"""Covariance of known starts and of measured poses."""
WRONG_SIGMAS, WRONG_METRES = 5.0, 1.0
"""A located peer that is farther off than both is wrong."""
RECALL = 60.0
"""A reading is given twice at most this much later [s]."""


@dataclass
class Robot:
    """One robot's truth and habits. ``told``: until when it has made odometry; ``track``: its epoch.

    shift: how far its clock is off [s]. delay: of what it tells [s], infinite for what gets lost, until ``delayed``.
    """

    pose: Array
    twist: tuple[float, float]
    row: float
    twists: bool
    told: float
    track: int
    path: list[tuple[float, Array, tuple[float, float]]] = field(default_factory=list)
    shift: float = 0.0
    blind: float = -inf
    deaf: float = -inf
    delay: float = 0.0
    delayed: float = -inf
    carried: float = -inf
    twin: int | None = None
    gone: bool = False

    def at(self, stamp: float) -> Array:
        """Its true pose."""
        since, pose, (v, omega) = next(p for p in reversed(self.path) if p[0] <= stamp or p is self.path[0])
        moved: Array = se2.compose(pose, se2.exp(np.array([v, 0.0, omega]) * (stamp - since)))
        return moved

    def turn(self, now: float, pose: Array | None = None) -> None:
        """It goes on from where it is, or from ``pose``, with the twist it has."""
        self.pose = self.at(now) if pose is None else pose
        self.path.append((now, self.pose, self.twist))


class Life:
    """A team, its world, and a Team that is told what the robots measure."""

    def __init__(self, seed: int, robots: int, configuration: Configuration, sensors: Sequence[str]) -> None:
        self.now, self.configuration, self.sensors = 0.0, configuration, tuple(sensors)
        self.random = Random(seed)
        self.robots: dict[str, Robot] = {}
        self.team = Team(configuration)
        self.tick_at = 0.0
        self.given: list[Measurement] = []
        self.admitted: set[Measurement] = set()
        self._undecided: list[Measurement] = []
        self._travelling: list[tuple[float, int, Measurement]] = []
        self._order = count()
        self._exchange = count()
        for _ in range(robots):
            self.join()

    def join(self, row: float = 0.5, twists: bool = True) -> None:
        """Another robot begins."""
        rng = self.random
        pose = np.array([rng.uniform(-6, 6), rng.uniform(-6, 6), rng.uniform(-3, 3)])
        robot = Robot(pose, (0.4, rng.choice([-0.3, 0.2, 0.5])), row, twists, self.now, rng.getrandbits(40))
        robot.turn(self.now, pose)
        self.robots[f"r{len(self.robots) + 1}"] = robot

    def pass_time(self, seconds: float, every: float = 0.5) -> None:
        """Robots drive and measure; pairs measure one another every so often [s]."""
        begin, self.now = self.now, self.now + seconds
        for name, robot in self.robots.items():
            if not robot.gone:
                self._tell(name, robot)
        first = int(np.floor(begin / every)) + 1
        for k in range(first, int(np.floor(self.now / every)) + 1):
            for a, b in combinations(self.robots, 2):
                self._measure(a, b, k * every)

    def give(self, measurement: Measurement, robot: Robot | None = None) -> None:
        """A measurement travels to the estimator, as its author's messages do."""
        late = robot.delay if robot is not None and self.now <= robot.delayed else 0.0
        if late < inf:
            heapq.heappush(self._travelling, (self.now + late, next(self._order), measurement))

    def start_known(self, name: str) -> None:
        """Somebody says where a robot is now in the world."""
        x, y, theta = self.robots[name].at(self.now).tolist()
        self.give(RelativePose(WORLD, name, self.now, x, y, theta, START, prior=True))

    def pose_measured(self, a: str, b: str) -> None:
        """A robot measures another's pose."""
        x, y, theta = se2.between(self.robots[a].at(self.now), self.robots[b].at(self.now)).tolist()
        stamp = self.now + self.robots[a].shift
        self.give(RelativePose(a, b, stamp, x, y, theta, START), self.robots[a])

    def carry(self, name: str, metres: float, noticed: bool) -> None:
        """A robot is carried; if it notices, it begins a new epoch there."""
        robot, angle = self.robots[name], self.random.uniform(-3, 3)
        robot.turn(self.now, robot.at(self.now) + np.array([metres * 0.6, metres * 0.8, angle]))
        if noticed:
            robot.track, robot.told, robot.carried = self.random.getrandbits(40), self.now, self.now

    def tells(self, name: str) -> bool:
        """Whether a robot's odometry of now will come."""
        robot = self.robots[name]
        return not robot.gone and max(robot.blind, robot.delayed) <= self.now and robot.told > self.now - 2.0

    def repeat(self, number: int) -> None:
        """What was given lately comes once more."""
        lately = [m for m in self.given[-200:] if known_at(m) > self.tick_at - RECALL]
        for measurement in self.random.sample(lately, min(number, len(lately))):
            self.give(measurement)

    def deliver(self) -> None:
        """What has arrived is given to the estimator."""
        while self._travelling and self._travelling[0][0] <= self.now:
            measurement = heapq.heappop(self._travelling)[2]
            self.team.add(measurement)
            self.given.append(measurement)
            self._undecided.append(measurement)

    def work(self, ahead: bool) -> None:
        """The estimator computes in parts what a tick needs, or ahead what the next will need, as in idle time."""
        if ahead:
            self.team.anticipate(max(self.now, self.tick_at))
            return
        self.deliver()
        now = self.tick_at = max(self.tick_at, self.now)
        self._admit(now)
        while self.team.prepare(now):
            pass

    def tick(self, back: float = 0.0) -> dict[str, Estimate]:
        """All robots' estimates, at most ``back`` [s] ago; what is admitted for them is noted."""
        self.deliver()
        now = self.tick_at = max(self.tick_at, self.now - back)
        self._admit(now)
        state = self.team.update(now)
        return {name: self.team.view(name, state, now) for name in (*self.robots, "stranger")}

    def again(self, spacing: float, seed: int) -> Team:
        """Another Team that is given what was admitted, in another order, and asked every ``spacing`` [s]."""
        rng, team = Random(seed), Team(self.configuration)
        waiting = sorted(self.admitted, key=known_at, reverse=True)
        k = floor(known_at(waiting[-1]) / spacing) if waiting else 0
        while True:
            k += 1
            now = min(k * spacing, self.tick_at)
            ready = []
            while waiting and known_at(waiting[-1]) <= now:
                ready.append(waiting.pop())
            rng.shuffle(ready)
            for measurement in ready:
                team.add(measurement)
            if now == self.tick_at:
                return team
            team.update(now)

    def wrong(self, estimates: dict[str, Estimate]) -> Iterator[str]:
        """Located peers that are not where the estimate says."""
        for ego, estimate in estimates.items():
            for peer, found in estimate.items():
                if found.status not in KNOWN or peer == WORLD or ego == "stranger":
                    continue
                if not (self._told_of(ego, estimate.stamp) and self._told_of(peer, estimate.stamp)):
                    continue
                true = se2.between(self.robots[ego].at(estimate.stamp), self.robots[peer].at(estimate.stamp))
                e, covariance = found.pose[:2] - true[:2], found.covariance[:2, :2]
                sigmas = float(np.sqrt(e @ np.linalg.solve(covariance, e)))
                if sigmas > WRONG_SIGMAS and np.hypot(*e) > WRONG_METRES:
                    yield f"{ego} sees {peer} {np.hypot(*e):.2f} m ({sigmas:.1f} σ) off at {estimate.stamp} s"

    def _told_of(self, name: str, now: float) -> bool:
        """Whether a robot's odometry has told that it was turned or carried last, so that one can know of it."""
        last = max((since for since, *_ in self.robots[name].path if since <= now), default=-inf)
        track = self.team.history.trails[name].at(now) if name in self.team.history.trails else None
        return track is not None and track.end > last and track.key.begin >= self.robots[name].carried - 1e-6

    def _admit(self, now: float) -> None:
        """METHOD §1: what is later than the history is rejected, what is later than 10 s may wait for a node."""
        takes_late = self.team.takes_late(now)
        undecided = []
        for m in self._undecided:
            if m in self.admitted:
                continue
            stamp = known_at(m)
            if stamp > now or (now - stamp > LATE and not takes_late and now - begin(m) <= self.configuration.history):
                undecided.append(m)
            elif now - begin(m) <= self.configuration.history:
                self.admitted.add(m)
        self._undecided = undecided

    def _tell(self, name: str, robot: Robot) -> None:
        """Odometry up to now; of the time it was blind there is none."""
        if robot.blind > self.now:
            return
        robot.told = max(robot.told, min(robot.blind, self.now))
        while robot.told + robot.row <= self.now + 1e-9:
            start, robot.told = robot.told, robot.told + robot.row
            for track in {robot.track, robot.track if robot.twin is None else robot.twin}:
                self.give(self._row(name, robot, start, robot.told, track), robot)

    def _row(self, name: str, robot: Robot, start: float, end: float, track: int) -> Measurement:
        a, b = start + robot.shift, end + robot.shift
        moved = se2.between(robot.at(start), robot.at(end))
        if robot.twists and self._steady(robot, start, end):
            return Odometry(name, a, b, *robot.twist, track)
        return Displacement(name, a, b, *moved.tolist(), epoch=track)

    def _steady(self, robot: Robot, start: float, end: float) -> bool:
        return robot.path[-1][0] <= start

    def _measure(self, a: str, b: str, stamp: float) -> None:
        one, two = self.robots[a], self.robots[b]
        if max(one.deaf, two.deaf) > self.now or one.gone or two.gone:
            return
        x, y, _ = se2.between(one.at(stamp), two.at(stamp)).tolist()
        distance, shifted = hypot(x, y), stamp + one.shift
        if "range" in self.sensors:
            exchange = next(self._exchange) if self.random.random() < 0.2 else None
            self.give(Range(a, b, shifted, distance, RANGE_SIGMA, exchange), one)
            if exchange is not None:
                self.give(Range(b, a, stamp + two.shift + 0.01, distance, RANGE_SIGMA, exchange), two)
        if "bearing" in self.sensors and distance > 0.1:
            self.give(Bearing(a, b, shifted, atan2(y, x), BEARING_SIGMA), one)
        if "rssi" in self.sensors:
            dbm = float(range_to_rssi(max(distance, 0.1), self.configuration.radio))
            self.give(Rssi(b, a, shifted, dbm), one)


def begin(measurement: Measurement) -> float:
    """From when on it tells [s]."""
    return measurement.start if isinstance(measurement, Odometry | Displacement) else measurement.stamp


def flat(estimates: dict[str, Estimate]) -> dict[str, object]:
    """All that is said, comparable bit for bit."""
    return {name: bits(estimate) for name, estimate in estimates.items()}


def malformed(estimates: Iterable[Estimate]) -> list[str]:
    """Peers that have not what their status promises."""
    return [
        f"{estimate.robot} of {name} at {estimate.stamp} s: {what}: {peer}"
        for estimate in estimates
        for name, peer in estimate.items()
        if (what := "" if explains_itself(peer) else "unexplained") or (what := unsound(peer.covariance))
    ]


def unsound(covariance: Array | None) -> str:
    """Why a covariance is none: not finite, not symmetric, or negative by more than rounding."""
    if covariance is None:
        return ""
    if not np.isfinite(covariance).all():
        return "not finite"
    skew = np.abs(covariance - covariance.T).max()
    if skew > 1e-9 * np.abs(covariance).max():
        return f"asymmetric by {skew}"
    scale = np.sqrt(np.abs(np.diag(covariance)) + 1e-12)
    least = np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0]
    return f"eigenvalue {least}" if least < -1e-6 else ""
