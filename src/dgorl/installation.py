"""Whether this installation works: the compiled core, versions, optional packages, what the system allows."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import numpy as np

import dgorl
from dgorl.errors import pip_install
from dgorl.findings import Finding, note, ok, problem

AREA = "install"
REQUIRED = ("numpy", "PyYAML", "msgspec", "eclipse-zenoh", "cryptography", "tyro", "rich")
OPTIONAL = {
    "matplotlib": "pictures",
    "g2opy": "the solver g2o",
    "gtsam": "the solver gtsam and the baseline gtsam-fixed-lag",
    "pyarrow": "tables of `dgorl paper`",
    "distributed": "trials of `dgorl paper` on several machines",
}
"""package, which names its module → what it is for"""
DESCRIPTORS = 256
"""A robot's program and its network need fewer open files."""
TOLERANCE = 1e-3
"""The solve may be off by this [m]."""


def installation() -> tuple[Finding, ...]:
    """Look at everything."""
    return tuple(_all())


def _all() -> Iterator[Finding]:
    yield _core()
    yield from _versions()
    for module, use in OPTIONAL.items():
        if find_spec(module) is None:
            yield note(AREA, f"{module} is not installed: {use} will not work", pip_install(module))
        else:
            yield ok(AREA, f"{module} is there, for {use}")
    yield from _descriptors()


def _core(solve: Callable[[], float] | None = None) -> Finding:
    """Two robots with known starts, one drives a metre away from the other."""
    again = pip_install("--force-reinstall", "--no-deps", "--no-cache-dir", ".")
    advice = f"install again, in the folder of its source: {again}"
    try:
        off = (solve or _solve)()
    except Exception as error:  # whatever is wrong with a compiled module
        return problem(AREA, f"the compiled core does not work: {type(error).__name__}: {error}", advice)
    if not off < TOLERANCE:
        return problem(AREA, f"the compiled core solves wrongly: off by {off:.3g} m", advice)
    return ok(AREA, "the compiled core works: two robots solved, as they should be")


def _solve() -> float:
    """How far the answer is off [m]."""
    team = dgorl.Localizer("r1")
    exact = (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
    for robot, x in (("r1", 0.0), ("r2", 3.0)):
        team.add(dgorl.RelativePose(dgorl.WORLD, robot, 0.0, x, 0.0, 0.0, exact, prior=True))
        team.add(dgorl.Odometry(robot, 0.0, 2.0, 0.5 if robot == "r2" else 0.0, 0.0))
    for stamp in (0.5, 1.0, 1.5, 2.0):
        team.add(dgorl.Range("r1", "r2", stamp, 3.0 + 0.5 * stamp, 0.1))
    pose = team.update(2.0)["r2"].pose
    return float("inf") if pose is None else float(np.hypot(pose[0] - 4.0, pose[1]))


def _versions() -> Iterator[Finding]:
    missing, there = [], []
    for name in REQUIRED:
        try:
            there.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            missing.append(name)
    yield ok(AREA, f"dgorl {dgorl.__version__}, Python {platform.python_version()} on {platform.platform()}")
    yield ok(AREA, ", ".join(there))
    if missing:
        yield problem(AREA, f"not installed: {', '.join(missing)}", pip_install(*missing))
    try:
        installed = version("dgorl")
    except PackageNotFoundError:
        installed = dgorl.__version__
    if installed != dgorl.__version__:
        yield problem(
            AREA,
            f"two versions of dgorl: {installed} is installed, {dgorl.__version__} is running",
            "install again, and look for a second copy on PYTHONPATH",
        )


def _descriptors() -> Iterator[Finding]:
    try:
        import resource
    except ImportError:  # not a Unix
        return
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < DESCRIPTORS:
        yield problem(AREA, f"a program may open {soft} files; a live robot may need {DESCRIPTORS}", "ulimit -n 1024")
    else:
        yield ok(AREA, "files a program may open: " + ("any" if soft == resource.RLIM_INFINITY else str(soft)))
