"""What a journal holds, read without disturbing the agent that may be writing it."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import msgspec

from dgorl.errors import LogError
from dgorl.logs.team import valid_name
from dgorl.team.bundles import Bundle, Name
from dgorl.team.envelope import Rejected, unwrap
from dgorl.team.journal_schema import LARGEST_BUNDLE, JournalError, Kind, Run, connect, facts_of
from dgorl.team.keys import Roster
from dgorl.team.wire import content, peek


@dataclass(frozen=True)
class Admitted:
    """An update at ``now`` [s] and the bundles admitted since the one before, in that order."""

    now: float
    bundles: tuple[Bundle, ...]


@dataclass(frozen=True)
class Story:
    """One start of the agent and its ticks."""

    run: Run
    ticks: tuple[Admitted, ...]


@dataclass(frozen=True)
class Contents:
    """A whole journal. bundles: all that were made or heard, admitted or not. dropped: entries lost to rotation."""

    path: Path
    team: str
    robot: str
    stories: tuple[Story, ...]
    bundles: Mapping[Name, Bundle]
    dropped: int


def contents(path: str | Path) -> Contents:
    """Read a journal; its signatures were checked when it was written. Raises LogError for one that cannot be read."""
    path = Path(path)
    try:
        with closing(_connected(path)) as database:
            facts = facts_of(database)
            found = _contents(path, facts["team"], facts["robot"], database)
    except JournalError as error:
        raise LogError(path, None, str(error)) from error
    except (sqlite3.Error, KeyError) as error:
        raise LogError(path, None, f"cannot be read as a journal: {error}") from error
    named = {found.robot, *(name for story in found.stories for name in story.run.robots)}
    if strange := sorted(name for name in named if not valid_name(name)):
        raise LogError(path, None, f"`{strange[0]}` cannot be a robot's name: nothing that dgorl wrote")
    return found


def _connected(path: Path) -> sqlite3.Connection:
    """Read only; without the right to write beside it, as it stands."""
    database = connect(path, "ro")
    try:
        database.execute("SELECT count(*) FROM facts").fetchone()
    except sqlite3.OperationalError:
        database.close()
        if path.with_name(path.name + "-wal").exists():
            raise
        return connect(path, "ro&immutable=1")
    return database


def _contents(path: Path, team: str, robot: str, database: sqlite3.Connection) -> Contents:
    bundles: dict[int, Bundle] = {}
    stories: list[tuple[Run, list[Admitted]]] = []
    roster = Roster(team, {}, insecure=True)
    dropped, previous = 0, 0
    for number, kind, now, body in database.execute("SELECT number, kind, now, body FROM entries ORDER BY number"):
        dropped, previous = dropped + number - previous - 1, number
        try:
            match kind:
                case Kind.RUN:
                    run = msgspec.json.decode(body, type=Run)
                    roster = Roster(team, dict.fromkeys(run.robots), insecure=True)
                    stories.append((run, []))
                case Kind.BUNDLE:
                    bundles[number] = content(peek(unwrap(body, LARGEST_BUNDLE)[1], roster), roster)
                case Kind.TICK:
                    numbers = msgspec.msgpack.decode(body, type=list[int])
                    stories[-1][1].append(Admitted(now, tuple(bundles[n] for n in numbers if n in bundles)))
        except (Rejected, msgspec.MsgspecError, IndexError) as error:
            raise LogError(path, None, f"entry {number} cannot be read: {error}") from error
    return Contents(
        path,
        team,
        robot,
        tuple(Story(run, tuple(ticks)) for run, ticks in stories),
        {bundle.name: bundle for bundle in bundles.values()},
        dropped,
    )
