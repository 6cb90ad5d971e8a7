"""Structured logs: one JSON object a line on stderr, whatever comes, and little of what comes again and again."""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from types import TracebackType
from typing import Any

from dgorl.printable import printable
from dgorl.team.repeats import Repeats

log = logging.getLogger("dgorl.agent")


MANY = "dgorl.agent", logging.WARNING, "many kinds of trouble", None


class JsonLines(logging.Formatter):
    """One JSON object a record: time, level, robot, event, and the record's ``fields``."""

    def __init__(self, robot: str) -> None:
        super().__init__()
        self._robot = robot

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        said: dict[str, Any] = {
            "time": round(record.created, 3),
            "level": record.levelname.lower(),
            "robot": self._robot,
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            said["exception"] = self.formatException(record.exc_info)
        return printable(json.dumps(said, ensure_ascii=False, separators=(",", ":"), default=str))


class Seldom(logging.StreamHandler[Any]):
    """Tells warnings and errors of a kind once, then how many came in a minute.

    A record's kind is its message, level and ``kind``, if it has one.
    """

    def __init__(self, stream: Any = None) -> None:
        super().__init__(stream)
        self._repeats = Repeats()

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count it."""
        kind = record.name, record.levelno, record.getMessage(), getattr(record, "kind", None)
        if record.levelno < logging.WARNING or self._repeats.first(kind, time.monotonic()):
            super().emit(record)

    def tell(self, *, all_of_it: bool = False) -> None:
        """Write how often came again what was told before, a minute ago or, if this is the end, whenever."""
        with self.lock or threading.Lock():
            for kind, times, seconds in self._repeats.due(time.monotonic(), all_of_it=all_of_it):
                name, level, event, more = kind if isinstance(kind, tuple) else MANY
                record = logging.LogRecord(name, level, "", 0, "%s", (event,), None)
                record.fields = {"times": times, "within_s": round(seconds, 1), **({"of": more} if more else {})}
                super().emit(record)


def log_to_stderr(robot: str, level: str) -> None:
    """Structured logs of this process, from ``level`` on; what Python itself has to say among them."""
    handler = Seldom(sys.stderr)
    handler.setFormatter(JsonLines(robot))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    logging.captureWarnings(True)
    sys.excepthook = _unexpected
    threading.excepthook = lambda told: _unexpected(told.exc_type, told.exc_value, told.exc_traceback)


def tell_repeats(*, all_of_it: bool = False) -> None:
    """Call it once a second, and at the end: counts of what came again."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, Seldom):
            handler.tell(all_of_it=all_of_it)


def _unexpected(kind: type[BaseException], error: BaseException | None, trace: TracebackType | None) -> None:
    """What nobody caught."""
    if error is not None:
        log.critical("an error in the program; please report it", exc_info=(kind, error, trace))
