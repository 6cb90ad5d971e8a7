"""Whatever a team lives through: the estimator never raises, is pure, and is not wrong of what is exact."""

from __future__ import annotations

from hypothesis import HealthCheck, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.team_machine import TeamMachine

STEPS = 50


def test_what_a_team_can_live_through() -> None:
    """Fifty lives, the same every time; `benchmarks/stateful.py` draws thousands."""
    run_state_machine_as_test(
        TeamMachine,
        settings=settings(
            max_examples=50,
            stateful_step_count=STEPS,
            deadline=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        ),
    )
