"""Logs of strangers after which a robot was located while wrong: held twists, a clock's step, an encoder reset."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.evaluation.metrics import position_error
from dgorl.evaluation.records import collect
from dgorl.logs import read
from dgorl.replay import replay
from tests.recordings import case


@pytest.mark.parametrize("name", ["held_gap", "clock_jump_5s", "encoder_reset"])
def test_nobody_is_located_while_wrong(name: str) -> None:
    log = read(case(name))
    configuration = merge(Configuration(), log.configuration, name)
    records = collect(replay(log, configuration, initial="unknown"), log.truth)
    for record in records.between_robots():
        off = np.hypot(*position_error(record).T)
        sigma = np.sqrt(np.linalg.eigvalsh(record.covariance[:, :2, :2])[:, -1])
        wrong = record.located & (off > np.maximum(1.0, 4 * sigma))
        assert not wrong.any(), (record.ego, record.peer, record.t[wrong])
        assert record.located.mean() > 0.2
    if name == "encoder_reset":
        rejected = records.last["a"].rejected
        assert rejected["odometry of b faster than the limits"] == 1
