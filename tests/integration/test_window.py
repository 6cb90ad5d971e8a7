"""A window and its prior say what all data says: one Gauss–Newton step with everything linearised at common points."""

from __future__ import annotations

import numpy as np
import pytest

from dgorl.history import History
from dgorl.marginal import marginalized, stretches
from dgorl.measurements import WORLD, RelativePose
from dgorl.optimization import native
from dgorl.window import Component, assemble, grow
from tests.integration.teams import everything, settings, simulated


def measurements(world: bool):
    """A team's log; without the world, the others' starts are relative to the first robot's."""
    log = simulated(sensors=("rssi", "range", "bearing"), steps=40, nlos=0.1)
    known = everything(log)
    if not world:
        starts = [m for m in known if isinstance(m, RelativePose)]
        known = [m for m in known if m not in starts]
        known += [RelativePose("r1", m.robot, 0.0, 1.0, 2.0, 0.3, m.covariance, prior=True) for m in starts[1:]]
    return log, known


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy_negative"])
@pytest.mark.parametrize("world", [True, False])
def test_one_step_of_the_window_is_that_of_all_data(world, kernel):
    log, known = measurements(world)
    history = History(settings(log, ranging={"kernel": kernel}, radio={"kernel": kernel}))
    for measurement in known:
        history.add(measurement)
    now, boundary = 20.0, 10.0
    history.admit(now, node_due=True)
    component = next(c for c in grow(history, (), -np.inf, now) if len(c.stretches) > 1)
    pin = int(2 * boundary)
    whole = assemble(history, component, -np.inf, now, pin)
    assert component.has_world == world
    # Common points that are no optimum: gradients do not vanish.
    poses = whole.problem.initial + np.where(whole.problem.fixed[:, None], 0.0, 0.05)
    rest = Component(stretches(whole, poses, pin), marginalized(whole, poses, pin))
    assert (WORLD in {key.robot for key in rest.priors[0].members}) == world
    window = assemble(history, rest, boundary, now, pin)
    expected = native.graph(whole.problem).gauss_newton_step(poses)
    found = native.graph(window.problem).gauss_newton_step(window.problem.initial)
    assert np.abs(expected).max() > 1e-3
    for key, (offset, first, count) in window.layout.items():
        at = whole.index(key, first)
        np.testing.assert_array_equal(window.problem.initial[offset : offset + count], poses[at : at + count])
        np.testing.assert_allclose(found[offset : offset + count], expected[at : at + count], atol=1e-9)
