"""One live robot: measurements in, bundles out and in, an estimate a tick. METHOD §1, §6.

No sockets, threads or clocks in here: time is an argument, the transport and the journal are given.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from math import floor, inf

from dgorl.errors import MeasurementError
from dgorl.measurements import Measurement, known_at
from dgorl.team.bulletin import Bulletins
from dgorl.team.bundler import Bundler, Step
from dgorl.team.bundles import Sealed
from dgorl.team.envelope import Reason, Rejected
from dgorl.team.estimator import Estimator
from dgorl.team.gossip import Gossip, Reaction
from dgorl.team.intake import Moved, read_line
from dgorl.team.journal import Journal
from dgorl.team.journal_schema import JournalError
from dgorl.team.keys import Signer
from dgorl.team.rejections import Rejection
from dgorl.team.report import Carried, Complaint, Report
from dgorl.team.team_file import TeamFile
from dgorl.team.transport import BULLETINS, Transport
from dgorl.team.voice import Outgoing
from dgorl.team.wall import Failure
from dgorl.team.wire import open_sealed, seal

BAD_LINE, DISK = "bad line", "journal"
"""Reasons counted of one's own measurements, and of what the disk refused."""
OVERLAP = 0.05
"""Odometry that begins this much [s] before the end of what came before is worth a word."""
LINE_REPEATED = 80
"""So much of a bad line is repeated in the answer to it."""
AT_ONCE = 8
"""So many own bundles are sent at once when the disk takes them again; the earlier ones follow in their turn."""


