"""A live robot's journal as a log: what it admitted, in its order, and the ticks at which it looked."""

from __future__ import annotations

from pathlib import Path

from dgorl.errors import LogError
from dgorl.logs.log import Live, Log, Part, Start, Step, in_order
from dgorl.measurements import WORLD
from dgorl.team.bundles import Bundle
from dgorl.team.journal_read import Story, contents


def read_journal(path: Path) -> Log:
    """The log of a journal. Its settings are those of its last run; runs under others are left out and counted.

    Raises LogError for one that cannot be read or has no tick.
    """
    journal = contents(path)
    stories = [story for story in journal.stories if story.ticks]
    if not stories:
        raise LogError(path, None, "an empty journal: the agent never came to a tick")
    last = stories[-1].run
    told = [s for s in stories if (s.run.settings, s.run.starts) == (last.settings, last.starts)]
    bundles = {b.name: b for story in told for tick in story.ticks for b in tick.bundles}
    skipped = {
        "ticks under other settings": sum(len(s.ticks) for s in stories if s not in told),
        "entries dropped by rotation": journal.dropped,
    }
    return Log(
        path=path,
        robots=tuple(sorted({bundle.robot for bundle in bundles.values()} | {journal.robot})),
        measurements=in_order(m for bundle in bundles.values() for m in bundle.measurements),
        starts={s.robot: Start(s.stamp, (s.x, s.y, s.theta)) for s in last.starts if s.reference == WORLD},
        configuration=last.settings,
        skipped={reason: count for reason, count in skipped.items() if count},
        live=Live(journal.robot, tuple(step for story in told for step in _steps(journal.robot, story))),
    )


def _steps(robot: str, story: Story) -> list[Step]:
    """The ticks of one start of the agent, known starts with the first."""
    estimated = story.run.settings.get("clock", "shared") == "estimated"
    steps = [Step(tick.now, tuple(_part(bundle, estimated) for bundle in tick.bundles)) for tick in story.ticks]
    first = steps[0]
    return [Step(first.now, (Part(story.run.given), *first.admitted), started=(robot, story.run.epoch)), *steps[1:]]


def _part(bundle: Bundle, estimated: bool) -> Part:
    clock = (bundle.robot, bundle.epoch) if estimated else None
    return Part(bundle.measurements, clock, bundle.clocks if estimated else ())
