"""The consoles commands print on: what they are given is shown as it is, its control characters escaped."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from dgorl.printable import printable


def terminal(*, stderr: bool = False, width: int | None = None) -> Console:
    """stdout or stderr, without rich's markup: brackets and colons in a name are that."""
    return Console(stderr=stderr, width=width, highlight=False, markup=False, emoji=False)


def words(text: str, style: str = "") -> Text:
    """Text that may hold what came from outside: no control character leaves, and no mark but the program's own."""
    return Text(printable(text), style=style)
