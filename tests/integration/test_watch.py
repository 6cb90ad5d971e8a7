"""A team of agents watched over a network in memory: what is seen, what is not believed, what a doctor says of it."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from dgorl.cli.watch_table import tables
from dgorl.findings import Finding, Level
from dgorl.logs.log import Log
from dgorl.measurements import Odometry
from dgorl.team.agent import Agent
from dgorl.team.diagnosis import Heard, diagnosis, knocked
from dgorl.team.envelope import Reason
from dgorl.team.faults import Faults, Faulty
from dgorl.team.journal import Journal
from dgorl.team.keys import UNSIGNED, Key, generate
from dgorl.team.memory import Air, MemoryTransport
from dgorl.team.network import Network
from dgorl.team.snapshot import snapshot
from dgorl.team.team_file import TeamFile
from dgorl.team.transport import WATCHED, Received
from dgorl.team.watch import Watch

from .teams import settings, simulated

STEP = 0.05
ROBOTS = "r1", "r2", "r3"


class Team:
    """Agents that stand still, each with a team file of its own, and a watcher with ``file``."""

    def __init__(self, folder: Path, log: Log, faults: Faults | None = None, **changes: object) -> None:
        self.folder, self.air, self.faults = folder, Air(), faults or Faults()
        self.keys: dict[str, Key] = {robot: generate() for robot in ROBOTS}
        self.file = TeamFile(
            "lab",
            {robot: key.public for robot, key in self.keys.items()},
            configuration=settings(log, **changes),
            starts=log.starts,
        )
        self.agents: dict[str, Agent] = {}
        self.ears: MemoryTransport = self.air.transport("monitor")
        self.watch = Watch(self.file.roster)
        self.heard: list[Received] = []
        self.offsets: dict[str, float] = {}

    def start(self, robot: str, file: TeamFile | None = None, offset: float = 0.0, journal: str = "") -> None:
        file = file or self.file
        path = self.folder / (journal or f"{robot}.journal")
        held = Journal.open(path, robot, file.roster, settings={}, keep=400.0, synchronous="normal")
        transport = self.air.transport(robot, lambda now: now + offset)
        now = self.air.now + offset
        faulty = Faulty(transport, robot, self.faults, lambda: self.air.now)
        self.agents[robot] = Agent(robot, file, self.keys[robot], faulty, held, now)
        self.offsets[robot] = offset

    def stop(self, robot: str) -> None:
        self.agents.pop(robot).close()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.air.now += STEP
            for robot, agent in self.agents.items():
                now = self.air.now + self.offsets[robot]
                agent.take(Odometry(agent.robot, now - STEP, now, 0.0, 0.0))
                agent.step(now)
            messages = self.ears.poll()
            self.heard += messages
            self.watch.take(messages)

    @property
    def present(self) -> frozenset[str]:
        return self.ears.present()

    def state(self) -> dict:
        return snapshot(self.file, self.watch, self.present, self.air.now)

    def findings(self, **changes: object) -> tuple[Finding, ...]:
        team = replace(self.file, **changes)
        return diagnosis(Heard(team, self.watch, self.present, self.air.now, 5.0), lambda address: f"{address} tried")

    def problems(self, **changes: object) -> list[str]:
        return [f.what for f in self.findings(**changes) if f.level == Level.PROBLEM]


@pytest.fixture(scope="module")
def log() -> Log:
    return simulated(steps=4, sensors=("rssi",), seed=3)


@pytest.fixture
def lab(tmp_path: Path, log: Log) -> Iterator[type]:
    with ExitStack() as stack:

        def make(faults: Faults | None = None, **changes: object) -> Team:
            team = Team(tmp_path, log, faults, **changes)
            stack.callback(lambda: [team.stop(robot) for robot in list(team.agents)])
            return team

        yield make


def started(team: Team, *robots: str) -> Team:
    for robot in robots or ROBOTS:
        team.start(robot)
    team.run(4.0)
    return team


def test_a_team_is_seen_and_well(lab: type) -> None:
    team = started(lab())
    state = team.state()
    assert json.loads(json.dumps(state, allow_nan=False)) == state
    for robot in ROBOTS:
        seen = state["robots"][robot]
        others = {*ROBOTS} - {robot}
        assert (seen["present"], seen["same_team_file"], seen["rejected_here"]) == (True, True, {})
        assert set(seen["says"]["peers"]) >= others
        assert seen["says"]["loss"] == dict.fromkeys(sorted(others), 0.0)
        assert seen["says"]["sent_bytes_per_s"] > 0
        assert seen["clock"]["ahead_s"] == 0.0
        assert seen["says"]["s_ago"] <= 1.1
        assert seen["says"]["present"] == sorted({*others, "monitor"})
    assert team.problems() == []
    assert any("hash" in f.what for f in team.findings() if f.level == Level.OK)


def test_what_gets_lost_is_told(lab: type) -> None:
    team = started(lab(Faults(seed=1, loss=0.6)))
    team.run(6.0)
    shares = [share for robot in ROBOTS for share in team.state()["robots"][robot]["says"]["loss"].values()]
    assert 0.4 < sum(shares) / len(shares) < 0.75
    assert any("loses much" in f.what for f in team.findings())


def test_who_is_missing_is_named_with_the_reason(lab: type) -> None:
    team = started(lab(), "r1", "r2")
    network = Network({"r3": "tcp/10.0.0.3:7447"})
    (missing,) = (f for f in team.findings(transport=network) if f.level == Level.PROBLEM)
    assert missing.what == "r3 is not on the network (tcp/10.0.0.3:7447 tried)"
    assert "dgorl agent --robot r3" in missing.advice
    # r3 is there, but only others can see it.
    team.start("r3")
    team.run(3.0)
    watch = Watch(team.file.roster)
    watch.take([message for message in team.heard if message.sender != "r3"])
    unseen = Heard(team.file, watch, team.present - {"r3"}, team.air.now, 5.0)
    (missing,) = (f for f in diagnosis(unseen) if f.level == Level.PROBLEM)
    assert missing.what == "r3 is not heard here, but is on the network of r1, r2"


def test_who_left_is_named(lab: type) -> None:
    team = started(lab())
    team.stop("r2")
    team.run(0.5)
    assert team.problems() == []  # who comes is heard before he is noticed
    team.run(3.0)
    (problem,) = team.problems()
    assert problem.startswith("r2 has left the network; it was heard ")


@pytest.mark.parametrize("gone", [False, True], ids=["its token stays", "its token goes"])
def test_the_rows_of_a_robot_that_died_are_grey_within_five_seconds(lab: type, gone: bool) -> None:
    team = started(lab(), *ROBOTS)
    assert grey_rows(team) == set()
    dead = team.agents.pop("r2")
    if gone:
        dead.transport.close()
    team.run(4.9)
    assert grey_rows(team) == {("r1", "r2"), ("r2", "r1"), ("r2", "r3"), ("r3", "r2")}
    plain = shown(team, "").lower()
    assert "2 of 3 robots are heard" in plain
    assert ("r2: left the network, heard" if gone else "r2: says nothing, heard") in plain
    dead.close()


def shown(team: Team, color_system: str) -> str:
    """The monitor's table, with a terminal's colours if they are named."""
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120, color_system=color_system or None)
    console.print(tables(team.state(), None))
    return out.getvalue()


def grey_rows(team: Team) -> set[tuple[str, str]]:
    """(robot, peer) of the rows that are grey."""
    grey, robot = set(), ""
    for plain, colored in zip(shown(team, "").splitlines(), shown(team, "standard").splitlines(), strict=True):
        cells = plain.split()
        robot = cells[0] if plain[:1] == "r" and cells[0] in ROBOTS else robot
        peer = next((cell for cell in cells[0 if plain[:1] == " " else 1 :] if cell in ROBOTS), None)
        if peer and "\x1b[90m" in colored:
            assert "\x1b[3" not in colored, "no status stands out of it"
            grey.add((robot, peer))
    return grey


def test_nobody(lab: type) -> None:
    team = lab()
    team.run(1.0)
    first, *rest = team.problems()
    assert first == "nobody of team lab is heard from here"
    assert len(rest) == 3
    silent = Heard(team.file, team.watch, {"r2"}, team.air.now, 5.0)
    assert any("r2 is on the network, but was silent" in f.what for f in diagnosis(silent))


def test_another_team_file_is_named(lab: type) -> None:
    team = lab()
    other = replace(team.file, configuration=replace(team.file.configuration, history=60.0))
    team.start("r1")
    team.start("r2")
    team.start("r3", other)
    team.run(5.0)
    assert team.state()["robots"]["r3"]["same_team_file"] is False
    problems = team.problems()
    named = f"r3: another team.yaml (hash {other.configuration_hash.hex()}, here {team.file.configuration_hash.hex()})"
    assert named in problems
    assert any(p.startswith("r1 rejected") and p.endswith(": other configuration") for p in problems)
    # Seen with r3's own file, r1 and r2 differ.
    changed = team.problems(configuration=other.configuration)
    assert any(p.startswith("r1, r2: another team.yaml") for p in changed)
    # With a file that nobody has, it is this one that is to be replaced.
    team.stop("r3")
    alone = Watch(team.file.roster)
    alone.take([message for message in team.heard if message.sender != "r3"])
    stranger = replace(team.file, substep=1.0)
    what = [f.what for f in diagnosis(Heard(stranger, alone, {"r1", "r2"}, team.air.now, 5.0))]
    assert "team.yaml here is not that of the team (r1, r2)" in what


def test_another_key_is_named_and_nothing_shown(lab: type) -> None:
    team = lab()
    keys = dict(team.file.robots)
    team.keys["r2"] = generate()
    keys["r2"] = team.keys["r2"].public
    team.start("r1")
    team.start("r2", replace(team.file, robots=keys))
    team.run(3.0)
    seen = team.watch.robots["r2"]
    assert (seen.bulletin, seen.digest, seen.epoch) == (None, None, None)
    assert seen.rejected[Reason.SIGNATURE] > 2
    assert any(p.startswith("r2 is on the network, but signs with another key") for p in team.problems())


def test_a_team_that_signs_nothing_is_told_so(lab: type) -> None:
    team = lab()
    team.file = replace(team.file, insecure=True)
    team.keys = dict.fromkeys(ROBOTS, UNSIGNED)
    team.watch = Watch(team.file.roster)
    started(team)
    assert team.problems() == []
    assert team.watch.robots["r1"].bulletin is not None
    assert any(f.level == Level.NOTE and "signs nothing" in f.what for f in team.findings())


def test_a_stranger_is_named(lab: type) -> None:
    team = started(lab())
    stranger = team.air.transport("mallory")
    stranger.send("digest", b"anything")
    team.run(0.5)
    assert team.state()["strangers"] == ["mallory"]
    assert "mallory is on the network but not in team.yaml" in team.problems()


def test_repeated_messages_change_nothing(lab: type) -> None:
    team = started(lab())
    old = [m for m in team.heard if m.sender == "r1" and m.channel in WATCHED]
    team.stop("r1")
    team.start("r1", journal="new.journal")  # another epoch
    team.run(2.0)
    seen = team.watch.robots["r1"]
    before, epoch = seen.bulletin, seen.epoch
    assert epoch == team.agents["r1"].journal.epoch
    team.watch.take([message._replace(at=team.air.now) for message in old])
    again = team.watch.robots["r1"]
    assert (again.bulletin, again.epoch) == (before, epoch)
    assert again.rejected[Reason.REPLAYED] == len(old)
    assert again.returns == 1


def test_two_machines_under_one_name(lab: type) -> None:
    team = started(lab(), "r1", "r2")
    first = team.agents.pop("r2")
    team.start("r2", journal="copy.journal")
    for _ in range(6):
        team.agents["r2"], first = first, team.agents["r2"]
        team.run(1.0)
    first.close()
    assert team.watch.robots["r2"].returns > 1
    assert any("r2 began anew" in problem for problem in team.problems())


def test_too_much_of_one_sender_is_not_looked_at(lab: type) -> None:
    team = lab()
    flood = team.air.transport("r1")
    for _ in range(500):
        flood.send("estimate", b"\x93\x01\xc4\x00\xc4\x00")
    team.run(STEP)
    rejected = team.watch.robots["r1"].rejected
    assert rejected[Reason.RATE] > 400
    assert rejected.total() == 500


def test_clocks_that_differ_are_named(lab: type) -> None:
    team = lab()
    for robot, offset in (("r1", 0.0), ("r2", 3.0), ("r3", 0.01)):
        team.start(robot, offset=offset)
    team.run(4.0)
    assert team.state()["robots"]["r2"]["clock"]["ahead_s"] == pytest.approx(2.99, abs=0.02)
    clocks = [f for f in team.findings() if f.area == "clocks"]
    assert [(f.level, f.what) for f in clocks] == [(Level.PROBLEM, "r2: its clock is +2.990 s off the team's median")]
    assert "clock: estimated" in clocks[0].advice


def test_estimated_clocks_are_placed(lab: type) -> None:
    team = lab(clock="estimated")
    for robot, offset in (("r1", 0.0), ("r2", 3.0)):
        team.start(robot, offset=offset)
    team.run(1.2)
    assert any(f.what == "r1 cannot place the clock of r2 yet" for f in team.findings())
    team.run(15.0)
    clocks = {robot: team.state()["robots"][robot]["clock"] for robot in ("r1", "r2")}
    assert clocks["r2"]["ahead_s"] - clocks["r1"]["ahead_s"] == pytest.approx(3.0, abs=0.1)
    assert not any("clock" in problem for problem in team.problems())


def test_clocks_that_cannot_be_placed_are_named(lab: type) -> None:
    team = lab(Faults(reaches=lambda sender, receiver, _: (sender, receiver) != ("r1", "r2")), clock="estimated")
    for robot, offset in (("r1", 0.0), ("r2", 3.0)):
        team.start(robot, offset=offset)
    team.run(6.0)
    assert "r1 cannot place the clock of r2" in team.problems()


def test_knocking() -> None:
    assert knocked("udp/127.0.0.1:1").endswith("cannot be tried")
    assert knocked("tcp/127.0.0.1:1") == "tcp/127.0.0.1:1: the machine is there, no agent listens"


def test_a_robot_whose_epoch_has_ended_is_told_of_while_it_lasts(lab: type) -> None:
    """Another machine lives under its name: doctor, monitor and its log say so. When that is gone, all is well."""
    team = lab()
    for robot in ROBOTS:
        team.start(robot)
    team.run(8.0)
    team.agents["first"], team.offsets["first"] = team.agents["r1"], 0.0
    team.start("r1", journal="another.journal")
    team.agents["twin"], team.offsets["twin"] = team.agents["r1"], 0.0
    first = team.agents["r1"] = team.agents.pop("first")
    ended = first.journal.epoch
    team.run(8.0)
    assert first.journal.epoch == ended
    assert first._all_rejected()["own epoch has ended"] > 5
    team.stop("twin")
    team.run(1.5)
    assert any("own epoch has ended" in problem for problem in team.problems())
    assert team.state()["robots"]["r1"]["lives_twice"] == ["own epoch has ended"]
    team.run(8.0)
    assert first.journal.epoch != ended
    (fields,) = [fields for event, fields in first.remarks if "epoch" in event]
    assert (fields["ended"], fields["epoch"]) == (f"{ended:016x}", f"{first.journal.epoch:016x}")
    assert any(rejection.reason is Reason.ENDED for rejection in first.rejections), "the log says who showed what"
    assert team.state()["robots"]["r1"]["lives_twice"] == []
    team.run(20.0)
    for robot, agent in team.agents.items():
        report = agent.estimate(team.air.now + STEP)
        assert all(peer.age < 1.0 for peer in report.peers.values()), robot


def test_two_contents_under_one_name_are_named(lab: type) -> None:
    team = lab()
    for robot in ROBOTS:
        team.start(robot)
    team.run(5.0)
    for path in team.folder.glob("r2.journal*"):
        shutil.copy(path, path.with_name(path.name.replace("r2", "copy")))
    team.run(5.0)
    team.stop("r2")
    team.start("r2", journal="copy.journal")
    team.run(1.5)
    assert "two of one name: r2" in team.agents["r1"].estimate(team.air.now + STEP).rejected
    team.run(10.0)
    assert team.agents["r2"].remarks
    assert {"r2"} <= set(team.agents["r1"]._gossip.live(team.air.now))


def test_a_peer_whose_name_is_markup_is_shown_as_it_is() -> None:
    said = {
        "s_ago": 0.1, "sent_bytes_per_s": 1.0, "loss": {},
        "peers": {"[/]": {"status": "isolated", "pose": None, "position_sigma_m": None, "heading_sigma_deg": None,
                          "age_s": None}},
    }  # fmt: skip
    robot = {
        "says": said, "clock": {"ahead_s": None}, "same_team_file": True, "heard_s_ago": 0.1, "present": True,
        "rejected_here": {}, "lives_twice": [],
    }  # fmt: skip
    console = Console(record=True, width=100, file=io.StringIO())
    console.print(tables({"team": "lab", "robots": {"r1": robot}, "strangers": [], "nameless": 0}, None))
    assert "[/]" in console.export_text()
