"""The process round an agent: its clock, its inputs and outputs, signals and logs."""

from __future__ import annotations

import logging
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dgorl.configuration import as_dict
from dgorl.evaluation.output import peak_rss_mb
from dgorl.localizer import RETAINED
from dgorl.replay import start_priors
from dgorl.team.agent import Agent
from dgorl.team.faults import Faults, Faulty
from dgorl.team.footprint import keep_small
from dgorl.team.interfaces import Advice, Interfaces, addresses
from dgorl.team.journal import Journal, Synchronous
from dgorl.team.journal_none import NoJournal, refused_by_disk, room
from dgorl.team.journal_place import make_folder
from dgorl.team.journal_schema import JournalError
from dgorl.team.json_logs import tell_repeats
from dgorl.team.keys import UNSIGNED, KeyFileError, Signer, load_key
from dgorl.team.lines import WAITING, LinesIn, LinesOut
from dgorl.team.local_session import LocalSession, port_of
from dgorl.team.pace import Pace, Wall
from dgorl.team.report import Report
from dgorl.team.team_file import TeamFile
from dgorl.team.teller import Teller
from dgorl.team.transport import Transport
from dgorl.team.wire_bytes import WireBytes
from dgorl.team.zenoh_transport import ZenohTransport

BACKWARDS = 1.0
"""A clock that is behind the journal's last tick by more than this [s] was set back."""
LOOK = 0.03
"""The network is looked at this often [s] ..."""
LEAST = 0.002
"""... in fast fleets more often, but no oftener than this [s]."""

NETWORK_EVERY = 1.0
"""Addresses of interfaces are looked at this often [s]."""

TRY_EVERY = 2.0
"""A disk that took nothing is tried again this often [s]."""

GRACE = 0.003
"""A tick is computed this much later [s], when the robot's own measurements up to it have come."""

UNBOUNDED = 30.0
"""With ``window: all`` the journal keeps as much as for a window of this length [s]."""

log = logging.getLogger("dgorl.agent")


@dataclass(frozen=True)
class Setup:
    """What one agent's process is told. Times are on the robot's clock [s].

    stdin: where its measurements come from, beside ``local``. until: the time of its last tick; it goes on exchanging
    bundles for ``settle`` [s] more and then leaves. pace: of a fleet's clock; None is the machine's own.
    """

    robot: str
    team: TeamFile
    journal: Path
    key: Path | None = None
    synchronous: Synchronous = "full"
    stdin: LinesIn | None = None
    local: str | None = None
    faults: Faults | None = None
    pace: Pace | None = None
    until: float | None = None
    settle: float = 0.0


