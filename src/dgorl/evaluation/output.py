"""The files ``dgorl run`` leaves in its folder; the formats are INTERFACES'.

The same log and configuration give the same CSV and TUM files, bit for bit: numbers are written so that they
read back exactly, and what a clock measured stands in summary.json alone.
"""

from __future__ import annotations

import json
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import dgorl
from dgorl.configuration import Configuration, as_dict
from dgorl.errors import DgorlError
from dgorl.evaluation.metrics import summarize
from dgorl.evaluation.records import PairRecord, Records
from dgorl.se2 import Array

HEADER = "t,x,y,theta,var_xx,var_xy,var_xt,var_yy,var_yt,var_tt,status,probability,age,reason,resolve_by"
HYPOTHESES_HEADER = "t,rank,probability,x,y,theta,var_xx,var_xy,var_xt,var_yy,var_yt,var_tt"
TANGENT_HEADER = "var_tangent_xx,var_tangent_xy,var_tangent_xt,var_tangent_yy,var_tangent_yt,var_tangent_tt"
_UPPER = np.triu_indices(3)


def write(records: Records, configuration: Configuration, about: Mapping[str, Any], directory: Path) -> dict[str, Any]:
    """Write summary.json, ``relative/`` and ``hypotheses/`` into ``directory``, over an earlier run's.

    Returns the summary.

    about: what the summary says of the run itself: log, robots, initial, measurements, solver, ...
    Raises DgorlError when the folder cannot be used.
    """
    prepare(directory)
    for (ego, peer), record in records.pairs.items():
        folder = _folder(directory / "relative" / _filename(ego))
        name = _filename(peer)
        _write(folder / f"{name}.csv", csv_lines(record))
        _write(folder / f"{name}.tum", tum_lines(record.t[record.located], record.pose[record.located]))
        known = np.isfinite(record.truth).all(axis=1)
        if known.any():
            _write(folder / f"{name}.truth.tum", tum_lines(record.t[known], record.truth[known]))
        if record.hypotheses:
            folder = _folder(directory / "hypotheses" / _filename(ego))
            _write(folder / f"{name}.csv", hypotheses_lines(record))
    summary = {
        **about,
        **summarize(records),
        "process": {"cpu_s": time.process_time(), "peak_rss_mb": peak_rss_mb()},
        "configuration": as_dict(configuration),
        "versions": {
            "dgorl": dgorl.__version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
        },
    }
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    _write(directory / "summary.json", [text])
    return summary


@contextmanager
def replacing(directory: Path) -> Iterator[Path]:
    """A folder to write results into; they take the place of an earlier run's in ``directory`` when the block ends.

    Until then, and for good when the block raises, what is in ``directory`` stays as it is. Raises DgorlError if a file
    is in the way.
    """
    check(directory)
    made = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=directory))
    try:
        yield unfinished
        prepare(directory)
        files = [file for file in unfinished.rglob("*") if file.is_file()]
        for file in sorted(files, key=lambda file: file.name == "summary.json"):  # it says that all is there
            target = directory / file.relative_to(unfinished)
            target.parent.mkdir(parents=True, exist_ok=True)
            file.replace(target)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        if made and not any(directory.iterdir()):
            directory.rmdir()


def check(directory: Path) -> None:
    """Raises DgorlError if a file is in the way of the folder."""
    for part in (directory, *directory.parents):
        if part.exists() and not part.is_dir():
            raise DgorlError(f"{part}: is a file, not a folder; name another folder with --out")


def log_of(directory: Path) -> Path | None:
    """The log whose results are in a folder; None if there are none."""
    try:
        return Path(json.loads((directory / "summary.json").read_text(encoding="utf-8"))["log"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError):
        return directory  # of something else


def prepare(directory: Path) -> None:
    """Make the folder and take an earlier run's files away, so that none of them is taken for this run's.

    Raises DgorlError if a file is in the way. Only files that this module and the figures write are removed.
    """
    check(directory)
    directory.mkdir(parents=True, exist_ok=True)
    if not (directory / "summary.json").is_file():
        return
    (directory / "summary.json").unlink()
    for pattern in ("relative/*/*.csv", "relative/*/*.tum", "hypotheses/*/*.csv", "figures/*.png"):
        for file in directory.glob(pattern):
            file.unlink()
    for folder in (*directory.glob("relative/*"), *directory.glob("hypotheses/*"), directory / "hypotheses"):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def csv_lines(record: PairRecord) -> Iterator[str]:
    """The rows of ``relative/EGO/PEER.csv``; pose fields are empty where there is no pose."""
    yield ",".join([HEADER, *([] if record.data is None else ["data"]), TANGENT_HEADER])
    for k, t in enumerate(record.t):
        numbers = [*record.pose[k], *record.covariance[k][_UPPER]]
        fields = [_number(t), *("" if np.isnan(value) else _number(value) for value in numbers)]
        fields += [str(record.status[k]), _number(record.probability[k]), _number(record.age[k])]
        fields += [_quote(record.reason[k]), _quote(record.resolve_by[k])]
        fields += [] if record.data is None else [record.data[k]]
        yield ",".join([*fields, *_upper(None if record.tangent is None else record.tangent[k])])


def hypotheses_lines(record: PairRecord) -> Iterator[str]:
    """The rows of ``hypotheses/EGO/PEER.csv``: where an ambiguous peer may be, rank 1 the most probable."""
    yield f"{HYPOTHESES_HEADER},{TANGENT_HEADER}"
    for k, alive in sorted(record.hypotheses.items()):
        for rank, hypothesis in enumerate(alive, 1):
            numbers = [hypothesis.probability, *hypothesis.pose, *hypothesis.covariance[_UPPER]]
            tangent = _upper(hypothesis.tangent_covariance)
            yield ",".join([_number(record.t[k]), str(rank), *map(_number, numbers), *tangent])


def tum_lines(t: Array, pose: Array) -> Iterator[str]:
    """Rows ``t x y z qx qy qz qw`` of poses (T, 3) in the plane, as evo reads them."""
    half = pose[:, 2] / 2
    for stamp, x, y, qz, qw in zip(t, pose[:, 0], pose[:, 1], np.sin(half), np.cos(half), strict=True):
        yield " ".join([_number(stamp), _number(x), _number(y), "0", "0", "0", _number(qz), _number(qw)])


def peak_rss_mb() -> float | None:
    """The most memory this process has held [MB]; None where the system does not say."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    if sys.platform == "linux":  # getrusage tells of who started this process, too, if that was larger
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.partition("VmHWM:")[2].split()[0]) * 1.024e-3
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _write(path: Path, lines: Any) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)


def _number(value: float) -> str:
    """Shortest text that reads back as exactly this number."""
    return repr(float(value))


def _upper(covariance: Array | None) -> list[str]:
    """The six numbers of a covariance (3, 3), empty where it is not known."""
    known = covariance is not None and bool(np.isfinite(covariance).all())
    return [_number(value) for value in covariance[_UPPER]] if known and covariance is not None else [""] * 6


def _quote(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\r\n') else text


def _filename(robot: str) -> str:
    if robot in (".", "..") or any(c in robot for c in "/\\\0"):
        raise DgorlError(f"robot {robot!r}: its name cannot name a file; rename it in the log")
    return robot
