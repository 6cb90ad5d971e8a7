"""What an agent's log says of its troubles: disk, estimator, neighbours, own sensors, the machine it runs on."""

from __future__ import annotations

import logging
import time
from collections import Counter

from dgorl.team.agent import BAD_LINE, DISK, Agent
from dgorl.team.envelope import Reason
from dgorl.team.json_logs import tell_repeats
from dgorl.team.report import Report

STOPPED = 5.0
"""An agent that came to nothing for longer than this [s] was stopped, suspended or starved."""

SECOND = 1.0
"""Counts are looked at this often [s]."""

USUAL = frozenset({Reason.REPLAYED, Reason.EPOCH})
"""Bad networks and restarts do this; it is no trouble."""

log = logging.getLogger("dgorl.agent")


class Teller:
    """Call :meth:`look` in every pass of the loop and :meth:`report` with every report."""

    def __init__(self) -> None:
        self._passed = self._looked = time.monotonic()
        self._spent = time.process_time()
        self._rejected: Counter[str] = Counter()

    def look(self, agent: Agent) -> None:
        """Log what went wrong since the last look."""
        now = time.monotonic()
        if now - self._passed > STOPPED:
            spent = time.process_time() - self._spent
            fields = {"for_s": round(now - self._passed, 1), "of_it_computing_s": round(spent, 1)}
            log.warning("no time: the agent was stopped, suspended, or starved", extra={"fields": fields})
        self._passed = now
        tell_troubles(agent)
        if now - self._looked >= SECOND:
            self._looked, self._spent = now, time.process_time()
            tell_repeats()

    def report(self, report: Report) -> None:
        """Log what was rejected since the last report and nobody is named for."""
        for reason, count in report.rejected.items():
            if (grown := count - self._rejected[reason]) > 0 and reason.partition(": ")[0] not in NAMED:
                fields = {"reason": reason, "times": grown}
                log.warning("something was not taken", extra={"fields": fields, "kind": reason})
        self._rejected = Counter(report.rejected)


NAMED = frozenset({BAD_LINE, DISK, *(str(reason) for reason in Reason if reason is not Reason.RATE)})
"""Reasons that are told with more than their count."""


def tell_troubles(agent: Agent) -> None:
    """Log what went wrong since it was asked last."""
    while agent.troubles:
        log.error(agent.troubles.popleft())
    while agent.remarks:
        event, fields = agent.remarks.popleft()
        log.warning(event, extra={"fields": fields})
    while agent.rejections:
        sender, reason, what = agent.rejections.popleft()
        kind = f"{reason}, from {sender if sender in agent.team.robots else 'strangers'}"
        level = logging.DEBUG if reason in USUAL else logging.WARNING
        log.log(level, "a message was not taken", extra={"fields": {"from": sender, "what": what}, "kind": kind})
    while agent.failures:
        failure = agent.failures.popleft()
        fields = {"tick": failure.tick, "journal": str(agent.journal.path), "entry": failure.entry}
        fields |= {"repeated": failure.repeated} if failure.repeated else {}
        what = "the estimator failed; no peer is located until it works again"
        log.error(what, exc_info=failure.error, extra={"fields": fields})
