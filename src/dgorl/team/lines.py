"""Lines in and out of a process, by descriptor and unbuffered.

A thread that waits in a buffered stream would hold a lock which the interpreter wants as it ends.
"""

from __future__ import annotations

import logging
import os
import queue
import threading
from collections.abc import Iterator

from dgorl.printable import printable_line
from dgorl.team.intake import LONGEST_LINE

WAITING = 10_000
"""Lines that wait to be read, or written, at most."""

log = logging.getLogger("dgorl.agent")


class LinesIn:
    """An iterable of the lines that come in, without blank ones; of one that is too long, only the beginning."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._rest = bytearray()

    def __iter__(self) -> Iterator[bytes]:
        """Waits for each. Who iterates anew goes on with the next line."""
        rest = self._rest
        while True:
            while (end := rest.find(b"\n")) >= 0:
                line = bytes(rest[:end])
                del rest[: end + 1]
                if line.strip():
                    yield line
            if len(rest) > LONGEST_LINE:
                del rest[LONGEST_LINE + 1 :]
            data = os.read(self._descriptor, 65536)
            if not data:
                break
            rest += data
        if rest.strip():
            yield bytes(rest)
        rest.clear()


class LinesOut:
    """Writes lines from a thread of its own: a reader that is slow or gone does not stop the robot."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._queue: queue.Queue[bytes | None] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def write(self, line: bytes) -> None:
        """Queue a line of JSON; dropped when too many wait."""
        try:
            self._queue.put_nowait(printable_line(line))
        except queue.Full:
            log.warning("nobody reads what is said: a line is lost")

    def close(self) -> None:
        """Write what is queued, if anybody reads it within a second."""
        try:
            self._queue.put(None, timeout=1.0)
        except queue.Full:
            return
        self._thread.join(1.0)

    def _run(self) -> None:
        while (line := self._queue.get()) is not None:
            data = line + b"\n"
            try:
                while data:
                    data = data[os.write(self._descriptor, data) :]
            except OSError:  # the reader has left; the robot has not
                continue
