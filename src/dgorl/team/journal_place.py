"""Where an agent's journal is if nobody says so: in the user's state folder, wherever the agent is started from."""

from __future__ import annotations

from pathlib import Path

from platformdirs import user_state_path

from dgorl.team.journal_schema import JournalError


def state_journal(team: str, robot: str) -> Path:
    """STATE/dgorl/TEAM/ROBOT.journal; STATE is what the system has for it ($XDG_STATE_HOME, or ~/.local/state)."""
    folder = team if team.strip(".") else f"team{team}"  # no way up
    return user_state_path("dgorl") / folder / f"{robot}.journal"


def make_folder(journal: Path) -> None:
    """Make a journal's folder, if it is one of dgorl's own and missing. Raises JournalError."""
    if not journal.is_relative_to(user_state_path("dgorl")):
        return
    try:
        journal.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        what = f"{journal.parent}: cannot be made: {error.strerror}; name another place with --journal FILE"
        raise JournalError(what) from error
