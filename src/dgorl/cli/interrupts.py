"""Ctrl-C ends a command for certain."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

AGAIN = 1.0
"""An interrupt that has not ended the command is repeated every so many seconds."""


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt here, and again until it has got through.

    Python drops an exception that comes while it runs a destructor or a callback of the garbage collector, and code
    that catches all exceptions swallows it; the command would run on. A process told to ignore SIGINT still does.
    """
    if not hasattr(signal, "setitimer") or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
        if number == signal.SIGINT or not isinstance(sys.exc_info()[1], KeyboardInterrupt):  # or it is clearing up
            raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGALRM)}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
