"""What comes from outside, fit for a terminal, a log or a page: escaped once, where it leaves.

A file, a robot or a stranger on the network may have written any character into a name or a reason: escape sequences
that clear a screen, line breaks that forge a line, marks that turn the direction of writing.
"""

from __future__ import annotations

import json
from typing import Any

MARKS = "✓✗"
"""Who looks at a report trusts these at the beginning of a line: they are the program's alone."""


def printable(text: str) -> str:
    r"""The text with all that is no visible character (Unicode's "other" and "separator", but the space) as ``\u001b``.

    ``MARKS`` too. JSON stays JSON and means the same. What is printable already comes back as it is.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if c.isprintable() and c not in MARKS else json.dumps(c)[1:-1] for c in text)


def printable_line(line: bytes) -> bytes:
    """A line of JSON, as it may be shown."""
    if line.isascii() and b"\x7f" not in line:
        return line
    return printable(line.decode(errors="replace")).encode()


def json_line(value: Any) -> str:
    """A value as one line of JSON, as it may be shown. Raises ValueError for NaN and infinity."""
    return printable(json.dumps(value, ensure_ascii=False, allow_nan=False))
