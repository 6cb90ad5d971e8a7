"""Every way to come back ends with everybody hearing everybody, without a person. Virtual time, chance by seed."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dgorl.team.bundles import Bundle
from dgorl.team.envelope import Reason
from dgorl.team.faults import Faults
from dgorl.team.messages import Bundles, write
from dgorl.team.wire import seal
from dgorl.team.witness import BURST, COPY, OUTLIVED, QUIET

from ..team_network import CONFIGURATION, TEAM, Disk, Network, Robot

SOON = 15.0
"""So long [s] after the last start all are back."""


def started(count: int = 3, **options: object) -> Network:
    network = Network(count, signed=True, **options)  # type: ignore[arg-type]
    network.start(*network.names)
    network.run(8.0)
    return network


def together(network: Network) -> None:
    """Everybody counts everybody's messages, and has what the others measured lately."""
    for robot in network.robots.values():
        for other in network.robots.values():
            if other is not robot:
                assert robot.gossip._library.admission.current(other.name) == other.epoch, (robot.name, other.name)
                assert other.name in robot.gossip.live(network.now), (robot.name, other.name)
                numbers = {n.sequence for n in robot.known if (n.robot, n.epoch) == (other.name, other.epoch)}
                assert max(numbers, default=-1) >= other.made - 3, (robot.name, other.name)


def rejected(network: Network, reason: str) -> int:
    return sum(robot.gossip.rejected[reason] for robot in network.robots.values())


def test_with_its_own_journal_it_goes_on_in_its_epoch() -> None:
    network = started()
    disk = network.stop("r1").disk()
    network.run(4.0)
    network.start("r1", journal=disk)
    network.run(SOON)
    together(network)
    assert network.robots["r1"].epoch == disk.epoch
    assert not network.robots["r1"].endings


@pytest.mark.parametrize("off", [0.5, 20.0, 400.0])
def test_with_a_journal_it_has_outlived_it_begins_a_new_epoch(off: float) -> None:
    network = started(history=60.0)
    first = network.stop("r1").disk()
    network.run(2.0)
    network.start("r1")
    network.run(12.0)
    between = network.stop("r1")
    network.run(off)
    network.start("r1", journal=first)
    network.run(SOON)
    together(network)
    r1 = network.robots["r1"]
    assert r1.endings == [OUTLIVED]
    assert r1.epoch not in (first.epoch, between.epoch)
    assert rejected(network, Reason.ENDED) > 0


@pytest.mark.parametrize("lived", [2.0, 100.0])
def test_with_an_older_copy_it_begins_a_new_epoch_before_long(lived: float) -> None:
    network = started(history=30.0)
    older = network.robots["r1"].disk()
    network.run(lived)
    network.stop("r1")
    network.run(2.0)
    network.start("r1", journal=older)
    network.run(SOON)
    together(network)
    assert network.robots["r1"].endings == [COPY]
    named = f"{Reason.CONFLICT}: r1"
    assert rejected(network, named) > 0, "until then it has used numbers twice"
    for name in ("r2", "r3"):
        assert set(network.robots[name].gossip.rejected) <= {named}


def test_after_an_older_copy_was_shelved_for_long_too() -> None:
    """Its numbers are not kept any more, but that its later bundles have lower ones tells all the same."""
    network = started(history=20.0)
    older = network.robots["r1"].disk()
    network.run(20.0)
    network.stop("r1")
    network.run(300.0)
    network.start("r1", journal=older)
    network.run(SOON)
    together(network)
    assert network.robots["r1"].endings == [COPY]


@pytest.mark.parametrize("copied", [False, True])
def test_a_twin_that_lives_beside_it_for_a_while(copied: bool) -> None:
    network = started()
    network.start_twin("r1", network.robots["r1"].disk() if copied else None)
    network.run(40.0)
    epochs = network.robots["r1"].endings + network.twins["r1"].endings
    assert len(epochs) <= 2 + BURST, "the one that began last counts, the other waits"
    network.stop("r1", twin=True)
    network.run(SOON)
    together(network)


def test_all_at_once_with_older_copies() -> None:
    network = started(4)
    older = {name: network.robots[name].disk() for name in network.names}
    network.run(20.0)
    for name in network.names:
        network.stop(name)
    for name in network.names:
        network.start(name, journal=older[name])
    network.run(2 * SOON)
    together(network)


