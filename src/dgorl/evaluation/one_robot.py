"""What one robot's program costs: a Localizer in a process of its own, fed at the stream's pace.

    python -m dgorl.evaluation.one_robot '{"seed": 0}' known 1

Counted is the CPU time of the whole process, from the first tick's wait to the last tick: taking every robot's
measurements, Alg. 3, reading all peers, waking up. Not counted are the interpreter's start, simulating the stream
beforehand, and what a live robot has besides: radio, signatures, the disk.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from dgorl.configuration import Configuration, merge
from dgorl.errors import DgorlError
from dgorl.estimate import Status
from dgorl.evaluation.workers import single_threaded
from dgorl.localizer import Localizer
from dgorl.measurements import known_at
from dgorl.replay import known_starts
from dgorl.simulation import Scenario, simulate


@dataclass(frozen=True)
class Cost:
    """CPU of one robot's process over a stream; percent of one core; tracking: share of its ticks with all tracked."""

    seed: int
    cpu_s: float
    stream_s: float
    tracking: float

    @property
    def percent(self) -> float:
        return 100 * self.cpu_s / self.stream_s


@contextmanager
def processes(scenarios: Sequence[Scenario], initial: str, pace: float = 1.0) -> Iterator[list[subprocess.Popen[str]]]:
    """One process a scenario, started at once; they end with the context, or by themselves after the stream."""
    command = [sys.executable, "-m", "dgorl.evaluation.one_robot"]
    running: list[subprocess.Popen[str]] = []
    try:
        with single_threaded():
            for scenario in scenarios:
                given = [json.dumps(asdict(scenario)), initial, str(pace)]
                pipe = subprocess.PIPE
                running.append(
                    subprocess.Popen([*command, *given], stdout=pipe, stderr=pipe, text=True, start_new_session=True)
                )
        yield running
    finally:
        for process in running:
            process.kill()
            process.communicate()


def cost(process: subprocess.Popen[str]) -> Cost:
    """Wait for a process and take what it measured. Raises DgorlError."""
    out, errors = process.communicate()
    if process.returncode != 0:
        last = errors.strip().splitlines()[-1] if errors.strip() else f"exit code {process.returncode}"
        raise DgorlError(f"the process of one robot failed: {last}")
    return Cost(**json.loads(out))


def measure(scenario: Scenario, initial: str, pace: float) -> Cost:
    """Localise r1's peers, a tick when its time has come; ``pace`` times as fast as the stream."""
    log = simulate(scenario)
    starts = known_starts(log) if initial == "known" else []
    waiting = sorted([*starts, *log.measurements], key=known_at)
    localizer = Localizer(log.robots[0], merge(Configuration(), log.configuration, "the simulated log"))
    tracking = given = 0
    began, cpu = time.monotonic(), time.process_time()
    for step in range(1, scenario.steps + 1):
        now = step * scenario.period
        time.sleep(max(began + now / pace - time.monotonic(), 0.0))
        while given < len(waiting) and known_at(waiting[given]) <= now:
            localizer.add(waiting[given])
            given += 1
        estimate = localizer.update(now)
        tracking += all(estimate[peer].status is Status.TRACKED for peer in log.robots[1:] if peer in estimate)
    cpu = time.process_time() - cpu
    return Cost(scenario.seed, cpu, scenario.steps * scenario.period, tracking / scenario.steps)


def main() -> None:
    setting, initial, pace = sys.argv[1:]
    given = json.loads(setting)
    scenario = Scenario(**{**given, "sensors": tuple(given["sensors"])} if "sensors" in given else given)
    print(json.dumps(asdict(measure(scenario, initial, float(pace)))))


if __name__ == "__main__":
    main()
