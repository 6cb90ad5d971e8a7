"""g2o in C++ with a range edge, compiled on demand from ``edges.cpp`` against what g2opy's wheel ships.

No part of the estimator: only the comparison of solvers needs a compiler.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from dgorl.errors import MissingExtraError, pip_install

SOURCE = Path(__file__).with_name("edges.cpp")
LIBRARIES = ("g2o_types_slam2d", "g2o_core", "g2o_stuff")
FLAGS = ("-std=c++17", "-O3", "-DNDEBUG", "-fPIC", "-shared")
"""No -march: the static libraries have none, and Eigen's alignment depends on it."""


def cache_folder() -> Path:
    """Where compiled code is kept: ``$XDG_CACHE_HOME/dgorl``, ``~/.cache/dgorl`` without it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dgorl"


@cache
def g2o_library(folder: Path | None = None) -> ctypes.CDLL:
    """The compiled library; half a minute the first time. folder: of the compiled code, :func:`cache_folder` if None.

    Raises MissingExtraError without a compiler, Eigen or g2opy's headers and libraries, or when they do not fit.
    """
    compiler = _compiler()
    include, libraries = _g2o()
    link = [f"-l{name}" for name in LIBRARIES]
    command = [
        *(compiler, *FLAGS, f"-I{include}", "-isystem", str(_eigen()), str(SOURCE), f"-L{libraries}"),
        *("-Wl,--start-group", *link, "-Wl,--end-group"),
    ]
    archives = [f"{path.name} {path.stat().st_size}" for path in sorted(libraries.glob("libg2o_*.a"))]
    key = hashlib.sha256("\n".join([SOURCE.read_text(), *command, *archives]).encode()).hexdigest()[:12]
    target = (folder or cache_folder()) / f"g2o-{key}.so"
    if not target.exists():
        _compile(command, target)
    library = ctypes.CDLL(str(target))
    library.dgorl_g2o.restype = ctypes.c_int64
    return library


def _compile(command: Sequence[str], target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.with_suffix(f".{os.getpid()}")
    done = subprocess.run([*command, "-o", str(draft)], capture_output=True, text=True, check=False)
    if done.returncode:
        wrong = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[-300:])
        raise MissingExtraError(f"g2o in C++ does not compile: {wrong.strip()} (command: {' '.join(command)})")
    draft.replace(target)  # whole or not at all, whoever else compiles


def _compiler() -> str:
    named = os.environ.get("CXX", "")
    found = next((path for name in (named, "c++", "g++", "clang++") if name and (path := shutil.which(name))), None)
    if found is None:
        raise MissingExtraError("g2o in C++ needs a C++17 compiler: install g++ or clang++, or set CXX")
    return found


def _g2o() -> tuple[Path, Path]:
    """Folders of g2o's headers and static libraries."""
    spec = find_spec("g2opy")
    if spec is None or spec.origin is None:
        raise MissingExtraError(f"g2o in C++ needs g2opy's wheel: {pip_install('g2opy')}")
    site = Path(spec.origin).parent.parent
    for name in ("lib64", "lib"):
        if all((site / name / f"lib{library}.a").exists() for library in LIBRARIES):
            if (site / "include" / "g2o" / "config.h").exists():
                return site / "include", site / name
            break
    raise MissingExtraError(f"g2opy in {site} has no headers and static libraries of g2o: use its wheel for Linux")


def _eigen() -> Path:
    """Folder of Eigen's headers: of the package cmeel-eigen, or of the system."""
    folders = [Path(entry) / "cmeel.prefix" / "include" / "eigen3" for entry in sys.path]
    for folder in (*folders, Path("/usr/local/include/eigen3"), Path("/usr/include/eigen3")):
        if (folder / "Eigen" / "Sparse").exists():
            return folder
    raise MissingExtraError(f"g2o in C++ needs Eigen's headers: {pip_install('cmeel-eigen')}")
