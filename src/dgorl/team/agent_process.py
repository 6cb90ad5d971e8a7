"""An agent's process as a fleet has it: started ahead of its time, fed on stdin, killed as by a power cut."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from dgorl.errors import DgorlError
from dgorl.team.pace import READY

BOOT = 60.0
"""An agent that is not ready after this long [s] never will be."""


class AgentProcess:
    """Begins to start at once. reports, messages: where stdout and stderr are added to."""

    def __init__(self, command: Sequence[str], reports: Path, messages: Path) -> None:
        self._messages = messages
        with reports.open("ab") as out, messages.open("ab") as errors:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=errors,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl-C is the fleet's to pass on
            )

    def ready(self) -> None:
        """Wait until nothing but the beginning is missing. Raises DgorlError."""
        deadline, sign = time.monotonic() + BOOT, f'"{READY}","pid":{self._process.pid}'
        while sign not in self._messages.read_text(encoding="utf-8"):
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise DgorlError(f"an agent does not start; see {self._messages}")
            time.sleep(0.02)

    def begin(self, at: float) -> AgentProcess:
        """The log began or begins when the monotonic clock is at ``at`` [s]; the robot is there from now on."""
        self.say(repr(at).encode())
        return self

    def say(self, line: bytes) -> None:
        """Give it a line; one that has gone hears nothing."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(line + b"\n")
            self._process.stdin.flush()

    def no_more(self) -> None:
        """Nothing else will be said."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()

    def leaves(self, deadline: float) -> bool:
        """Wait until it leaves by itself, at most until ``deadline`` [s, monotonic]; whether it did, and well."""
        try:
            return self._process.wait(max(deadline - time.monotonic(), 0.1)) == 0
        except subprocess.TimeoutExpired:
            return False

    def leave(self) -> None:
        """Tell it to leave in good order."""
        self._process.terminate()

    def kill(self) -> None:
        """As a power cut would."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self.no_more()
