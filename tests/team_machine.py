"""Things that happen to a team, as rules for hypothesis: drives, gaps, losses, restarts, carrying, clocks that jump."""

from __future__ import annotations

from math import inf

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from dgorl import Configuration
from dgorl.configuration import Motion
from dgorl.estimate import Estimate

from .team_life import SENSORS, Life, Robot, flat, malformed

PERIODS = st.sampled_from([0.5, 1.0, 1.7, 2.5, 4.0])
BACK = st.sampled_from([0.0, 0.25, 0.5, 0.9])
WHICH = st.integers(0, 3)
LARGEST_TEAM = 4

CALM, OUTAGES, ANYTHING = "calm", "outages", "anything"
"""What may happen: nothing that leaves a gap; gaps and losses; also what no robot notices, as being carried."""


class TeamMachine(RuleBasedStateMachine):
    """A :class:`Life` to which things happen. The estimator never raises and is pure; of calm lives it is not wrong."""

    def __init__(self) -> None:
        super().__init__()
        self.kind = ANYTHING
        self.said: dict[str, Estimate] = {}
        self.compared = True

    @initialize(
        kind=st.sampled_from([CALM, OUTAGES, ANYTHING, ANYTHING]),
        seed=st.integers(0, 2**16),
        robots=st.sampled_from([2, 2, 3]),
        window=st.sampled_from([5.0, 10.0, 5.0, "all"]),
        history=st.sampled_from([15.0, 30.0, 180.0]),
        sensors=st.sampled_from([("range",), ("range", "bearing"), ("bearing",), ("rssi",), SENSORS]),
        candidates=st.sampled_from([2, 3]),
        known=st.booleans(),
        lag=st.sampled_from([0.0, 0.0, 0.3]),
    )
    def begin(self, kind, seed, robots, window, history, sensors, candidates, known, lag) -> None:
        self.kind = kind
        motion = Motion(lag=lag if kind == ANYTHING else 0.0)
        configuration = Configuration(window=window, history=history, candidates=candidates, motion=motion)
        self.life = Life(seed, robots, configuration, sensors)
        for name in self.life.robots if known else ():
            self.life.start_known(name)
        self.life.pass_time(1.0)

    # What robots do

    @rule(seconds=PERIODS, back=BACK)
    def drive(self, seconds, back) -> None:
        self.life.pass_time(seconds)
        self.tick(back)

    @rule(
        which=WHICH, v=st.sampled_from([0.0, 0.3, 0.6]), omega=st.sampled_from([-0.6, 0.0, 0.3, 0.6]), seconds=PERIODS
    )
    def turn(self, which, v, omega, seconds) -> None:
        robot = self.robot(which)
        robot.twist = v, omega
        robot.turn(self.life.now)
        self.life.pass_time(seconds)
        self.tick()

    @rule(which=WHICH, row=st.sampled_from([0.1, 0.25, 0.5, 0.7, 1.0]), twists=st.booleans())
    def report_otherwise(self, which, row, twists) -> None:
        robot = self.robot(which)
        robot.row, robot.twists = row, twists

    @precondition(lambda self: len(self.life.robots) < LARGEST_TEAM)
    @rule(row=st.sampled_from([0.2, 0.5, 1.0]), twists=st.booleans())
    def join(self, row, twists) -> None:
        self.life.join(row, twists)

    @rule(which=WHICH)
    def start_known(self, which) -> None:
        """Of a robot whose odometry of now will come: a start holds for the next track where it does not."""
        life = self.life
        life.pass_time(0.25)
        if self.kind == ANYTHING or life.tells(self.name(which)):
            life.start_known(self.name(which))
        life.pass_time(1.0)

    @rule(which=WHICH, other=WHICH)
    def pose_measured(self, which, other) -> None:
        if self.name(which) != self.name(other):
            self.life.pose_measured(self.name(which), self.name(other))

    # What goes wrong

    @rule(which=WHICH, seconds=st.sampled_from([0.5, 1.5, 3.0, 6.0, 12.0, 30.0, 60.0]))
    def sensors_stop(self, which, seconds) -> None:
        if self.kind != CALM:
            self.robot(which).blind = self.life.now + seconds

    @rule(which=WHICH, seconds=st.sampled_from([3.0, 10.0, 30.0]))
    def radio_stops(self, which, seconds) -> None:
        self.robot(which).deaf = self.life.now + seconds

    @rule(which=WHICH, delay=st.sampled_from([2.0, 7.0, 11.0, 25.0, 70.0, 200.0, inf]), seconds=PERIODS)
    def messages_are_late(self, which, delay, seconds) -> None:
        robot = self.robot(which)
        robot.delay, robot.delayed = min(delay, 7.0) if self.kind == CALM else delay, self.life.now + seconds

    @rule(number=st.integers(1, 20))
    def messages_come_twice(self, number) -> None:
        self.life.repeat(number)

    @rule(which=WHICH, down=st.sampled_from([0.0, 1.0, 7.0]), track=st.integers(0, 3))
    def restart(self, which, down, track) -> None:
        """It begins a new epoch, or goes back to one it has lived before."""
        robot, life = self.robot(which), self.life
        robot.track, robot.twin, robot.told = track or life.random.getrandbits(40), None, life.now
        if self.kind != CALM:
            robot.blind = max(robot.blind, life.now + down)

    @rule(which=WHICH, metres=st.sampled_from([0.5, 3.0, 10.0]), noticed=st.booleans())
    def carry(self, which, metres, noticed) -> None:
        if self.kind == ANYTHING or noticed:
            self.life.pass_time(0.25)
            self.life.carry(self.name(which), metres, noticed)
            self.life.pass_time(0.25)  # what is measured at that very moment would be of the place before

    @precondition(lambda self: self.kind == ANYTHING)
    @rule(which=WHICH, seconds=st.sampled_from([-30.0, -5.0, -0.3, 0.3, 5.0, 30.0]))
    def clock_jumps(self, which, seconds) -> None:
        self.robot(which).shift += seconds

    @precondition(lambda self: self.kind == ANYTHING)
    @rule(which=WHICH, track=st.integers(0, 3))
    def twin(self, which, track) -> None:
        """Its odometry comes in two epochs at once."""
        self.robot(which).twin = track or None

    @precondition(lambda self: self.kind != CALM)
    @rule(which=WHICH, back=st.booleans())
    def part(self, which, back) -> None:
        robot = self.robot(which)
        if robot.gone and back:
            robot.told = self.life.now
        robot.gone = not back

    # How it is asked

    @rule(seconds=PERIODS, ticks=st.integers(1, 3))
    def ask_often(self, seconds, ticks) -> None:
        self.life.pass_time(seconds)
        for k in reversed(range(ticks)):
            self.tick(0.3 * k)

    @rule(seconds=st.sampled_from([6.0, 12.0, 35.0]))
    def do_not_ask(self, seconds) -> None:
        self.life.pass_time(seconds, every=2.0)

    @rule(ahead=st.booleans())
    def work_in_parts(self, ahead) -> None:
        """All that a tick needs before it, or what the next will need if all goes well."""
        self.life.work(ahead)
        if not ahead:
            self.tick()

    @precondition(lambda self: not self.compared)
    @rule(spacing=st.sampled_from([1.9, 5.0, 7.3, 12.0]), seed=st.integers(0, 99))
    def compare(self, spacing, seed) -> None:
        """The same measurements in another order, asked at other times, say the same to the bit."""
        self.compared = True
        now = self.life.tick_at
        team = self.life.again(spacing, seed)
        state = team.update(now)
        assert flat({name: team.view(name, state, now) for name in self.said}) == flat(self.said), "impure"

    def teardown(self) -> None:
        if hasattr(self, "life"):
            self.tick()
            self.compare(7.3, 0)

    def tick(self, back: float = 0.0) -> None:
        self.compared = False
        self.said = self.life.tick(back)
        odd = malformed(self.said.values())
        assert not odd, odd
        if self.kind != ANYTHING:
            self.judge(list(self.life.wrong(self.said)))

    def judge(self, wrong: list[str]) -> None:
        """What is said of located peers that are elsewhere, in a life in which all was exact."""
        assert self.kind != CALM or not wrong, wrong

    def name(self, which: int) -> str:
        return f"r{which % len(self.life.robots) + 1}"

    def robot(self, which: int) -> Robot:
        return self.life.robots[self.name(which)]
