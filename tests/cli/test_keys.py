"""`dgorl keys`: a key file, its public half for the team file, nothing overwritten."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from dgorl.team.keys import load_key
from dgorl.team.team_file import TeamFile

from .commandline import Dgorl, fails_well


def test_keys_make_a_team_file(dgorl: Dgorl, tmp_path: Path) -> None:
    robots = {}
    for name in ("r1", "r2"):
        done = dgorl("keys", "--robot", name, "--out", str(tmp_path / f"{name}.key"), "--json")
        assert done.returncode == 0
        said = json.loads(done.stdout)
        assert said["public"] == load_key(tmp_path / f"{name}.key").public
        robots |= yaml.safe_load(said["team_yaml"])
    (tmp_path / "team.yaml").write_text(yaml.safe_dump({"team": "t", "robots": robots}))
    roster = TeamFile.read(tmp_path / "team.yaml").roster
    assert roster.verify("r2", load_key(tmp_path / "r2.key").sign(b"x"), b"x")


def test_the_line_for_the_team_file_is_printed(dgorl: Dgorl, tmp_path: Path) -> None:
    path = tmp_path / "r1.key"
    made = dgorl("keys", "--robot", "r1", "--out", str(path))
    assert f"r1: {{key: {load_key(path).public}}}" in made.stdout
    assert "PRIVATE" not in made.stdout + made.stderr
    shown = dgorl("keys", "--robot", "r1", "--out", str(path), "--show")
    assert made.stdout == shown.stdout


@pytest.mark.parametrize("name", ["world", "a/b", "", "../r1"])
def test_names_that_cannot_be(dgorl: Dgorl, tmp_path: Path, name: str) -> None:
    done = dgorl("keys", "--robot", name, "--out", str(tmp_path / "x.key"))
    assert "cannot be a robot's name" in fails_well(done)
    assert not (tmp_path / "x.key").exists()


def test_no_key_is_overwritten(dgorl: Dgorl, tmp_path: Path) -> None:
    path = tmp_path / "r1.key"
    dgorl("keys", "--robot", "r1", "--out", str(path))
    text = path.read_bytes()
    assert "exists" in fails_well(dgorl("keys", "--robot", "r1", "--out", str(path)))
    assert path.read_bytes() == text
    assert "cannot be written" in fails_well(dgorl("keys", "--robot", "r1", "--out", str(tmp_path / "no" / "x.key")))
    assert "cannot be read" in fails_well(dgorl("keys", "--robot", "r1", "--out", str(tmp_path / "no.key"), "--show"))
