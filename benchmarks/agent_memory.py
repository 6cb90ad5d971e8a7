"""What one live agent costs: its memory as time passes, its CPU time a second.

    python benchmarks/agent_memory.py [--streams rssi twists] [--seconds 300] [--at 40 100 300] [--trace 12]
    python benchmarks/agent_memory.py --streams DATA/mrclam6 --config configs/mrclam.yaml

The measured process holds one agent, with its journal and a Zenoh session, in virtual time; this one is the rest of
its team of five: they gossip, signed, and do not estimate. Streams: `rssi`, the simulator's steps of 0.5 s and an RSSI
of each peer; `twists`, odometry every 0.1 s, ranges and bearings; or a recording. Ticks are at 2 Hz, starts known.
RSS as the system counts it: the pages of shared libraries are in it. --trace: also who holds what Python allocated.
"""

from __future__ import annotations

import argparse
import gc
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

STEP = 0.05
"""The agent looks at the network this often [s]."""
SIMULATED = ("rssi", "twists")


class Turn(NamedTuple):
    """What reaches the agent by ``now`` [s]: lines of its sensors, messages (channel, sender, payload)."""

    now: float
    lines: list[bytes]
    messages: list[tuple[str, str, bytes]]


class Answer(NamedTuple):
    """What it sends, (channel, payload). With a report: ``located`` peers, memory [MB], CPU time so far [s]."""

    messages: list[tuple[str, bytes]]
    report: tuple[int, float, float, float] | None


