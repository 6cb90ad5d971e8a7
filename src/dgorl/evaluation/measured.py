"""What clocks tell, in the same run as the trials: one robot's process, and the solver beside its peers."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from threading import Thread
from typing import Any

from dgorl.errors import MissingExtraError
from dgorl.evaluation import one_robot
from dgorl.evaluation.one_robot import Cost
from dgorl.evaluation.results import Parts, write_text
from dgorl.evaluation.solvers import compare_solvers
from dgorl.evaluation.solvers.compiled import g2o_library
from dgorl.simulation import Scenario

ROBOTS = 10
"""at most so many processes of one robot each; they run beside the trials, as they mostly sleep"""
GRAPHS = 10
PEERS = ("g2o",)


class Clocked:
    """Measurements of CPU time that go on while the trials run, or are known from an earlier run."""

    def __init__(self, parts: Parts, scenarios: Sequence[Scenario], pace: float) -> None:
        self._scenarios = list(scenarios[:ROBOTS])
        self._running: list[Any] = []
        self._compiler: Thread | None = None
        about = [asdict(scenario) for scenario in self._scenarios]
        self._robots = parts.path_of("robots", scenarios=about, pace=pace)
        self._solvers = parts.path_of("solvers", graphs=self._graphs, peers=PEERS, seed=scenarios[0].seed)

    @property
    def _graphs(self) -> int:
        return min(GRAPHS, len(self._scenarios))

    @classmethod
    @contextmanager
    def started(cls, parts: Parts, scenarios: Sequence[Scenario], pace: float) -> Iterator[Clocked]:
        """Start what is not known yet; nothing of it is left running at the end."""
        clocked = cls(parts, scenarios, pace)
        if not clocked._solvers.exists():
            clocked._compiler = Thread(target=_compile, daemon=True)
            clocked._compiler.start()
        missing = [] if clocked._robots.exists() else clocked._scenarios
        with one_robot.processes(missing, "known", pace) as clocked._running:
            yield clocked

    def robots(self) -> list[Cost]:
        """CPU of one robot's process, one a scenario; waits for them. Raises DgorlError."""
        if not self._robots.exists():
            costs = [one_robot.cost(process) for process in self._running]
            write_text(json.dumps([asdict(cost) for cost in costs]), self._robots)
        return [Cost(**entry) for entry in json.loads(self._robots.read_text(encoding="utf-8"))]

    def solvers(self) -> Mapping[str, Any]:
        """``summary`` and ``missing`` of the solvers' comparison; call it when nothing else runs."""
        if not self._solvers.exists():
            if self._compiler is not None:
                self._compiler.join()
            table = compare_solvers(self._graphs, self._scenarios[0].seed, peers=PEERS).as_dict()
            write_text(json.dumps(table), self._solvers)
        found: Mapping[str, Any] = json.loads(self._solvers.read_text(encoding="utf-8"))
        return found


def _compile() -> None:
    """Compile g2o beside the trials; why it cannot be is told by the comparison."""
    with suppress(MissingExtraError):
        g2o_library()
