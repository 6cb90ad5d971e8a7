"""Logs of robot teams: :func:`read` guesses the format, :func:`write` makes a dgorl log folder."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from dgorl.errors import LogError
from dgorl.logs.folder import read_folder
from dgorl.logs.log import Log, Start, in_order, select
from dgorl.logs.mrclam import read_mrclam
from dgorl.logs.pyfg import read_pyfg
from dgorl.logs.truth import read_truth
from dgorl.logs.writer import write_folder as write
from dgorl.team.journal_schema import is_journal

__all__ = ["Log", "Start", "in_order", "read", "read_truth", "select", "write"]


def read(path: str | Path, kinds: Collection[str] | None = None) -> Log:
    """The log at a path, its format guessed; ``kinds`` as in :func:`select`, None takes all.

    A dgorl log is a folder with team.yaml, an MRCLAM recording one with Barcodes.dat, a PyFG file ends
    in ``.pyfg``, a journal of the live team is an SQLite file that says so in its header.
    Raises LogError for anything that cannot be read, naming file and line.
    """
    log = _read(Path(path))
    return log if kinds is None else select(log, kinds)


def _read(path: Path) -> Log:
    try:
        if path.is_dir():
            names = {entry.name for entry in path.iterdir()}
        elif path.exists():
            names = None
        else:
            raise LogError(path, None, "no such file or folder")
    except OSError as error:
        raise LogError(path, None, f"cannot be read: {error.strerror}") from error
    if names is None:
        if path.suffix == ".pyfg":
            return read_pyfg(path)
        if is_journal(path):
            from dgorl.logs.journal import read_journal  # the live team's packages are not needed else

            return read_journal(path)
        raise LogError(path, None, "not a log: give a dgorl log folder, an MRCLAM folder, a .pyfg file or a journal")
    if "team.yaml" in names:
        return read_folder(path)
    if "Barcodes.dat" in names:
        return read_mrclam(path)
    what = "not a log" if names else "an empty folder"
    raise LogError(path, None, f"{what}: a dgorl log has a team.yaml, an MRCLAM recording a Barcodes.dat")
