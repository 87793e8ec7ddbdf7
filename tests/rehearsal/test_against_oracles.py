"""Whatever comes, whenever, and whatever is done to the clock and the table: the stage does what plain models say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from router.compiler.program import Program
from router.rehearsal.rehearsal import START, DeadmanChanged, Dropped, Event, Rehearsal, Sent
from tests.oracles.ages_and_rates import Freshness, RateLimit
from tests.oracles.deadman import Deadman, Deadmen
from tests.rehearsal.test_rehearsal import datagram
from tests.small_tables import BASESTATION, HEAD, SENSOR_BOARD, program

MS = 1_000_000
TTL, RATE = 200 * MS, 20.0
BRAKE = b"\xca\x01\x02\x08\x01"

ROUTES = """\
  imu_info: {source: sensor_board, destinations: [{endpoint: basestation, max_rate: 20 Hz}], ttl: 200ms}
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 200ms
    deadman: {SETTINGS, send: {manual_brake: {brake: true}}, to: [driving_board], disarmed_by: [manual_arm]}
  manual_arm: {source: basestation, destinations: [driving_board], ttl: 200ms, deadman: {none: not in this test}}
"""
SETTINGS = ("timeout: 500ms, repeat: 100ms", "timeout: 300ms, repeat: 70ms", "timeout: 900ms, repeat: 400ms")
PAYLOADS = {
    "imu_info": datagram("imu_info"),
    "manual_drive": datagram("manual_drive"),
    "manual_arm": datagram("manual_arm"),
}

AGES = st.one_of(st.just(0), st.integers(0, 400 * MS), st.sampled_from((TTL - 1, TTL, TTL + 1)))
STEPS = st.one_of(st.integers(0, 30 * MS), st.integers(0, 1200 * MS), st.sampled_from((50 * MS, 300 * MS, 500 * MS)))
AHEAD = st.one_of(st.integers(-600 * MS, 600 * MS), st.sampled_from((0, 3 * MS, 3600 * 1000 * MS)))


@cache
def table(number: int) -> Program:
    """The table with these settings of the deadman; all of them count the same, so their counters are."""
    with TemporaryDirectory() as folder:
        made: Program = program(Path(folder), ROUTES.replace("SETTINGS", SETTINGS[number]), HEAD)
    return made


class Model:
    """What the tables mean, by the oracles. `happened` is in the words of a rehearsal's events."""

    def __init__(self, first: Program) -> None:
        self.now, self.ahead = START, 0
        self.happened: list[Event] = []
        self._freshness, self._limit = Freshness(), RateLimit(RATE)
        self._deadmen = Deadmen()
        self._deadman = self._added(first)

    def _added(self, of: Program) -> Deadman:
        (plan,) = of.deadmen
        return self._deadmen.add(plan)

    def datagram(self, case: str, age: int) -> None:
        wall = self.now + self.ahead
        born = self._freshness.born(wall - age, wall, self.now)
        target = "basestation" if case == "imu_info" else "driving_board"
        if self.now > (born.youngest if case == "imu_info" else born.oldest) + TTL:
            self._drop(case, target, "stale")
        elif case == "imu_info" and not self._limit.may_pass(self.now):
            self._drop(case, target, "rate_limited")
        else:
            feeds = [] if case == "imu_info" else [(self._deadman, case == "manual_arm")]
            self._deadmen.command(self.now, feeds, target, PAYLOADS[case])
            self._tell(case)

    def advance(self, to: int) -> None:
        while (due := self._deadmen.next_due) is not None and due <= to:
            self.now = max(self.now, due)
            self._deadmen.serve(self.now)
            self._tell("manual_drive", by_deadman=True)
        self.now = to

    def reload(self, then: Program) -> None:
        (plan,) = then.deadmen
        if plan != self._deadman.plan:
            earlier, self._deadman = self._deadman, self._added(then)
            self._deadmen.replace(self._deadman, earlier)
            self._tell("manual_drive", by_deadman=True)

    def close(self) -> None:
        for deadman in self._deadmen.deadmen:
            self._deadmen.end(deadman)
        self._tell("manual_drive", by_deadman=True)

    def _drop(self, route: str, target: str, reason: str) -> None:
        self.happened.append(Dropped(self.now, route, target, reason))

    def _tell(self, route: str, *, by_deadman: bool = False) -> None:
        """What the deadmen have noted."""
        for target, data in self._deadmen.sent:
            self.happened.append(Sent(self.now, route, target, data, by_deadman))
        for what, name, _, _ in self._deadmen.events:
            self.happened.append(DeadmanChanged(self.now, name, what == "tripped"))
        self._deadmen.sent.clear()
        self._deadmen.events.clear()


class AgesRatesAndDeadmen(RuleBasedStateMachine):
    @initialize(number=st.integers(0, len(SETTINGS) - 1))
    def start(self, number: int) -> None:
        self.program = table(number)
        self.stage, self.model = Rehearsal(self.program), Model(self.program)

    @rule(case=st.sampled_from((*PAYLOADS, "imu_info", "manual_drive")), age=AGES)
    def receive(self, case: str, age: int) -> None:
        peer = SENSOR_BOARD if case == "imu_info" else BASESTATION
        now = self.stage.now + self.stage.ahead
        self.stage.datagram("trimmed", peer, PAYLOADS[case], now - age)
        self.model.datagram(case, age)
        self.compare()

    @rule(ns=STEPS)
    def pass_time(self, ns: int) -> None:
        for each in (self.stage, self.model):
            each.advance(each.now + ns)
        self.compare()

    @rule(ahead=AHEAD)
    def set_clock(self, ahead: int) -> None:
        self.stage.set_clock(ahead)
        self.model.ahead = ahead

    @rule(number=st.integers(0, len(SETTINGS) - 1))
    def reload(self, number: int) -> None:
        self.stage.reload(table(number))
        self.model.reload(table(number))
        self.compare()

    def teardown(self) -> None:
        self.stage.close()
        self.model.close()
        self.compare()

    def compare(self) -> None:
        happened = [event for event in self.stage.events if isinstance(event, (Sent, Dropped, DeadmanChanged))]
        assert _by_kind(happened) == _by_kind(self.model.happened)
        self.stage.events.clear()
        self.model.happened.clear()


def _by_kind(events: Sequence[Event]) -> Mapping[type[Event], list[Event]]:
    """In order, but a deadman may say before or after its datagram what it does."""
    return {kind: [event for event in events if isinstance(event, kind)] for kind in (Sent, Dropped, DeadmanChanged)}


TestAgesRatesAndDeadmen = AgesRatesAndDeadmen.TestCase
TestAgesRatesAndDeadmen.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