def run(setup: Setup) -> None:
    """One agent until it is told to stop (SIGTERM, SIGINT) or its time has come; it leaves in good order either way.

    Raises DgorlError, and KeyboardInterrupt when all is done after SIGINT.
    """
    keep_small()
    stop, signals = threading.Event(), []

    def told(number: int, _: object) -> None:
        signals.append(number)
        stop.set()

    before = {number: signal.signal(number, told) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        process = _Process(setup, stop)
        process.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if signal.SIGINT in signals:
        raise KeyboardInterrupt
    if process.again and not signals:
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


class _Process:
    def __init__(self, setup: Setup, stop: threading.Event) -> None:
        self.setup, self.stop = setup, stop
        wall = Wall()
        self.now = wall.now if setup.pace is None else setup.pace.now
        self.ahead: Callable[[], float] = wall.ahead if setup.pace is None else lambda: 0.0
        self.rate = 1.0 if setup.pace is None else setup.pace.rate
        self.lines: queue.Queue[bytes] = queue.Queue(WAITING)
        self.out = LinesOut(sys.stdout.fileno())
        self.local: LocalSession | None = None
        self.teller = Teller()
        self._try_at = self._network_at = time.monotonic()
        self.interfaces = Interfaces(setup.team.transport)
        self.again = False

    def run(self) -> None:
        setup = self.setup
        ports = [] if setup.local is None else [port_of(setup.local)]
        signer = _signer(setup)
        journal = self._journal()
        try:
            transport = self._transport()
            try:
                if setup.local is not None:
                    self.local = LocalSession(setup.robot, setup.local, self._take)
                agent = Agent(setup.robot, setup.team, signer, transport, journal, self.now(), WireBytes(ports))
                if setup.stdin is not None:
                    threading.Thread(target=self._read, args=(setup.stdin,), daemon=True).start()
                self._joined(journal)
                while isinstance(journal, NoJournal) and self._loop(agent, self._disk_takes_entries):
                    journal = self._journal()
                    waiting = agent.waiting()
                    agent = Agent(setup.robot, setup.team, signer, transport, journal, self.now(), WireBytes(ports))
                    agent.take_all(waiting)
                    self._joined(journal)
                if not isinstance(journal, NoJournal):
                    self._loop(agent)
            finally:
                transport.close()
                if self.local is not None:
                    self.local.close()
        finally:
            journal.close()
            self.out.close()
        tell_repeats(all_of_it=True)
        log.info("left", extra={"fields": {"cpu_s": round(time.process_time(), 3), "peak_rss_mb": peak_rss_mb()}})

    def _journal(self) -> Journal:
        """The journal, or what stands in for it while the disk is full. Raises JournalError for a mistake."""
        try:
            journal = _journal(self.setup, self.now())
        except JournalError as error:
            if not refused_by_disk(error):
                raise
            journal = NoJournal(self.setup.journal, self.setup.robot, error)
        first = journal.last is None and len(journal.notices) == 1  # a new journal: that an epoch begins is no trouble
        for notice in journal.notices:
            log.log(logging.INFO if first else logging.WARNING, notice)
        return journal

    def _disk_takes_entries(self) -> bool:
        """Whether to try again with a journal; looked at seldom, as an attempt writes."""
        if time.monotonic() < self._try_at:
            return False
        self._try_at = time.monotonic() + TRY_EVERY
        return room(self.setup.journal)

    def _joined(self, journal: Journal) -> None:
        fields: dict[str, object] = {"team": self.setup.team.team, "journal": str(self.setup.journal.absolute())}
        if isinstance(journal, NoJournal):
            what = "joined without a journal: its own measurements wait, it estimates from what the others say"
            log.error(what, extra={"fields": fields | {"why": journal.why}})
            return
        fields |= {"epoch": f"{journal.epoch:016x}", "next": journal.next_sequence}
        log.info("joined", extra={"fields": fields})

    def _loop(self, agent: Agent, anew: Callable[[], bool] = lambda: False) -> bool:
        """Steps until it is to stop; then what came last is committed and told, and the last estimate made.

        anew: asked in every pass whether to end at once instead; whether it did.
        """
        setup = self.setup
        end = float("inf") if setup.until is None else setup.until
        look = max(min(LOOK, LOOK * 10 / self.rate), LEAST)
        grace = GRACE * self.rate
        ended = False
        while not self.stop.is_set() and (now := self.now()) < end + setup.settle:
            self._measurements(agent)
            if anew():
                return True
            if ended:
                agent.hear(now)
                agent.publish(end, now)
            elif now >= min(agent.due, end) + grace:
                report = agent.step(min(now, end), parts=True)
                if report is not None:
                    self._tell(report)
                    self.stop.wait(LEAST)  # what is told is written by another thread
                    agent.rest()
                ended = now >= end and agent.due > end
            else:
                agent.hear(now)
            self.teller.look(agent)
            if self.interfaces.watched and time.monotonic() >= self._network_at:
                self._look_at_network(self.network)
            self.stop.wait(min(look, max(agent.due + grace - self.now(), 0.0) / self.rate))
        self._measurements(agent)
        last = min(self.now(), end)
        agent.hear(self.now())
        agent.publish(last, self.now())
        self._tell(agent.estimate(last, final=True))
        self.teller.look(agent)
        return False

    def _measurements(self, agent: Agent) -> None:
        ahead = self.ahead()
        for _ in range(self.lines.qsize()):
            complaint = agent.take_line(self.lines.get_nowait(), self.now(), ahead)
            if complaint is not None:
                log.warning("bad line", extra={"fields": {"what": complaint.what, "line": complaint.line}})
                self.out.write(complaint.text())
                if self.local is not None:
                    self.local.error(complaint.text())

    def _tell(self, report: Report) -> None:
        self.teller.report(report)
        line = report.line()
        self.out.write(line)
        if self.local is not None:
            self.local.estimate(line)

    def _take(self, line: bytes) -> None:
        try:
            self.lines.put_nowait(line)
        except queue.Full:
            log.warning("too many lines at once: one is lost")

    def _read(self, stdin: LinesIn) -> None:
        """Who writes faster than lines are taken waits."""
        for line in stdin:
            self.lines.put(line)
        log.info("no more measurements on stdin")

    def _transport(self) -> Transport:
        setup = self.setup
        folder = setup.team.path.parent
        team = setup.team
        members = team.roster.robots
        self.network = ZenohTransport(team.team, setup.robot, team.transport, self.now, folder, members, joins=False)
        self._look_at_network(self.network)
        transport: Transport = self.network
        if setup.faults is not None:
            when = self.now if setup.pace is None else setup.pace.recording
            transport = Faulty(transport, setup.robot, setup.faults, when)
        return transport

    def _look_at_network(self, network: ZenohTransport) -> None:
        """Join the network when there is one, and say so while there is none. Raises NetworkError."""
        self._network_at = time.monotonic() + NETWORK_EVERY
        match self.interfaces.look(addresses(self.setup.team.transport.group)):
            case Advice.WAIT:
                log.warning("no network: no interface has an address; the team is out of reach")
            case Advice.JOIN:
                network.join()
            case Advice.BEGIN_ANEW:
                log.warning("an interface has a new address: the agent starts anew to be heard there")
                self.again = True
                self.stop.set()


def _signer(setup: Setup) -> Signer:
    """The robot's key. Raises KeyFileError when it is missing or not the one the team knows."""
    if setup.team.insecure:
        return UNSIGNED
    if setup.key is None:
        raise KeyFileError(f"{setup.robot} needs its key: give --key FILE, or `insecure: true` in {setup.team.path}")
    signer = load_key(setup.key)
    if signer.public != setup.team.robots[setup.robot]:
        raise KeyFileError(f"{setup.key}: not the key of {setup.robot} in {setup.team.path}")
    return signer


def _journal(setup: Setup, now: float) -> Journal:
    """The robot's journal. One from the clock's future is set aside: stamps must not run backwards within an epoch."""
    journal = _opened(setup)
    if journal.last is None or journal.last <= now + BACKWARDS:
        return journal
    journal.close()
    aside = setup.journal.with_name(f"{setup.journal.name}.ahead-{int(journal.last)}")
    log.warning(
        "the journal is ahead of the clock: set aside, a new epoch begins",
        extra={"fields": {"by_s": round(journal.last - now, 1), "aside": str(aside)}},
    )
    setup.journal.replace(aside)
    setup.journal.with_name(setup.journal.name + "-mark").unlink(missing_ok=True)
    return _opened(setup)


def _opened(setup: Setup) -> Journal:
    configuration = setup.team.configuration
    make_folder(setup.journal)
    window = UNBOUNDED if configuration.window == "all" else float(configuration.window)
    return Journal.open(
        setup.journal,
        setup.robot,
        setup.team.roster,
        settings=as_dict(configuration),
        keep=configuration.history + window + RETAINED,
        starts=start_priors(setup.team.starts),
        synchronous=setup.synchronous,
    )