class Agent:
    """Assembles transport, journal, bundler, gossip and estimator. Call :meth:`step` ten times a second or more.

    now: the robot's clock [s]; it never runs backwards. wire_bytes: sent by this process, headers included.
    """

    def __init__(
        self,
        robot: str,
        team: TeamFile,
        signer: Signer,
        transport: Transport,
        journal: Journal,
        now: float,
        wire_bytes: Callable[[], int | None] = lambda: None,
    ) -> None:
        self.robot, self.team = robot, team
        self.transport, self.journal = transport, journal
        self.troubles: deque[str] = deque(maxlen=100)
        """What went wrong and a person should hear of; taken out by who logs it."""
        self.remarks: deque[tuple[str, dict[str, object]]] = deque(maxlen=100)
        """... of the robot's own sensors and epochs: the event and more about it."""
        self._told_until = -inf
        self._signer, self._wire_bytes = signer, wire_bytes
        self._rejected: Counter[str] = Counter()
        self._bundles = 0
        self._tick = floor(now / team.configuration.period)
        self._begin(now, None)

    def _begin(self, now: float, before: Gossip | None) -> None:
        """The journal's epoch begins, or goes on; before: the gossip of one that just ended."""
        team, journal, key = self.team, self.journal, (self.robot, self.journal.epoch)
        self._estimator = Estimator(key, team, journal, self._opened, self._trouble)
        self._gossip = Gossip(
            *key,
            team.roster,
            self._signer,
            team.configuration_hash,
            history=team.configuration.history,
            born=now if journal.born is None else journal.born,
            made=journal.next_sequence,
            began=now,
            before=before,
        )
        self._bulletins = Bulletins(team.team, *key, team.configuration_hash, self._signer)
        self._unsent: deque[Sealed] = deque()
        self._estimating: float | None = None
        track = self._remember(now)
        self._bundler = Bundler(team.team, *key, sequence=journal.next_sequence, track=track, substep=team.substep)

    def take_line(self, line: bytes, now: float, ahead: float = 0.0) -> Complaint | None:
        """Take a measurement of the robot's own as a JSON line (:mod:`dgorl.team.intake`); the answer to a bad one.

        ahead: how far the clock that stamped it is ahead of the robot's [s].
        """
        history = self.team.configuration.history
        try:
            self.take(read_line(line, self.robot, self.team.roster.robots, now, history, ahead))
        except MeasurementError as error:
            self._rejected[BAD_LINE] += 1
            return Complaint(str(error), line[:LINE_REPEATED].decode(errors="replace"))
        return None

    def take(self, measured: Measurement | Moved) -> None:
        """Take a measurement of the robot's own. Raises MeasurementError if it is not."""
        if isinstance(measured, Moved):
            self._bundler.moved(measured.stamp)
        else:
            self._bundler.add(measured)
            if isinstance(measured, Step):
                self._follow(measured)

    def waiting(self) -> list[Measurement | Moved]:
        """The robot's own measurements that were never sent, and when it was carried among them."""
        found: list[Measurement | Moved] = []
        track = 0
        for sealed in self._unsent:
            rows = sealed.bundle.measurements
            if sealed.bundle.track > track and rows:
                track = sealed.bundle.track
                found.append(Moved(min(row.start if isinstance(row, Step) else known_at(row) for row in rows)))
            found.extend(rows)
        return [*found, *self._bundler.waiting]

    def take_all(self, measured: Iterable[Measurement | Moved]) -> None:
        """Take what an agent before this one could not send."""
        for one in measured:
            self.take(one)

    @property
    def rejections(self) -> deque[Rejection]:
        """What others said that was not taken; taken out by who logs it."""
        return self._gossip.rejected.untold

    @property
    def failures(self) -> deque[Failure]:
        """Errors of the estimator that a person should hear of; taken out by who logs them."""
        return self._estimator.failures

    @property
    def due(self) -> float:
        """When the next tick is [s]; now, so to speak, while one is being computed in parts."""
        return -inf if self._estimating is not None else (self._tick + 1) * self.team.configuration.period

    def step(self, now: float, *, parts: bool = False) -> Report | None:
        """Hear the network, answer it; when a tick is due, cut, commit and publish a bundle and estimate.

        Ticks that were missed are skipped: the bundle holds all that is known, and the estimate depends on the data and
        on its own time alone. parts: where many nodes are missing (after a restart, a partition) compute one of them
        and return None, so that the network is heard in between; call again soon.
        """
        self.hear(now)
        if self._estimating is None:
            period = self.team.configuration.period
            tick = floor(now / period)
            if tick <= self._tick:
                return None
            self._tick = tick
            self.publish(tick * period, now)
            self._estimating = tick * period
            self._estimator.admit(tick * period)
        stamp = self._estimating
        if parts and self._estimator.prepare(stamp):
            return None
        report = self._report(stamp)
        self._tell_watchers(report, now)
        return report

    def rest(self) -> None:
        """Compute what the next tick will need; call it when the report of the last one is out."""
        self._estimator.anticipate(self._estimator.estimated + self.team.configuration.period)

    def hear(self, now: float) -> None:
        """Hear the network and answer it."""
        for message in self.transport.poll():
            self._react(self._gossip.receive(message.channel, message.sender, message.payload, message.at))
        self._send(self._gossip.tick(now))
        if why := self._gossip.witness.ended(now):
            self._renew(why, now)

    def _renew(self, why: str, now: float) -> None:
        """A new epoch begins, as after a restart; what was measured and not sent yet belongs to it."""
        ended, waiting = self.journal.epoch, self.waiting()
        try:
            self.journal.renew()
        except JournalError as error:
            self._trouble(error)
            return
        self._rejected += self._estimator.rejected + self._bundler.dropped
        self._begin(now, self._gossip)
        self.take_all(waiting)
        fields: dict[str, object] = {"why": why, "ended": f"{ended:016x}", "epoch": f"{self.journal.epoch:016x}"}
        self.remarks.append(("this robot's epoch has ended: a new one begins", fields))

    def publish(self, until: float, now: float) -> None:
        """Cut what is known at ``until`` [s], commit it and tell the others; what the disk refuses waits."""
        for bundle in self._bundler.cut(until):
            self._unsent.append(seal(bundle, self._signer))
        while self._unsent and self._unsent[0].bundle.cut < until - self.team.configuration.history:
            self._unsent.popleft()
            self._rejected["not committed in time"] += 1
        if not self._unsent:
            return
        try:
            self.journal.commit_own(*self._unsent)
        except JournalError as error:
            self._trouble(error)
            return
        self._bundles += len(self._unsent)
        while self._unsent:
            sealed = self._unsent.popleft()
            self._estimator.offer(sealed)
            if len(self._unsent) < AT_ONCE:
                self._send(self._gossip.publish(sealed, now))
            else:
                self._gossip.hold(sealed, now)

    def estimate(self, now: float, *, final: bool = False) -> Report:
        """Admit what came and estimate at ``now`` [s]; journal both."""
        self._estimator.admit(now, final=final)
        return self._report(now, final=final)

    def _report(self, now: float, *, final: bool = False) -> Report:
        peers, clocks = self._estimator.said(now)
        self._estimating = None
        try:
            self.journal.flush()
        except JournalError as error:
            self._trouble(error)
        traffic = self.transport.traffic
        return Report(
            robot=self.robot,
            stamp=now,
            peers=dict(peers),
            data=self._estimator.data,
            present=tuple(sorted(self.transport.present())),
            clocks=dict(clocks),
            traffic=Carried(
                traffic.sent_messages,
                traffic.sent_bytes,
                traffic.received_messages,
                traffic.received_bytes,
                traffic.dropped,
                self._wire_bytes(),
                self._bundles,
            ),
            rejected=self._all_rejected(),
            tick_s=self._estimator.spent,
            final=final,
        )

    def close(self) -> None:
        """Leave the network and let go of the journal. Raises JournalError when the disk refuses."""
        self.transport.close()
        self.journal.close()

    def _remember(self, now: float) -> int:
        """Give gossip and estimate what the journal knows; the track the robot is on."""
        known = list(self._opened(self.journal.known))
        self._gossip.restore(known, self.journal.admitted, now)
        for sealed in known:
            self._estimator.offer(sealed)
        own = (s.bundle.track for s in known if (s.bundle.robot, s.bundle.epoch) == (self.robot, self.journal.epoch))
        return max(own, default=0)

    def _opened(self, known: Iterable[bytes]) -> Iterator[Sealed]:
        """Bundles of the journal that the team as it is now still takes."""
        for data in known:
            try:
                yield open_sealed(data, self.team.roster)
            except Rejected as error:
                self._rejected[error.reason] += 1

    def _react(self, reaction: Reaction) -> None:
        for sealed in reaction.new:
            self.journal.receive(sealed)
            self._estimator.offer(sealed)
        self._bundler.heard(reaction.clocks)
        self._send(reaction.send)

    def _send(self, outgoing: tuple[Outgoing, ...]) -> None:
        for channel, payload in outgoing:
            self.transport.send(channel, payload)

    def _follow(self, row: Step) -> None:
        """Notice odometry that is not the next: a clock that was set, or two programs that feed one robot."""
        by = self._told_until - row.start
        if OVERLAP < by < inf:
            what = "odometry overlaps what came before: of two rows for one time that counts which begins first"
            self.remarks.append((what, {"by_s": round(by, 3), "start": row.start, "end": row.end}))
        self._told_until = max(self._told_until, row.end)

    def _tell_watchers(self, report: Report, now: float) -> None:
        bulletin = self._bulletins.due(report, self._gossip.losses(now), now)
        if bulletin is not None:
            self.transport.send(BULLETINS, bulletin)

    def _all_rejected(self) -> dict[str, int]:
        total = Counter(self._estimator.rejected)
        for counter in (self._rejected, self._bundler.dropped, self._gossip.rejected):
            total.update({str(reason): count for reason, count in counter.items()})
        if refused := self.transport.traffic.refused:
            total[str(Reason.RATE)] += refused
        return dict(sorted(total.items()))

    def _trouble(self, error: JournalError) -> None:
        self._rejected[DISK] += 1
        self.troubles.append(str(error))
