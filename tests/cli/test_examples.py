"""What the examples say works: the systemd unit's command, and a program that feeds an agent."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from dgorl.cli.agent import _parser

EXAMPLES = Path(__file__).parents[2] / "examples"
UNIT = EXAMPLES / "systemd" / "dgorl-agent@.service"

TEAM = "team: barn\ninsecure: true\nrobots: {r1: {}, r2: {}}\ntransport: {addresses: {r1: tcp/127.0.0.1:0}}\n"


def test_the_units_command_is_one_the_agent_takes():
    (command,) = re.findall(r"^ExecStart=(.*)$", UNIT.read_text(encoding="utf-8"), re.MULTILINE)
    program, agent, *arguments = shlex.split(command.replace("%i", "r1"))
    assert (Path(program).name, agent) == ("dgorl", "agent")
    options = _parser().parse_args(arguments)
    assert (options.robot, options.local) == ("r1", "tcp/127.0.0.1:7448")
    assert options.key
    assert options.journal


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
def test_systemd_takes_the_unit(tmp_path):
    unit = tmp_path / "dgorl-agent@r1.service"
    unit.write_text(UNIT.read_text(encoding="utf-8").replace("/opt/dgorl/bin/dgorl", sys.executable), encoding="utf-8")
    done = subprocess.run(["systemd-analyze", "verify", "--man=no", unit], capture_output=True, text=True, timeout=60)
    ours = [line for line in done.stderr.splitlines() if "dgorl-agent" in line]
    assert not ours, done.stderr


def test_a_program_feeds_an_agent_and_hears_its_estimates(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    (tmp_path / "team.yaml").write_text(TEAM, encoding="utf-8")
    command = [sys.executable, "-m", "dgorl", "agent", "--robot", "r1", "--team", "team.yaml", "--local", endpoint]
    with subprocess.Popen(
        command, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as agent:
        try:
            assert agent.stdout is not None
            agent.stdout.readline()  # its first estimate: it is up
            feed = [sys.executable, str(EXAMPLES / "feed.py"), "--endpoint", endpoint, "--seconds", "2.5"]
            heard = subprocess.run(feed, capture_output=True, text=True, timeout=60, check=True).stdout
        finally:
            agent.terminate()
            agent.communicate(timeout=30)
    estimates = [json.loads(line) for line in heard.splitlines()]
    assert any(estimate["data"].startswith("r1:") for estimate in estimates)
    assert not any(estimate["rejected"] for estimate in estimates)
    assert agent.returncode == 0
