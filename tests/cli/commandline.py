"""The command line as a user has it: a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Dgorl = Callable[..., "subprocess.CompletedProcess[str]"]
ENVIRONMENT = {**os.environ, "COLUMNS": "100", "PYTHONWARNINGS": "error", "NO_COLOR": "1"}


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "dgorl", *map(str, arguments)]


@contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[None]:
    """It does not outlive the block, whatever happens in there."""
    try:
        yield
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def fails_well(done: subprocess.CompletedProcess[str], code: int = 1) -> str:
    """The one line a known failure prints; nothing on stdout, no traceback."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("dgorl: ")
    assert done.stderr.count("\n") == 1
    return done.stderr.strip()
