"""Why a team does not work, as far as one can tell who listens: who is missing, whose file, key or clock differs."""

from __future__ import annotations

import socket
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from statistics import median

from dgorl.findings import Finding, note, ok, problem
from dgorl.team.envelope import Reason
from dgorl.team.snapshot import clocks_ahead
from dgorl.team.team_file import TeamFile
from dgorl.team.watch import Seen, Watch

AREA = "network"
CLOCKS = "clocks"
APART = 0.1
"""Shared clocks are to agree within this [s]; the time a message takes is within it."""
ELSEWHERE = 60.0
"""Clocks this far from this machine's [s] are worth a word."""
GONE = 2.5
"""Who was heard this lately [s] may just have come, and be noticed in a moment."""
UNSURE = 0.02
"""A clock is placed with a σ below this [s]."""
PLACED = 3.0
"""Two robots that hear one another place their clocks within this [s]."""
LOSSY = 0.3
"""A link that loses more is bad."""
KNOCK = 1.0
"""An address is tried for so long [s]."""

WRONG = {
    Reason.VERSION: "robots run different versions of dgorl: install the same on all",
    Reason.CONFIGURATION: "copy one team.yaml to all robots and start their agents again",
    Reason.SIGNATURE: "somebody signs with a key that is not in team.yaml; see `dgorl keys --show`",
    Reason.TEAM: "another team's messages come on this team's keys",
    Reason.SENDER: "somebody speaks in another's name: look for who is on this network",
    Reason.OWN: "another machine runs under this robot's name: end one of the two",
    Reason.UNKNOWN: "a robot that is not in team.yaml sends to this team",
    Reason.RATE: "somebody sends more than any robot does",
    Reason.TOO_LARGE: "somebody sends what no robot does",
    Reason.MALFORMED: "somebody sends what no robot does",
    Reason.CONFLICT: "two machines run with copies of one journal, or a copy was put back: it begins anew by itself",
    Reason.ENDED: "another machine runs under its name, or did: it begins a new epoch once that one is silent",
    "bad line": "its sensors write lines it cannot read; its log says which",
    "journal": "its disk refuses to write; its log says why",
}
"""reason that should not occur → what it means; others are a bad network's doing"""


@dataclass(frozen=True)
class Heard:
    """What was heard of a team: present on the network, at ``now`` [s]; seconds: how long one listened.

    nameless: how many are present under names that no robot can have.
    """

    team: TeamFile
    watch: Watch
    present: Collection[str]
    now: float
    seconds: float
    nameless: int = 0


def diagnosis(heard: Heard, knock: Callable[[str], str] | None = None) -> tuple[Finding, ...]:
    """Look at everything. ``knock``: an endpoint → what happens when one connects to it."""
    return tuple(_all(heard, knock or knocked))


def _all(heard: Heard, knock: Callable[[str], str]) -> Iterator[Finding]:
    team, robots = heard.team, heard.watch.robots
    if team.insecure:
        yield note(AREA, f"team {team.team} signs nothing: whoever reaches the network can say anything", "use keys")
    there = [robot for robot in robots if robot in heard.present or robots[robot].epoch is not None]
    if not there:
        yield _nobody(heard)
    for robot, seen in robots.items():
        yield _here(heard, robot, seen) if robot in there else _missing(heard, robot, knock)
    for name in sorted({*heard.present, *heard.watch.strangers} - set(robots)):
        yield problem(AREA, f"{name} is on the network but not in {team.path}", "add it to `robots`, or end its agent")
    if nameless := heard.nameless or int(heard.watch.nameless > 0):
        what = f"{nameless} on the network under a name that no robot can have"
        yield problem(AREA, what, "no program of the team does that: look for who is on this network")
    for robot in there:
        yield from _differs(heard, robots[robot])
        yield from _says(robots[robot], robots)
    yield from _files(heard)
    yield from _clocks(heard)


def _nobody(heard: Heard) -> Finding:
    network = heard.team.transport
    if network.multicast:
        advice = f"is this machine in their network, and may multicast ({network.group}) pass? else set `addresses`"
    else:
        advice = "is this machine in their network, and are the addresses in team.yaml theirs?"
    return problem(AREA, f"nobody of team {heard.team.team} is heard from here", advice)


