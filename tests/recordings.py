"""Where the recordings of real robots are; tests skip, saying so, where they are not."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
CASES = ROOT.parent / "shared" / "cases"


def recording(name: str) -> Path:
    """The recording ``name``, or a skip that says what is missing."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not in ../shared/data; CONTRIBUTING says where to get it")
    return path


def case(name: str) -> Path:
    """The small input ``name`` that once went wrong, or a skip that says what is missing."""
    path = CASES / name
    if not path.exists():
        pytest.skip(f"{name} is not in ../shared/cases")
    return path
