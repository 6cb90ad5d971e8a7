"""Three real agents in network namespaces, as on three machines, over an Ethernet that loses every fifth frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from dgorl.team.fleet_results import check, reports_of
from dgorl.team.journal_data import parse

from .ethernet import Ethernet, missing
from .real_team import BEGINNING, agents, played, prepare, simulated

LOSS, DELAY = 0.2, (0.01, 0.03)


@pytest.fixture
def ethernet(tmp_path: Path) -> Iterator[Ethernet]:
    lacking = missing(tmp_path)
    if lacking:
        pytest.skip(f"no network namespaces here: {lacking}")
    ethernet = Ethernet(tmp_path / "ports", LOSS, DELAY)
    yield ethernet
    ethernet.close()


def test_agents_on_machines_of_their_own(ethernet: Ethernet, tmp_path: Path) -> None:
    fleet = simulated(tmp_path / "live", seconds=15.0, settle=10.0)
    addresses = {robot: f"10.0.0.{number}" for number, robot in enumerate(fleet.log.robots, 1)}
    prepare(fleet, addresses={robot: f"tcp/{address}:7447" for robot, address in addresses.items()})

    def command(robot: str) -> list[str]:
        return ethernet.command(f"{addresses[robot]}/24", *fleet.command(robot))

    with agents(fleet, command) as lives:
        for _ in played(fleet, lives):
            pass
    assert ethernet.carried > 300
    assert 0.8 * LOSS < ethernet.lost / (ethernet.lost + ethernet.carried) < 1.2 * LOSS

    reports = reports_of(fleet)
    for robot, said in reports.items():
        others = tuple(sorted(set(fleet.log.robots) - {robot}))
        assert [name for name, _ in sorted(parse(said[-1].data))] == list(fleet.log.robots)
        assert all(said[-1].peers[other].status in ("position", "tracked") for other in others)
        assert said[-1].rejected.keys() <= BEGINNING
        # Not at every tick: a peer is gone after a lease of 3 s without a sign, and TCP, whose pauses double, stalls
        # for that long when four frames or answers in a row get lost.
        assert any(set(report.present) == set(others) for report in said), {report.present for report in said}
    found = check(fleet, reports)
    assert (found.robots, found.data, found.estimates) == (fleet.log.robots, True, True), found.differences
