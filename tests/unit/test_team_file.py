"""team.yaml of the live team: strict, with hints, and hashed over what must agree."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from dgorl.errors import ConfigurationError
from dgorl.logs.log import Start
from dgorl.team.keys import generate
from dgorl.team.team_file import TeamFile

KEYS = {name: generate().public for name in ("r1", "r2", "r3")}


def base(**changes: object) -> dict:
    return {"team": "barn", "robots": {name: {"key": key} for name, key in KEYS.items()}, **changes}


def read(folder: Path, data: object) -> TeamFile:
    path = folder / "team.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data, sort_keys=False))
    return TeamFile.read(path)


def test_all_it_may_say(tmp_path: Path) -> None:
    team = read(tmp_path, base(
        window=20, history=90, seed=3, clock="estimated", substep=0.25, radio={"sigma_db": 3.0},
        antennas={"default": [0, 0, 0.3], "r1": [0.1, 0, 0.3]}, start={"r1": [1, 2, 0.5]}, start_stamp=12.0,
        transport={"addresses": {"r1": "tcp/10.0.0.1:7447"}},
    ))  # fmt: skip
    assert team.team == "barn"
    assert dict(team.robots) == KEYS
    assert (team.configuration.window, team.configuration.history, team.configuration.seed) == (20, 90, 3)
    assert (team.configuration.clock, team.substep, team.configuration.radio.sigma_db) == ("estimated", 0.25, 3.0)
    assert team.configuration.antennas["r1"] == (0.1, 0.0, 0.3)
    assert dict(team.starts) == {"r1": Start(12.0, (1.0, 2.0, 0.5))}
    assert dict(team.transport.addresses) == {"r1": "tcp/10.0.0.1:7447"}
    assert team.roster.robots == ("r1", "r2", "r3")
    assert not team.roster.insecure
    assert len(team.configuration_hash) == 8


def test_insecure_teams_need_no_keys(tmp_path: Path) -> None:
    team = read(tmp_path, {"team": "barn", "robots": ["r1", "r2"], "insecure": True})
    assert dict(team.robots) == {"r1": None, "r2": None}
    assert team.roster.insecure
    assert read(tmp_path, base(insecure=True)).roster.insecure


@pytest.mark.parametrize(
    ("changes", "where", "what"),
    [
        ({"tema": "x"}, "tema", "did you mean `team`"),
        ({"windw": 20}, "windw", "did you mean `window`"),
        ({"radio": {"sigma": 1}}, "sigma", "did you mean `sigma_db`"),
        ({"radio": {"sigma_db": "loud"}}, "sigma_db", "must be a number"),
        ({"window": 7}, "window", "multiple of 5 s"),
        ({"clock": "mine"}, "clock", "shared or estimated"),
        ({"team": 5}, "team", "must name the team"),
        ({"team": "a/b"}, "team", "must name the team"),
        ({"insecure": "yes please"}, "insecure", "true or false"),
        ({"substep": -1}, "substep", "0 to 10 seconds"),
        ({"robots": ["r1"]}, "robots", "dgorl keys"),
        ({"robots": {}}, "robots", "dgorl keys"),
        ({"robots": {"r1": None}}, "r1", "has no key"),
        ({"robots": {"r1": {"key": "abc"}}}, "r1", "32 bytes"),
        ({"robots": {"r1": {"kye": "abc"}}}, "r1", "key: BASE64"),
        ({"robots": {"r1": {"key": 5}}}, "r1", "text in base64"),
        ({"robots": {"world": {"key": KEYS["r1"]}}}, "world", "cannot be a robot's name"),
        ({"robots": {"a/b": {"key": KEYS["r1"]}}}, "a/b", "cannot be a robot's name"),
        ({"robots": {"r1": {"key": KEYS["r1"]}, "r2": {"key": KEYS["r1"]}}}, "r2", "its own"),
        ({"antennas": {"r4": [0, 0, 0]}}, "r4", "unknown robot `r4`"),
        ({"start": {"r1": [0, 0]}, "start_stamp": 0}, "r1", "[x, y, theta]"),
        ({"start": {"r1": [0, 0, 0]}}, "r1", "needs a `start_stamp`"),
        ({"start": {"r9": [0, 0, 0]}, "start_stamp": 0}, "r9", "unknown robot `r9`"),
        ({"start_stamp": 0}, "start_stamp", "needs `start`"),
        ({"transport": {"conect": []}}, "transport", "did you mean `connect`"),
        ({"transport": 5}, "transport", "must be a mapping"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, changes: dict, where: str, what: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, base(**changes))
    message = str(caught.value)
    path, number, *_ = message.split(":")
    assert path == str(tmp_path / "team.yaml")
    assert what in message
    assert where in (tmp_path / "team.yaml").read_text().splitlines()[int(number) - 1]


@pytest.mark.parametrize("text", ["", "[]", "team: [", "a: 1\na: 2\n", "robots: {r1: 1}\nteam: 2001-99-99", "\x00"])
def test_what_is_no_team_file(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigurationError, match=r"team\.yaml"):
        read(tmp_path, text)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        TeamFile.read(tmp_path / "none.yaml")


def test_the_team_file_of_the_documentation(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "live-team.md").read_text()
    examples = [part.partition("```")[0] for part in text.split("```yaml\n")[1:] if part.startswith("team:")]
    assert examples
    for example in examples:
        assert read(tmp_path, example).roster.robots


def test_the_hash_is_of_what_must_agree(tmp_path: Path) -> None:
    same = [
        base(),
        base(robots={name: {"key": KEYS[name]} for name in ("r3", "r1", "r2")}),
        base(window=30.0, radio={"sigma_db": 2.0}),
        base(transport={"addresses": {"r1": "tcp/10.0.0.1:7447"}}),
    ]
    other = [
        base(team="shed"),
        base(robots={name: {"key": KEYS[name]} for name in ("r1", "r2")}),
        base(robots={name: {"key": generate().public} for name in KEYS}),
        base(window=25), base(seed=1), base(radio={"sigma_db": 2.5}), base(substep=0.5), base(clock="estimated"),
        base(insecure=True), base(start={"r1": [0, 0, 0]}, start_stamp=0), base(antennas={"r1": [0, 0, 1]}),
    ]  # fmt: skip
    assert len({read(tmp_path, data).configuration_hash for data in same}) == 1
    hashes = [read(tmp_path, data).configuration_hash for data in [base(), *other]]
    assert len(set(hashes)) == len(hashes)