@pytest.mark.parametrize("seed", range(2))
def test_where_half_of_the_messages_get_lost(seed: int) -> None:
    network = Network(3, Faults(loss=0.5, delay=(0.0, 0.3), seed=seed), signed=True, seed=seed)
    network.start(*network.names)
    network.run(15.0)
    first = network.stop("r1").disk()
    network.start("r1")
    network.run(15.0)
    network.stop("r1")
    network.start("r1", journal=first)
    network.run(2 * SOON)
    together(network)
    assert network.robots["r1"].endings == [OUTLIVED]


Step = tuple[str, str, float, float]
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["r1", "r2"]),
        st.sampled_from(["journal", "new", "older", "first", "twin", "copied twin"]),
        st.sampled_from([0.0, 1.0, 8.0, 50.0]),
        st.sampled_from([1.0, 5.0, 12.0]),
    ),
    min_size=1,
    max_size=5,
)


@given(STEPS, st.integers(2, 3))
@settings(max_examples=6, deadline=None)
def test_any_restarts_one_after_another(steps: list[Step], count: int) -> None:
    network = started(count, history=30.0)
    disks: dict[str, list[Disk]] = {name: [robot.disk()] for name, robot in network.robots.items()}
    for name, kind, off, on in steps:
        if "twin" in kind:
            network.start_twin(name, network.robots[name].disk() if kind == "copied twin" else None)
            network.run(on)
            network.stop(name, twin=True)
            network.run(off)
            continue
        last = network.stop(name).disk()
        network.run(off)
        disk = {"journal": last, "new": None, "older": disks[name][-1], "first": disks[name][0]}[kind]
        network.start(name, journal=disk)
        network.run(on)
        disks[name].append(network.robots[name].disk())
    network.run(70.0)
    together(network)


# ---- who is believed ----


def bundle_of(network: Network, robot: Robot, epoch: int, sequence: int, cut: float) -> bytes:
    return seal(Bundle(TEAM, robot.name, epoch, sequence, 0, cut), network.keys[robot.name]).data


def shown(network: Network, sender: str, sealed: list[bytes]) -> None:
    """A member shows r1 bundles."""
    member, stamp = network.robots[sender], network.now + 0.01
    payload = write(Bundles(TEAM, sender, member.epoch, stamp, 0, CONFIGURATION, sealed), member.signer)
    network.robots["r1"].gossip.receive("bundles", sender, payload, network.now)


def test_what_was_recorded_before_ends_no_epoch() -> None:
    """A member plays back all the robot has ever signed in earlier epochs."""
    network = started()
    before = network.stop("r1")
    network.start("r1")
    network.run(8.0)
    for sealed in list(before.journal.values()):
        if sealed.bundle.robot == "r1":
            shown(network, "r2", [sealed.data])
            network.run(0.1)
    network.run(2 * QUIET)
    assert not network.robots["r1"].endings
    together(network)


def test_a_member_forges_no_end() -> None:
    network = started()
    r1, r2 = network.robots["r1"], network.robots["r2"]
    for epoch, sequence in ((r1.epoch, r1.made + 10), (99, 0)):
        forged = seal(Bundle(TEAM, "r1", epoch, sequence, 0, network.now + 5.0), r2.signer).data
        shown(network, "r2", [forged])
        network.run(2 * QUIET)
    assert not r1.endings
    assert r1.gossip.rejected[Reason.SIGNATURE] == 2


def test_whoever_has_its_key_cannot_make_it_begin_again_and_again() -> None:
    network = started()
    first = network.robots["r1"]
    for k in range(60):
        shown(network, "r2", [bundle_of(network, first, 1000 + k, 0, network.now)])
        network.run(QUIET + 0.5)
    assert 0 < len(network.robots["r1"].endings) <= BURST + 4


def test_two_contents_under_one_name_are_noticed_named_and_distrusted() -> None:
    network = started()
    r1, r2, r3 = (network.robots[name] for name in network.names)
    second = bundle_of(network, r2, r2.epoch, 3, 2.0)
    shown(network, "r3", [second])
    network.run(5.0)
    named = f"{Reason.CONFLICT}: r2"
    assert r1.gossip.rejected[named] > 0
    assert r3.gossip.rejected[named] > 0, "who sees both tells the others"
    assert "r2" not in r1.gossip.live(network.now + 6.0) or network.robots["r2"].endings
    network.run(SOON)
    assert network.robots["r2"].endings == [COPY]
    assert (r2.name, r2.epoch) not in r1.gossip.holds()
    together(network)