def _here(heard: Heard, robot: str, seen: Seen) -> Finding:
    if seen.epoch is not None:
        bulletin = seen.bulletin
        told = "" if bulletin is None else f", dgorl {bulletin.version}, {1e3 * bulletin.tick:.1f} ms an estimate"
        since = heard.now - seen.heard
        if robot not in heard.present and since > GONE:
            what = f"{robot} has left the network; it was heard {since:.1f} s ago"
            return problem(AREA, what, "its agent ended or its link broke; see its log")
        return ok(AREA, f"{robot} is on the network{told}")
    if Reason.SIGNATURE in seen.rejected:
        what = f"{robot} is on the network, but signs with another key than {heard.team.path} has for it"
        return problem(AREA, what, f"compare with `dgorl keys --show --robot {robot} --out FILE` there")
    if seen.rejected:
        reason = seen.rejected.most_common(1)[0][0]
        what = f"{robot} is on the network, but what it says is rejected: {seen.details[reason]}"
        return problem(AREA, what, WRONG.get(reason, "see its log"))
    what = f"{robot} is on the network, but was silent for {heard.seconds:g} s"
    return problem(AREA, what, "its agent hangs, or the network takes no more; listen longer with --seconds")


def _missing(heard: Heard, robot: str, knock: Callable[[str], str]) -> Finding:
    seen_by = sorted(
        other for other, seen in heard.watch.robots.items() if seen.bulletin and robot in seen.bulletin.present
    )
    if seen_by:
        what = f"{robot} is not heard here, but is on the network of {', '.join(seen_by)}"
        return problem(AREA, what, "no way leads from it to this machine: firewall, or another network")
    address = heard.team.transport.addresses.get(robot)
    tried = f" ({knock(address)})" if address else ""
    advice = f"does `dgorl agent --robot {robot}` run there? see its log"
    return problem(AREA, f"{robot} is not on the network{tried}", advice)


