"""The errors DGORL raises. The library raises; only ``cli/`` prints or exits."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from dgorl.printable import printable

QUOTED = 80
"""Characters of somebody's file that a message repeats at most."""


def brief(text: object) -> str:
    """What stands in somebody's file, for a message: escaped, its beginning alone when it is long."""
    short = printable(str(text)[: QUOTED + 1])
    return short if len(short) <= QUOTED else f"{short[: QUOTED - 1]}…"


def quoted(text: object) -> str:
    """The same in backticks."""
    return f"`{brief(text)}`"


def pip_install(*packages: str) -> str:
    """The command that installs packages where this program runs, whatever environment is active."""
    return shlex.join([sys.executable or "python3", "-m", "pip", "install", *packages])


class DgorlError(Exception):
    """Root of everything DGORL raises on purpose: what is wrong, where, what to do."""


class ConfigurationError(DgorlError):
    """A configuration that cannot be used: unknown key, wrong type, value out of range."""


class MeasurementError(DgorlError, ValueError):
    """A measurement that can not be true: NaN, infinity, a negative range, time running backwards."""


class MissingExtraError(DgorlError):
    """An optional package is not installed; the message says how to install it."""


class LogError(DgorlError):
    """A log that cannot be read: ``FILE:LINE: what is wrong``."""

    def __init__(self, path: str | Path, line: int | None, what: str) -> None:
        self.path, self.line = Path(path), line
        super().__init__(printable(f"{path}:{line}: {what}" if line is not None else f"{path}: {what}"))