def memory(*names: str) -> list[float]:
    """Of this process, as /proc/self/status says it [MB]."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    rows = dict(line.split(":", 1) for line in text.splitlines())
    return [int(rows[name].split()[0]) / 1024 for name in names]


# The measured process


def agent_process(folder: Path, robot: str, source: BinaryIO, sink: BinaryIO, trace: int) -> None:
    """An agent that lives by turns."""
    import dgorl.team.process  # noqa: F401  as much as an agent imports
    from dgorl.configuration import as_dict
    from dgorl.replay import start_priors
    from dgorl.team.agent import Agent
    from dgorl.team.footprint import keep_small
    from dgorl.team.journal import Journal
    from dgorl.team.keys import load_key
    from dgorl.team.network import Network
    from dgorl.team.team_file import TeamFile
    from dgorl.team.transport import Received, Traffic
    from dgorl.team.zenoh_transport import ZenohTransport

    @dataclass
    class Pipe:
        inbox: deque[Received]
        outbox: list[tuple[str, bytes]]
        traffic = Traffic(0, 0, 0, 0, 0)

        def send(self, channel: str, payload: bytes) -> None:
            self.outbox.append((channel, payload))

        def poll(self) -> list[Received]:
            messages = list(self.inbox)
            self.inbox.clear()
            return messages

        def present(self) -> frozenset[str]:
            return frozenset()

        def close(self) -> None:
            pass

    keep_small()
    team, key = TeamFile.read(folder / "team.yaml"), load_key(folder / f"{robot}.key")
    zenoh = ZenohTransport(team.team, robot, Network(multicast=False), time.monotonic, folder, team.roster.robots)
    pipe = Pipe(deque(), [])
    journal = Journal.open(
        folder / f"{robot}.journal",
        robot,
        team.roster,
        settings=as_dict(team.configuration),
        keep=400.0,
        starts=start_priors(team.starts),
        synchronous="normal",
    )
    if trace:
        import tracemalloc

        tracemalloc.start(1)
    agent = Agent(robot, team, key, pipe, journal, 0.0)
    spent = 0.0
    while (turn := pickle.load(source)) is not None:
        began = time.process_time()
        for line in turn.lines:
            assert agent.take_line(line, turn.now) is None
        pipe.inbox.extend(Received(*message, turn.now) for message in turn.messages)
        report = agent.step(turn.now)
        spent += time.process_time() - began
        said = None
        if report is not None:
            located = sum(peer.status == "tracked" for peer in report.peers.values())
            said = (located, *memory("VmRSS", "RssAnon"), spent)
        pickle.dump(Answer(list(pipe.outbox), said), sink)
        sink.flush()
        pipe.outbox.clear()
    if trace:
        gc.collect()
        snapshot = tracemalloc.take_snapshot()
        for row in snapshot.statistics("lineno")[:trace]:
            where = f"{row.traceback[0].filename.split('/dgorl/')[-1]}:{row.traceback[0].lineno}"
            print(f"  {row.size / 1024:8.0f} kB {row.count:8d}  {where}", file=sys.stderr)
        print(f"  {sum(row.size for row in snapshot.statistics('filename')) / 2**20:.2f} MB", file=sys.stderr)
    agent.close()
    zenoh.close()


# The rest of the team


def recording(stream: str, seconds: float) -> Any:
    """The log of a stream, from 0 s on."""
    from dataclasses import replace

    from dgorl import logs
    from dgorl.measurements import Displacement, Odometry, known_at
    from dgorl.simulation import Scenario, simulate

    if stream not in SIMULATED:
        log = logs.read(Path(stream), ("range", "bearing"))
        began = float(int(min(map(known_at, log.measurements)))) - 1.0
        shifted = tuple(_earlier(m, began) for m in log.measurements if known_at(m) <= began + seconds)
        starts = {robot: replace(start, stamp=start.stamp - began) for robot, start in log.starts.items()}
        return replace(log, measurements=shifted, starts=starts)
    sensors, noise = (("rssi",), 1.0) if stream == "rssi" else (("range", "bearing"), 0.1)
    log = simulate(Scenario(steps=round(2 * seconds), area=25.0, sensors=sensors, odometry_noise=noise))
    if stream == "rssi":
        return log
    measurements: list[Any] = []
    for m in log.measurements:
        if isinstance(m, Displacement):  # straight on, then a turn in place, as the simulator moves
            ends = [round(m.start + 0.1 * k, 3) for k in range(6)]
            twists = [(m.dx / 0.4, 0.0)] * 4 + [(0.0, m.dtheta / 0.1)]
            measurements += [Odometry(m.robot, *ends[k : k + 2], *twist) for k, twist in enumerate(twists)]
        else:
            measurements.append(m)
    return replace(log, measurements=tuple(measurements))


def _earlier(m: Any, by: float) -> Any:
    from dataclasses import replace

    names = [name for name in ("start", "end", "stamp") if hasattr(m, name)]
    return replace(m, **{name: getattr(m, name) - by for name in names})


class Peers:
    """The others: they sense, sign and gossip."""

    def __init__(self, log: Any, team: Any, keys: Any) -> None:
        from dgorl.measurements import known_at, robots_of
        from dgorl.team.bundler import Bundler
        from dgorl.team.gossip import Gossip
        from dgorl.team.memory import Air

        self.air = Air()
        self.measured = log.robots[0]
        self.stub = self.air.transport(self.measured)
        self.keys = keys
        self.rows = {
            name: deque(sorted((m for m in log.measurements if robots_of(m)[0] == name), key=known_at))
            for name in log.robots
        }
        self.robots = {}
        for number, name in enumerate(log.robots):
            if name != self.measured:
                gossip = Gossip(name, number, team.roster, keys[name], team.configuration_hash)
                self.robots[name] = (
                    gossip,
                    Bundler(team.team, name, number, substep=team.substep),
                    self.air.transport(name),
                )

    def sensed(self, robot: str) -> Iterator[Any]:
        from dgorl.measurements import known_at

        rows = self.rows[robot]
        while rows and known_at(rows[0]) <= self.air.now:
            yield rows.popleft()

    def turn(self, now: float, cut: bool) -> Turn:
        """Pass time; what the measured agent senses and hears."""
        from dgorl.team.intake import line_of
        from dgorl.team.wire import seal

        self.air.now = now
        for name, (gossip, bundler, transport) in self.robots.items():
            for measurement in self.sensed(name):
                bundler.add(measurement)
            for message in transport.poll():
                reaction = gossip.receive(message.channel, message.sender, message.payload, message.at)
                bundler.heard(reaction.clocks)
                self.send(transport, reaction.send)
            for bundle in bundler.cut(now) if cut else ():
                self.send(transport, gossip.publish(seal(bundle, self.keys[name]), now))
            self.send(transport, gossip.tick(now))
        lines = [line_of(measurement) for measurement in self.sensed(self.measured)]
        return Turn(now, lines, [(m.channel, m.sender, m.payload) for m in self.stub.poll()])

    @staticmethod
    def send(transport: Any, outgoing: Iterable[Any]) -> None:
        for channel, payload in outgoing:
            transport.send(channel, payload)


def measured(
    folder: Path, stream: str, config: Path | None, substep: float, seconds: float, at: Sequence[float], trace: int
) -> None:
    """Print the row of a stream."""
    from dgorl.configuration import Configuration, load, merge
    from dgorl.team.fleet import Fleet, prepare
    from dgorl.team.keys import load_key
    from dgorl.team.team_file import TeamFile

    log = recording(stream, seconds)
    configuration = merge(Configuration(), log.configuration, "log")
    if config is not None:
        configuration = merge(configuration, load(config), str(config))
    prepare(Fleet(log, configuration, folder, log.starts))
    with (folder / "team.yaml").open("a", encoding="utf-8") as file:
        file.write(f"substep: {substep}\n")
    team = TeamFile.read(folder / "team.yaml")
    peers = Peers(log, team, {robot: load_key(folder / f"{robot}.key") for robot in log.robots})
    command = [sys.executable, __file__, "--agent", str(folder), peers.measured, "--trace", str(trace)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
    assert child.stdin is not None
    assert child.stdout is not None
    found: dict[float, tuple[float, float]] = {}
    located, ticks, last, most, first = 0, 0, 0.0, 0.0, 0.0
    for k in range(1, round(seconds / STEP) + 1):
        pickle.dump(peers.turn(k * STEP, k % round(0.5 / STEP) == 0), child.stdin)
        child.stdin.flush()
        answer = pickle.load(child.stdout)
        for channel, payload in answer.messages:
            peers.stub.send(channel, payload)
        if answer.report is not None:
            count, rss, anonymous, last = answer.report
            located, ticks, most = located + count, ticks + 1, max(most, rss)
            first = first or last
            found |= {stamp: (rss, anonymous) for stamp in at if abs(k * STEP - stamp) < STEP / 2}
    pickle.dump(None, child.stdin)
    child.stdin.close()
    child.wait()
    cells = [f"{found[stamp][0]:.1f} ({found[stamp][1]:.1f})" if stamp in found else "-" for stamp in at]
    share = located / ticks / len(log.robots)
    print(
        f"| {Path(stream).name} | {' | '.join(cells)} | {most:.1f} | {1e3 * last / seconds:.1f} | {share:.0%} |",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", nargs="+", default=SIMULATED)
    parser.add_argument("--substep", type=float, default=0.0, help="odometry in shorter rows is composed [s]")
    parser.add_argument("--config", type=Path, help="settings for all streams")
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--at", type=float, nargs="+", default=[40.0, 100.0, 300.0])
    parser.add_argument("--trace", type=int, default=0)
    parser.add_argument("--agent", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.agent:
        agent_process(Path(options.agent[0]), options.agent[1], sys.stdin.buffer, sys.stdout.buffer, options.trace)
        return
    names = [f"RSS (anonymous) at {stamp:.0f} s" for stamp in options.at]
    print(f"| stream | {' | '.join(names)} | most | CPU ms/s | tracked |\n|---{'|---' * (len(names) + 3)}|")
    for stream in options.streams:
        with tempfile.TemporaryDirectory() as folder:
            measured(Path(folder), stream, options.config, options.substep, options.seconds, options.at, options.trace)


if __name__ == "__main__":
    main()
