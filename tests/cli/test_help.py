"""What commands say of themselves, and numbers that no command takes."""

from __future__ import annotations

import re

import pytest

from dgorl.cli.main import COMMANDS

from .commandline import Dgorl, fails_well

INTERNAL = re.compile(r"METHOD|INTERFACES|:(?:mod|class|func|data):|\{None\}|``|Raises |§")


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_is_for_users(dgorl: Dgorl, command: str) -> None:
    done = dgorl(*command.split(), "--help")
    assert done.returncode == 0, done.stderr
    assert INTERNAL.findall(done.stdout) == []


def test_comments_of_the_configuration_are_for_users(dgorl: Dgorl) -> None:
    assert INTERNAL.findall(dgorl("config").stdout) == []


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("run", "LOG", "--seed", "-2"), "seed must be at least 0"),
        (("run", "LOG", "--seed", "-9223372036854775808"), "seed must be at least 0"),
        (("run", "LOG", "--period", "nan"), "`period` must be a number, got nan"),
        (("run", "LOG", "--period", "1e-9"), "period must be at least 0.001 s"),
        (("run", "LOG", "--history", "-180"), "history must be at least 10 s"),
        (("run", "LOG", "--history", "inf"), "`history` must be a number, got inf"),
        (("run", "LOG", "--candidates", "-1"), "candidates must be at least 1"),
        (("run", "LOG", "--window", "nan"), "`window` must be a number or all, got nan"),
        (("fleet", "LOG", "--out", "o", "--seed", "-3"), "seed must be at least 0"),
        (("fleet", "LOG", "--out", "o", "--rate", "nan"), "rate must be at least 0.01, got nan"),
        (("fleet", "LOG", "--out", "o", "--settle", "-1"), "settle must be at least 0, got -1.0"),
        (("fleet", "LOG", "--out", "o", "--duration", "nan"), "duration must be at least 0, got nan"),
        (("fleet", "--simulate", "--out", "o", "--seed", "-3"), "seed must be 0 or more, got -3"),
        (("fleet", "--simulate", "--out", "o", "--simulation.area", "nan"), "area must be a finite number, got nan"),
        (("demo", "--out", "o", "--seed", "-1"), "seed must be 0 or more, got -1"),
        (("simulate", "--out", "o", "--seed", "-7"), "seed must be 0 or more, got -7"),
        (("simulate", "--out", "o", "--period", "-0.5"), "period must be positive, got -0.5"),
        (("paper", "--out", "o", "--seed", "-1"), "--seed must be at least 0, got -1"),
        (("doctor", "--seconds", "nan"), "--seconds must be positive, got nan"),
    ],
)
def test_numbers_that_no_command_takes(dgorl: Dgorl, small: object, arguments: tuple[str, ...], what: str) -> None:
    given = [small if argument == "LOG" else argument for argument in arguments]
    assert what in fails_well(dgorl(*given))


@pytest.mark.parametrize("option", ["--rate=nan", "--rate=-1", "--settle=-1", "--clock-drift=nan", "--until=inf"])
def test_numbers_that_no_agent_takes(dgorl: Dgorl, option: str) -> None:
    done = dgorl("agent", "--robot", "r1", "--team", "team.yaml", option)
    assert done.returncode == 1
    assert f"command line: {option.partition('=')[0]} must be a number" in done.stderr
