"""Tests leave nothing at home: journals without a place of their own go to a folder that is gone afterwards."""

from __future__ import annotations

import os
from tempfile import TemporaryDirectory

import pytest


def pytest_configure(config: pytest.Config) -> None:
    """Before any test module is imported: some copy the environment."""
    folder = TemporaryDirectory(prefix="dgorl-state-")
    os.environ["XDG_STATE_HOME"] = folder.name
    config.add_cleanup(folder.cleanup)
