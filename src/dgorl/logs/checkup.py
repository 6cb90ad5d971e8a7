"""What a log holds and what is odd about it, before one localises anybody with it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from statistics import median

from dgorl.configuration import Configuration, merge
from dgorl.crowds import PER_PAIR, second
from dgorl.findings import Finding, note, ok, problem
from dgorl.logs.clock_steps import clock_steps, path_of
from dgorl.logs.log import KINDS, Log
from dgorl.logs.plausibility import plausibility
from dgorl.measurements import Displacement, Measurement, Odometry, Range, RelativePose, known_at, robots_of
from dgorl.tracks import HELD

AREA = "log"
JUMP = 3600.0
"""A clock does not stand still for so long [s]: it was set."""
LATE = 10.0
"""Who begins or ends this much [s] before or after the others does so on its own."""
MUTUAL = {"range", "pose"}
"""Readings of these link both robots, whoever made them."""

Pair = tuple[str, str]
"""who made the reading, of whom"""


def checkup(log: Log) -> tuple[Finding, ...]:
    """Look at everything in a log that could be read."""
    return tuple(_all(log))


def _all(log: Log) -> Iterator[Finding]:
    own: dict[str, list[Measurement]] = {robot: [] for robot in log.robots}
    for measurement in log.measurements:
        own.setdefault(robots_of(measurement)[0], []).append(measurement)
    stamps = [known_at(measurement) for measurement in log.measurements]
    if not stamps:
        yield problem(AREA, f"{log.path}: has no measurements", "record odometry and ranges or RSSI")
        return
    first, last = min(stamps), max(stamps)
    names = ", ".join(log.robots)
    yield ok(AREA, f"{log.path}: {len(log.robots)} robots ({names}), {last - first:.1f} s from {first:.12g} s on")
    for reason, count in log.skipped.items():
        yield note(AREA, f"{count} left out: {reason}")
    rows = {robot: _rows(own[robot]) for robot in log.robots}
    for robot in log.robots:
        yield from _odometry(robot, rows[robot], log.rows.get(robot))
    configuration = merge(Configuration(), log.configuration, str(log.path))
    yield from plausibility(log, configuration)
    yield from _contacts(log)
    yield from _starts(log)
    yield from _clocks(log, own)
    if configuration.clock == "shared":
        yield from _odometry_clocks(log, rows)
        yield from _clock_steps(log, rows, configuration)


def _rows(measurements: Iterable[Measurement]) -> list[Odometry | Displacement]:
    return sorted((m for m in measurements if isinstance(m, Odometry | Displacement)), key=lambda m: m.start)


def _odometry(robot: str, rows: Sequence[Odometry | Displacement], counted: int | None) -> Iterator[Finding]:
    """counted: rows in the file, where one of them makes several measurements."""
    if not rows:
        advice = "record its odometry; a beacon that stands has rows of zeros"
        yield note(AREA, f"{robot}: no odometry, so nobody can locate it", advice)
        return
    count = len(rows) if counted is None else counted
    rate = count / ((rows[-1].end - rows[0].start) or 1.0)
    yield ok(AREA, f"{robot}: {count} rows of odometry, {rate:.1f} a second")
    gaps: list[tuple[float, float]] = []
    end = rows[0].end
    for row in rows[1:]:
        if row.start - end > HELD:
            gaps.append((row.start - end, end))
        end = max(end, row.end)
    if gaps:
        longest, at = max(gaps)
        times = f"{len(gaps)} times for over {HELD:g} s, longest for {longest:.1f} s from {at:.12g} s on"
        yield note(AREA, f"{robot}: odometry is missing {times}", "it is located anew after each")


def _contacts(log: Log) -> Iterator[Finding]:
    heard: dict[str, Counter[Pair]] = defaultdict(Counter)
    kinds: dict[str, type[Measurement]] = {**KINDS, "pose": RelativePose}
    for measurement in log.measurements:
        for name, of_kind in kinds.items():
            if isinstance(measurement, of_kind) and not getattr(measurement, "prior", False):
                a, b = robots_of(measurement)
                heard[name][(a, b)] += 1
    if len(log.robots) < 2:
        yield problem(AREA, "one robot alone: there is nobody to localise", "record two or more")
        return
    if not heard:
        yield problem(AREA, "no measurement between robots: nobody can be located", "record ranges or RSSI")
        return
    stamps = [known_at(measurement) for measurement in log.measurements]
    span = (max(stamps) - min(stamps)) or 1.0
    for kind, pairs in heard.items():
        rate = median(pairs.values()) / span
        yield ok(AREA, f"{kind}: {pairs.total()} readings in {len(pairs)} directions, median {rate:.2g} a second each")
    links: set[Pair] = set().union(*heard.values())
    links |= {(b, a) for kind in MUTUAL & heard.keys() for a, b in heard[kind]}
    yield from _crowds(log)
    yield from _silences(log, links)
    yield from _groups(log.robots, links)


def _crowds(log: Log) -> Iterator[Finding]:
    """Who says more in one second than counts."""
    seconds: Counter[tuple[str, Pair, int]] = Counter()
    for measurement in log.measurements:
        kind = next((name for name, of_kind in KINDS.items() if isinstance(measurement, of_kind)), None)
        if kind is not None:
            a, b = robots_of(measurement)
            seconds[kind, (a, b), second(known_at(measurement))] += 1
    most: dict[str, tuple[int, Pair]] = {}
    for (kind, pair, _), count in seconds.items():
        most[kind] = max(most.get(kind, (0, pair)), (count, pair))
    for kind, (count, (a, b)) in most.items():
        if count > PER_PAIR:
            what = f"{kind}: {a} measured {b} up to {count} times in a second, of which {PER_PAIR} count"
            yield note(AREA, what, "a sample of them is taken; readings so close share their errors anyway")


def _silences(log: Log, links: set[Pair]) -> Iterator[Finding]:
    """Who never hears whom, of robots that hear anybody."""
    linked = {robot for pair in links for robot in pair}
    for robot in log.robots:
        deaf = [other for other in log.robots if other != robot and (robot, other) not in links]
        one_way = [other for other in deaf if (other, robot) in links]
        never = [other for other in deaf if other > robot and other not in one_way and {robot, other} <= linked]
        if never:
            what = f"{robot} and {', '.join(never)} never hear each other"
            yield note(AREA, what, "they are located over others alone")
        if one_way:
            yield note(AREA, f"{robot} never hears {', '.join(one_way)}, who hear it")


def _groups(robots: Iterable[str], links: set[Pair]) -> Iterator[Finding]:
    """Robots that no chain of readings links."""
    group = {robot: {robot} for robot in robots}
    for a, b in links:
        if a in group and b in group and group[a] is not group[b]:
            group[a] |= group[b]
            for member in group[a]:
                group[member] = group[a]
    groups = sorted({frozenset(members) for members in group.values()}, key=lambda g: (-len(g), sorted(g)))
    for members in groups[1:]:
        names = ", ".join(sorted(members))
        others = "it" if len(members) == 1 else "them"
        yield problem(AREA, f"no reading links {names} to the others: nobody can locate {others}", "check these radios")


def _starts(log: Log) -> Iterator[Finding]:
    without = [robot for robot in log.robots if robot not in log.starts]
    if without:
        yield note(AREA, f"no start pose of {', '.join(without)}: `--initial known` cannot be used")
    else:
        yield ok(AREA, "start poses of all robots")
    if not log.truth:
        yield note(AREA, "no ground truth: errors cannot be scored", "`dgorl run --truth FILE` takes one")


def _clocks(log: Log, own: Mapping[str, list[Measurement]]) -> Iterator[Finding]:
    spans = {}
    for robot, measurements in own.items():
        stamps = sorted(map(known_at, measurements))
        if not stamps:
            continue
        spans[robot] = stamps[0], stamps[-1]
        jump, at = max(((b - a, a) for a, b in pairwise(stamps)), default=(0.0, 0.0))
        if jump > JUMP:
            yield problem(AREA, f"{robot}: its clock jumps by {jump:.0f} s at {at:.12g} s", "correct its later stamps")
    if log.configuration.get("clock") == "estimated":
        return
    for robot, (first, last) in spans.items():
        others = [span for name, span in spans.items() if name != robot]
        if not others:
            return
        begin, end = median(a for a, _ in others), median(b for _, b in others)
        if first > end or last < begin:
            yield problem(
                AREA,
                f"{robot}: stamped {first:.12g} to {last:.12g} s, at no time with the others "
                f"({begin:.12g} to {end:.12g} s): the clocks differ by {abs(first - begin):.0f} s",
                f"its clock is off by about {first - begin:+.1f} s: correct its stamps",
            )
        elif abs(first - begin) > LATE or abs(last - end) > LATE:
            yield note(
                AREA, f"{robot}: there from {first:.12g} to {last:.12g} s, most from {begin:.12g} to {end:.12g} s"
            )


def _odometry_clocks(log: Log, rows: Mapping[str, Sequence[Odometry | Displacement]]) -> Iterator[Finding]:
    """Robots whose odometry is stamped at no time at which anybody measures them."""
    named: dict[str, list[float]] = defaultdict(list)
    for m in log.measurements:
        if not isinstance(m, Odometry | Displacement | RelativePose):
            for robot in robots_of(m):
                named[robot].append(m.stamp)
    spans = {robot: (own[0].start, max(m.end for m in own)) for robot, own in rows.items() if own}
    for robot, (first, last) in spans.items():
        if not named[robot] or (min(named[robot]) <= last + HELD and max(named[robot]) >= first - HELD):
            continue
        begin, end = min(named[robot]), max(named[robot])
        others = [span for name, span in spans.items() if name != robot] or [(begin, end)]
        off = (first + last - median(a for a, _ in others) - median(b for _, b in others)) / 2
        if abs(off) < HELD:  # all odometry is at another time than the readings
            off = first - begin
        yield problem(
            AREA,
            f"odometry of {robot} ({first:.12g} to {last:.12g} s) and the readings that name {robot} "
            f"({begin:.12g} to {end:.12g} s) share no time: the clocks differ by {abs(off):.0f} s",
            f"its odometry is off by about {off:+.1f} s: correct its stamps",
        )


def _clock_steps(
    log: Log, rows: Mapping[str, Sequence[Odometry | Displacement]], configuration: Configuration
) -> Iterator[Finding]:
    paths = {robot: path_of(own) for robot, own in rows.items() if own}
    ranges = [m for m in log.measurements if isinstance(m, Range)]
    for step in clock_steps(paths, ranges, configuration):
        bad, good = step.misfit
        yield problem(
            AREA,
            f"odometry of {step.robot} and the ranges that name {step.robot} disagree in time by {step.length:.1f} s "
            f"from {step.stamp:.12g} s on: they miss by {bad:.2g} m as stamped, by {good:.2g} m without the pause then",
            "a clock was set: correct the later stamps",
        )
