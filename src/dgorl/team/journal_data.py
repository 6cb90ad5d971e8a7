"""What an estimate was made of, as the ``data`` column says it, and the same estimate made again from journals."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path

from dgorl.configuration import Configuration
from dgorl.estimate import Estimate
from dgorl.localizer import Localizer
from dgorl.measurements import RelativePose, known_at
from dgorl.nodes import Memo
from dgorl.team.bundles import Bundle, Name
from dgorl.team.journal_read import Contents, contents
from dgorl.team.journal_schema import JournalError, hexadecimal
from dgorl.team.ranges import Ranges

Held = Mapping[tuple[str, int], Ranges]
"""(robot, epoch) → sequence numbers."""

PATTERN = re.compile(r"(?P<robot>\S+):(?P<epoch>[0-9a-f]{16})\.(?P<ranges>\d+-\d+(\+\d+-\d+)*)")


def held(names: Iterable[Name]) -> dict[tuple[str, int], Ranges]:
    """Names of bundles by robot and epoch."""
    found: dict[tuple[str, int], Ranges] = {}
    for robot, epoch, sequence in names:
        found.setdefault((robot, epoch), Ranges()).add(sequence)
    return found


def ranges(admitted: Held) -> str:
    """``robot:epoch.FIRST-LAST[+FIRST-LAST]`` of every robot and epoch, sorted, blanks between; epochs hexadecimal."""
    return " ".join(
        f"{robot}:{hexadecimal(epoch)}." + "+".join(f"{first}-{last}" for first, last in numbers)
        for (robot, epoch), numbers in sorted(admitted.items(), key=lambda item: item[0])
        if numbers
    )


def parse(data: str) -> dict[tuple[str, int], Ranges]:
    """What :func:`ranges` wrote. Raises JournalError for anything else."""
    found: dict[tuple[str, int], Ranges] = {}
    for word in data.split():
        match = PATTERN.fullmatch(word)
        if match is None:
            raise JournalError(f"`{word}` is not robot:epoch.FIRST-LAST[+FIRST-LAST]")
        intervals = [tuple(map(int, part.split("-"))) for part in match["ranges"].split("+")]
        found[match["robot"], int(match["epoch"], 16)] = Ranges((first, last) for first, last in intervals)
    return found


def recompute(
    journals: Iterable[str | Path | Contents],
    data: str,
    now: float,
    robot: str,
    configuration: Configuration,
    starts: Sequence[RelativePose] = (),
) -> Estimate:
    """What ``robot`` estimated at ``now`` [s] out of ``data``, which the journals hold together.

    starts: known starts it admitted, so none that were older than the history when its program began. The order in
    which bundles were admitted does not matter (METHOD §1).
    Raises JournalError when the journals lack bundles, and where clocks are estimated, as what readings made of the
    stamps depends on when they came; LogError for a journal that cannot be read.
    """
    if configuration.clock != "shared":
        raise JournalError("with `clock: estimated` replay the robot's own journal instead")
    localizer = Localizer(robot, configuration)
    for start in starts:
        localizer.add(start)
    bundles = sorted(_chosen(journals, parse(data)), key=_known)
    for due, group in groupby(bundles, key=lambda bundle: Memo.due(_known(bundle))):
        together = list(group)
        for bundle in together:
            for measurement in bundle.measurements:
                localizer.add(measurement)
        if due < Memo.due(now):  # in time, or it would count as too late
            localizer.update(_known(together[-1]))
    return localizer.update(now)


def _chosen(journals: Iterable[str | Path | Contents], wanted: Held) -> list[Bundle]:
    found = {
        name: bundle
        for journal in journals
        for name, bundle in (journal if isinstance(journal, Contents) else contents(journal)).bundles.items()
        if name.sequence in wanted.get((name.robot, name.epoch), ())
    }
    there = held(found)
    missing = {origin: numbers.minus(there.get(origin, Ranges())) for origin, numbers in wanted.items()}
    if any(missing.values()):
        raise JournalError(f"the journals lack bundles: {ranges(missing)}")
    return [bundle for bundle in found.values() if bundle.measurements]


def _known(bundle: Bundle) -> float:
    return max(known_at(m) for m in bundle.measurements)
