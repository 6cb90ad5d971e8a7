"""Small logs for the command line."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from .commandline import ENVIRONMENT, Dgorl, command


@pytest.fixture(scope="session")
def dgorl(tmp_path_factory: pytest.TempPathFactory) -> Dgorl:
    here = tmp_path_factory.mktemp("cwd")

    def run(*arguments: object, cwd: Path = here) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            command(*arguments),
            cwd=cwd,
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )

    return run


@pytest.fixture(scope="session")
def small(dgorl: Dgorl, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three robots, twelve steps, all sensors."""
    log = tmp_path_factory.mktemp("logs") / "small"
    done = dgorl("simulate", "--robots", 3, "--steps", 12, "--sensors", "rssi,range,bearing", "--out", log)
    assert done.returncode == 0, done.stderr
    return log


@pytest.fixture(scope="session")
def results(dgorl: Dgorl, small: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a run of it with known starts wrote."""
    out = tmp_path_factory.mktemp("results") / "small"
    done = dgorl("run", small, "--initial", "known", "--out", out)
    assert done.returncode == 0, done.stderr
    return out
