"""Odometry that is a little late, own or a peer's: peers stay located, with covariances that say so."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import Configuration, Localizer, se2
from dgorl.configuration import merge
from dgorl.evaluation.metrics import CHI2_95_2DOF
from dgorl.evaluation.records import LOCATED, truth_at
from dgorl.measurements import Displacement, Odometry, known_at
from dgorl.replay import known_starts
from dgorl.simulation import Scenario, simulate


@pytest.mark.parametrize("whose", ["own", "all"])
def test_rows_that_arrive_just_after_a_tick(whose: str) -> None:
    """Half a second of odometry 50 ms late: at every tick the newest row is missing."""
    log = simulate(Scenario(robots=5, area=20.0, steps=80, seed=3, sensors=("range",)))
    configuration = merge(Configuration(), log.configuration, "the simulated log")

    def arrival(m: object) -> float:
        late = isinstance(m, Odometry | Displacement) and (whose == "all" or m.robot == "r1")
        return known_at(m) + (0.05 if late else 0.0)

    punctual, late = Localizer("r1", configuration), Localizer("r1", configuration)
    for m in known_starts(log):
        punctual.add(m)
        late.add(m)
    located, inside, wider = [], [], []
    for k in range(1, 81):
        now, before = 0.5 * k, 0.5 * (k - 1)
        for m in log.measurements:
            if before < known_at(m) <= now:
                punctual.add(m)
            if before < arrival(m) <= now:
                late.add(m)
        on_time, estimate = punctual.update(now), late.update(now)
        if k < 20:
            continue
        mine = truth_at(log.truth, "r1", np.array([now]))[0]
        for name in log.robots[1:]:
            peer = estimate[name]
            located.append(peer.status in LOCATED)
            error = peer.pose[:2] - se2.between(mine, truth_at(log.truth, name, np.array([now]))[0])[:2]
            inside.append(error @ np.linalg.solve(peer.covariance[:2, :2], error) <= CHI2_95_2DOF)
            wider.append(np.trace(peer.covariance) > np.trace(on_time[name].covariance))
    assert np.mean(located) > 0.9
    assert 0.88 <= np.mean(inside) <= 1.0
    assert all(wider)


def test_own_odometry_that_stays_away_counts() -> None:
    """After more than a second it may not come: peers are as little known as the covariance says."""
    log = simulate(Scenario(robots=3, area=20.0, steps=40, seed=3, sensors=("range",)))
    localizer = Localizer("r1", merge(Configuration(), log.configuration, "the simulated log"))
    for m in (*known_starts(log), *log.measurements):
        if not (isinstance(m, Odometry | Displacement) and m.robot == "r1" and m.end > 15.0):
            localizer.add(m)
    assert {peer.status in LOCATED for name, peer in localizer.update(15.9).items() if name != "world"} == {True}
    assert "unobservable" in {str(peer.status) for peer in localizer.update(20.0).values()}
