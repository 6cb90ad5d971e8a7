"""Every YAML file the project reads is plain: no references, errors by FILE:LINE, whatever the text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from dgorl.configuration import load
from dgorl.errors import DgorlError
from dgorl.logs.team import read_team
from dgorl.plain_yaml import PlainYamlError, plain_yaml, yaml_text
from dgorl.team.team_file import TeamFile

READERS = (load, read_team, TeamFile.read)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("robots: [r1]\nradio: &mine {sigma_db: 2.0}\n", 2, "an anchor (`&`) is not taken here"),
        ("robots: [r1]\n\nradio: *mine\n", 3, "an alias (`*`) is not taken here"),
        ("robots: [r1]\nradio: {<<: *mine}\n", 2, "an alias"),
        ("robots: [r1]\nwindow: " + "9" * 5000 + "\n", 2, "limit"),
        ("robots: [r1]\nwindow: 2026-02-31\n", 2, "day is out of range"),
        ("robots: [r1]\nwindow: \x1b[31m\n", 2, "U+001B"),
        ("robots:\n  " + "[" * 20_000 + "\n", 2, "nested too deeply"),
    ],
)
def test_errors_name_file_and_line(
    tmp_path: Path, reader: Callable[[Path], object], text: str, line: int, what: str
) -> None:
    path = tmp_path / "any.yaml"
    path.write_text(text)
    with pytest.raises(DgorlError) as caught:
        reader(path)
    assert str(caught.value).startswith(f"{path}:{line}: not YAML")
    assert what in str(caught.value)


def test_what_is_written_can_be_read() -> None:
    pose = [1.0, 2.5, 0.0]
    value = {"start": {"r1": pose, "r2": pose}, "again": {"r1": pose}}
    assert plain_yaml(yaml_text(value))[0] == value


@given(st.text(alphabet="ab1:-[]{}&*!?|>'\"#,\n \t.\\<~\x00\x85", max_size=40))
def test_any_text_is_read_as_pyyaml_does_or_refused(text: str) -> None:
    line = 1
    try:
        value, _ = plain_yaml(text)
    except PlainYamlError as error:
        line = error.line
    else:
        assert value == yaml.safe_load(text)
    assert 1 <= line <= text.count("\n") + text.count("\x85") + 1
