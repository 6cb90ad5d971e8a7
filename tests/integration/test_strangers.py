"""Real agents with a stranger on their network: what it says is counted, without effect; under TLS it hears nothing."""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from dgorl.replay import replay, start_priors
from dgorl.team.fleet_results import check, reports_of
from dgorl.team.journal_data import parse, recompute
from dgorl.team.keys import load_key
from dgorl.team.report import Report, peers_of
from dgorl.team.team_file import TeamFile
from dgorl.team.zenoh_transport import open_session

from . import certificates
from .real_team import BEGINNING, agents, played, prepare, simulated
from .stranger import Stranger
from .test_zenoh import addresses, free_port


def counted(report: Report) -> Counter[str]:
    """What an agent rejected because of somebody else."""
    return Counter({reason: count for reason, count in report.rejected.items() if reason not in BEGINNING})


def test_a_stranger_is_counted_and_changes_nothing(tmp_path: Path) -> None:
    fleet = simulated(tmp_path, seconds=9.0, settle=4.0)
    prepare(fleet)
    victim, *others = reversed(fleet.log.robots)

    def command(robot: str) -> list[str]:
        return [*fleet.command(robot), "--local", f"tcp/127.0.0.1:{free_port()}"]

    with agents(fleet, command) as lives:
        recorded = load_key(fleet.folder / f"{victim}.key")
        stranger = Stranger(TeamFile.read(fleet.folder / "team.yaml"), victim, recorded)
        try:
            for stamp in played(fleet, lives):
                stranger.volley()
                for robot in fleet.log.robots:
                    stranger.sense(robot, stamp)
            stranger.too_large()
        finally:
            stranger.close()

    reports = reports_of(fleet)
    assert min(stranger.said.values()) >= 5
    for robot in others:
        assert counted(reports[robot][-1]) == stranger.said
    assert counted(reports[victim][-1]) == {"unknown robot": stranger.said["unknown robot"]}

    # The same as without it: every bundle is the log's, every last estimate that of a replay, to the bit.
    found = check(fleet, reports)
    assert (found.robots, found.data, found.estimates) == (fleet.log.robots, True, True), found.differences
    *_, last = replay(fleet.log, fleet.configuration, initial="known")
    assert last.stamp == fleet.last
    for robot, estimate in found.last.items():
        assert peers_of(estimate) == peers_of(last.estimates[robot])
        for said in reports[robot][-3:]:
            assert [name for name, _ in sorted(parse(said.data))] == list(fleet.log.robots)
            words = (said.data, said.stamp, robot, fleet.configuration, start_priors(fleet.starts))
            assert said.peers == peers_of(recompute([fleet.journal(robot)], *words))


def test_a_flood_drowns_no_agent(tmp_path: Path) -> None:
    """Ticks go on, memory stays, and when it is over all have everything."""
    fleet = simulated(tmp_path, seconds=9.0, settle=6.0)
    prepare(fleet)
    victim, *others = reversed(fleet.log.robots)
    recorded = load_key(fleet.folder / f"{victim}.key")
    with agents(fleet) as lives, ThreadPoolExecutor(1) as pool:
        stranger = Stranger(TeamFile.read(fleet.folder / "team.yaml"), victim, recorded)
        try:
            told = played(fleet, lives)
            next(told)
            flood = pool.submit(stranger.flood, 10_000.0, 5.0)
            for _ in told:
                pass
            sent = flood.result()
        finally:
            stranger.close()

    reports = reports_of(fleet)
    due = (fleet.last - fleet.first) / fleet.configuration.period
    for robot in others:
        rejected = counted(reports[robot][-1])
        assert rejected.keys() <= {"too fast", "malformed", "bad signature"}
        assert 1000 < sum(rejected.values()) < sent, "the rest was held up by its own connection"
        assert rejected["too fast"] > 0.9 * sum(rejected.values())
        assert len(reports[robot]) > due / 2
        left = json.loads(fleet.messages(robot).read_text().splitlines()[-1])
        assert left["peak_rss_mb"] < 90.0
    found = check(fleet, reports)
    assert (found.robots, found.data, found.estimates) == (fleet.log.robots, True, True), found.differences


def test_under_tls_a_stranger_hears_nothing(tmp_path: Path) -> None:
    fleet = simulated(tmp_path, seconds=4.0, settle=3.0)
    given = addresses(*fleet.log.robots, protocol="tls")
    files = {"authority": "ca.pem", "certificate": "{robot}.pem", "key": "{robot}.key.pem"}
    prepare(fleet, addresses=given, tls=files)
    certificates.make(tmp_path, fleet.log.robots)
    overheard: list[str] = []
    settings = {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": list(given.values()),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False,
        "transport/link/tls/root_ca_certificate": str(tmp_path / "ca.pem"),
        "transport/link/tls/verify_name_on_connect": False,
    }
    with agents(fleet) as lives, open_session(settings) as stranger:
        stranger.declare_subscriber("**", lambda sample: overheard.append(str(sample.key_expr)))
        for _ in played(fleet, lives):
            stranger.put("dgorl/fleet/r9/bundles", b"nonsense")
            assert stranger.info.peers_zid() == []
    reports = reports_of(fleet)
    found = check(fleet, reports)
    assert (found.data, found.estimates) == (True, True), found.differences
    assert all(len(parse(said[-1].data)) == len(fleet.log.robots) for said in reports.values())
    assert all(counted(said[-1]) == {} for said in reports.values())
    assert set(overheard) == {"dgorl/fleet/r9/bundles"}  # its own
