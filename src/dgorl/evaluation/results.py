"""Tables of trials on disk: one part a trial, written in one go, so that what is there is whole. Parquet.

A part is named by the hash of everything its numbers depend on: the trial's definition and the program. One that was
left by another definition or program has another name and is never read.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

import dgorl
from dgorl.errors import MissingExtraError, pip_install
from dgorl.evaluation.trials import Columns, Outcome, Trial, stacked

_LEAVES = ("cli", "plotting")
"""packages no estimate depends on"""
ERRORS, TIMINGS = "errors", "timings"


@cache
def program() -> str:
    """Version of the package, a hash of its sources and core, and NumPy's version."""
    package = Path(dgorl.__file__).parent
    core = Path(dgorl._core.__file__ or "")
    digest = sha256(core.read_bytes())
    for file in sorted(package.rglob("*.py")):
        if file.relative_to(package).parts[0] not in _LEAVES:
            digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    return f"dgorl {dgorl.__version__} {digest.hexdigest()[:16]}, numpy {np.__version__}"


def definition(trial: Trial) -> str:
    """Everything a trial's numbers depend on, as JSON."""
    return json.dumps({"program": program(), **asdict(trial)}, sort_keys=True)


def key(trial: Trial) -> str:
    """The name of a trial's part."""
    return sha256(definition(trial).encode()).hexdigest()[:24]


class Parts:
    """The finished trials of a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def holds(self, trial: Trial) -> bool:
        """Whether a trial's part is there, whole and of this program."""
        try:
            schema = parquet().read_schema(self._path(trial, ERRORS))
            parquet().read_schema(self._path(trial, TIMINGS))
        except (OSError, ValueError):  # pyarrow's errors are ValueErrors
            return False
        return bool(schema.metadata.get(b"trial") == definition(trial).encode())

    def keep(self, trial: Trial, outcome: Outcome) -> None:
        """Write a trial's part; its errors last, as they say that it is there."""
        about = {"trial": definition(trial)}
        write(outcome.timings, self._path(trial, TIMINGS), about)
        write(outcome.errors, self._path(trial, ERRORS), about)

    def read(self, trials: Iterable[Trial]) -> Outcome:
        """The parts of these trials in this order, whatever else the folder holds."""
        chosen = list(trials)
        errors, timings = ([read(self._path(trial, kind)) for trial in chosen] for kind in (ERRORS, TIMINGS))
        return Outcome(stacked(errors), stacked(timings))

    def path_of(self, name: str, **about: Any) -> Path:
        """Where another measurement is kept, as JSON, by all that it depends on."""
        text = json.dumps({"program": program(), "what": name, **about}, sort_keys=True)
        return self.folder / f"{sha256(text.encode()).hexdigest()[:24]}.{name}.json"

    def _path(self, trial: Trial, kind: str) -> Path:
        return self.folder / f"{key(trial)}.{kind}.parquet"


def write(columns: Columns, path: Path, about: dict[str, str] | None = None) -> None:
    """One Parquet file, there whole or not at all; arrays (N, K) become lists."""
    import pyarrow

    table = pyarrow.table({name: _arrow(values) for name, values in columns.items()})
    table = table.replace_schema_metadata(about or {})
    with atomically(path) as temporary:
        parquet().write_table(table, temporary)


def read(path: Path) -> Columns:
    """The columns of a Parquet file as :func:`write` was given them."""
    table = parquet().read_table(path)
    return {name: _numpy(table.column(name).combine_chunks()) for name in table.column_names}


def write_text(text: str, path: Path) -> None:
    """One text file, there whole or not at all."""
    with atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


class atomically:
    """A temporary file beside ``path`` that takes its place at the end, unless something goes wrong."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Path:
        handle, name = tempfile.mkstemp(prefix=".", suffix=f".{self._path.name}", dir=self._path.parent)
        os.close(handle)
        self._temporary = Path(name)
        self._temporary.chmod(0o644)
        return self._temporary

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            self._temporary.replace(self._path)
        else:
            self._temporary.unlink(missing_ok=True)


def parquet() -> Any:
    """pyarrow.parquet. Raises MissingExtraError."""
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtraError(f"the experiment's tables need pyarrow: {pip_install('pyarrow')}") from error
    return pyarrow.parquet


def _arrow(values: Any) -> Any:
    import pyarrow

    if values.ndim == 1:
        return pyarrow.array(values)
    ends = np.arange(0, values.size + 1, values.shape[1], dtype=np.int32)
    return pyarrow.ListArray.from_arrays(ends, values.ravel())


def _numpy(column: Any) -> Any:
    import pyarrow

    if not pyarrow.types.is_list(column.type):
        return column.to_numpy(zero_copy_only=False)
    return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)
