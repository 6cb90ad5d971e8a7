"""Structured logs: one JSON object a line on stderr."""

from __future__ import annotations

import json
import logging
import sys
from typing import Any

from dgorl.printable import printable


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


def log_to_stderr(robot: str, level: str) -> None:
    """Structured logs of this process, from ``level`` on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines(robot))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