def knocked(endpoint: str) -> str:
    """What happens when one connects to a robot's endpoint, like tcp/10.0.0.1:7447."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdigit():
        return f"{endpoint} cannot be tried"
    try:
        with socket.create_connection((host.strip("[]"), int(port)), KNOCK):
            return f"{endpoint} answers: another team, other certificates, or a program that hangs"
    except socket.gaierror:
        return f"{endpoint}: no host of this name"
    except TimeoutError:
        return f"{endpoint} does not answer: machine off, or a firewall"
    except ConnectionRefusedError:
        return f"{endpoint}: the machine is there, no agent listens"
    except OSError as error:
        return f"{endpoint}: {error.strerror or error}"


def _files(heard: Heard) -> Iterator[Finding]:
    """Whose team file differs."""
    groups: dict[bytes, list[str]] = defaultdict(list)
    for robot, seen in heard.watch.robots.items():
        if seen.configuration is not None:
            groups[seen.configuration].append(robot)
    own = heard.team.configuration_hash
    others = {key: names for key, names in groups.items() if key != own}
    if groups and own not in groups and len(groups) == 1:
        what = f"{heard.team.path} here is not that of the team ({', '.join(*groups.values())})"
        yield problem(AREA, what, "copy theirs here; what they say is shown all the same")
        return
    for key, names in sorted(others.items()):
        what = f"{', '.join(names)}: another team.yaml (hash {key.hex()}, here {own.hex()})"
        yield problem(AREA, what, "those with different files reject one another: copy one to all, restart")
    if groups and not others:
        yield ok(AREA, f"all that are heard have this team.yaml (hash {own.hex()})")
    versions = {seen.bulletin.version for seen in heard.watch.robots.values() if seen.bulletin}
    if len(versions) > 1:
        yield note(AREA, f"versions of dgorl differ: {', '.join(sorted(versions))}", "install the same on all")


def _differs(heard: Heard, seen: Seen) -> Iterator[Finding]:
    """What was wrong with the messages of a robot that is heard."""
    if seen.returns > 1:
        what = f"{seen.robot} began anew {seen.returns} times in {heard.seconds:g} s"
        yield problem(AREA, what, "two machines run under this name, or its agent dies again and again")
    for reason, count in seen.rejected.items():
        if seen.epoch is not None and reason in WRONG:
            what = f"{count} messages as {seen.robot} rejected here: {seen.details[reason]}"
            yield problem(AREA, what, WRONG[reason])


def _says(seen: Seen, team: Collection[str]) -> Iterator[Finding]:
    """What a robot tells: rejections, losses."""
    bulletin = seen.bulletin
    if bulletin is None:
        return
    before = Counter(seen.earlier.rejected if seen.earlier else {})
    for reason, count in bulletin.rejected.items():
        grown = count - before[reason]
        what = f"{seen.robot} rejected {count} since it began, {grown} while listening: {reason}"
        meaning = WRONG.get(reason.partition(": ")[0])  # some name the robot
        if grown > 0 and meaning is not None:
            yield problem(AREA, what, meaning)
        else:
            yield note(AREA, what)
    lossy = [f"{robot} {100 * share:.0f} %" for robot, share in bulletin.losses.items() if share > LOSSY]
    if lossy:
        yield note(AREA, f"{seen.robot} loses much of what it is sent: {', '.join(lossy)}")
    unheard = sorted(bulletin.present & set(team) - set(bulletin.losses))
    if unheard:
        yield note(AREA, f"{seen.robot} hears nothing it takes from {', '.join(unheard)}, who are on its network")


def _clocks(heard: Heard) -> Iterator[Finding]:
    ahead = clocks_ahead(heard.team, heard.watch, heard.now)
    if heard.team.configuration.clock == "estimated":
        yield from _estimated(heard, ahead)
        return
    if len(ahead) > 1:
        off = {robot: value for robot, (value, _) in ahead.items() if abs(value) > APART}
        for robot, value in off.items():
            what = f"{robot}: its clock is {value:+.3f} s off the team's median"
            yield problem(CLOCKS, what, "synchronise clocks (NTP, PTP), or set `clock: estimated` in team.yaml")
        if not off:
            spread = max(abs(value) for value, _ in ahead.values())
            yield ok(CLOCKS, f"clocks agree within {spread:.3f} s, as far as messages tell")
    offsets = [seen.ahead for seen in heard.watch.robots.values() if seen.ahead is not None]
    if offsets and abs(median(offsets)) > ELSEWHERE:
        what = f"the team's clocks are {median(offsets):+.0f} s off this machine's"
        yield note(CLOCKS, what, "clocks that were not set; or somebody repeats what was said long ago")


def _estimated(heard: Heard, ahead: Mapping[str, tuple[float, float | None]]) -> Iterator[Finding]:
    for robot, seen in heard.watch.robots.items():
        if seen.bulletin is None:
            continue
        if robot not in ahead:
            what = f"{robot}: its clock is not placed yet"
            yield problem(CLOCKS, what, "it has to hear the team, and the team it, for some seconds")
            continue
        value, sigma = ahead[robot]
        said = f"{robot}: its clock is {value:+.3f} s ahead of the team's, ± {sigma or 0.0:.4f} s"
        if (sigma or 0.0) > UNSURE:
            yield note(CLOCKS, said, "not sure yet: messages must pass both ways")
        else:
            yield ok(CLOCKS, said)
    yield from _unplaced(heard.watch.robots)


def _unplaced(robots: Mapping[str, Seen]) -> Iterator[Finding]:
    """Whose clocks a robot could not place, though it has had the time, or has not had it."""
    for robot, seen in robots.items():
        now, before = seen.bulletin, seen.earlier
        if now is None or before is None:
            continue
        unplaced = sorted(now.present & set(robots) - set(now.clocks))
        if not unplaced:
            continue
        what = f"{robot} cannot place the clock of {', '.join(unplaced)}"
        if now.stamp - before.stamp >= PLACED and set(unplaced) <= before.present - set(before.clocks):
            yield problem(CLOCKS, what, "messages must pass both ways between them; see losses and rejections")
        else:
            yield note(CLOCKS, f"{what} yet")
