"""What a check found: one line, how bad it is, what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How bad it is: as it should be, worth knowing, to be put right."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
    """One line of ``dgorl doctor``. area: what was looked at. advice: the next step, empty when there is none."""

    area: str
    level: Level
    what: str
    advice: str = ""


def ok(area: str, what: str) -> Finding:
    """All is well."""
    return Finding(area, Level.OK, what)


def note(area: str, what: str, advice: str = "") -> Finding:
    """Worth knowing."""
    return Finding(area, Level.NOTE, what, advice)


def problem(area: str, what: str, advice: str) -> Finding:
    """To be put right."""
    return Finding(area, Level.PROBLEM, what, advice)
