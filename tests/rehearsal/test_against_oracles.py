"""Whatever comes, whenever, and whatever is done to clock and table: the simulation does what plain models say."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from struct import pack
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from router.compiler import Checked, check_table
from router.compiler.compiled_table import DeadmanPlan
from router.compiler.lookup import Definitions
from router.rehearsal.cdr import deserialize
from router.rehearsal.rehearsal import (
    START,
    Collected,
    DeadmanChanged,
    Dropped,
    Event,
    Filtered,
    Published,
    Received,
    Rehearsal,
    Sent,
)
from tests.oracles.frames import Part
from tests.oracles.table import BULK, COMMAND, TELEMETRY, Happened, Model, Table, Target

MS = 1_000_000
TTL, ORDERS_TTL = 150, 200

PROTO = """\
syntax = "proto3";
message Sample { int32 number = 1; bytes filling = 2; }
message Part { int32 frame = 1; int32 count = 2; int32 place = 3; string name = 4; }
message PBEnvelope {
  oneof payload {
    Sample telemetry = 1; Sample bulk = 2; Sample drive = 3; Sample arm = 4; Sample orders = 5; Sample brake = 6;
    Part part = 7;
  }
}
"""
TABLE = """\
version: 1
envelope: {{protos: ., message: PBEnvelope, oneof: payload}}
listen: {{here: {{address: "127.0.0.1:5000"}}}}
endpoints:
{spare}  sensors: {{address: "192.168.0.30:8", kind: tool}}
  wheels: {{address: "192.168.0.31:8", kind: board{wire}}}
  operator: {{address: "192.168.0.10:9000", kind: basestation{radio}}}
routes:
  telemetry:
    source: {sources}
    destinations: [{{endpoint: operator{telemetry}}}]
    topics: [{{topic: latest, type: std_msgs/msg/Int32, fields: {{data: number}}{topic}}}]
    {options}
  bulk: {{source: sensors, priority: bulk, destinations: [{{endpoint: operator{bulk}}}]}}
  drive:
    source: operator
    ttl: {ttl}ms
    destinations: [{{endpoint: wheels{drive}}}]
    deadman: {{timeout: {timeout}ms, repeat: {repeat}ms, send: {{brake: {{number: 1}}}}, disarmed_by: [arm],
               to: [wheels], because: this is a test}}
  arm:
    {{source: operator, ttl: {ttl}ms, destinations: [{{endpoint: wheels{arm}}}], deadman: {{none: not in this test}}}}
  part:
    source: operator
    collect: {{by: frame, count: count, order: place, timeout: {collect}ms}}
    topics: [{{topic: frames, type: diagnostic_msgs/msg/DiagnosticArray, fields: {{status: items}}{frames}}}]
  orders:
    source: {{topic: orders, type: std_msgs/msg/Int32}}
    fields: {{number: data}}
    ttl: {ttl}ms
    destinations: [{{endpoint: wheels{orders}}}]
    deadman: {{none: not in this test}}
"""
MOST_TO_BOARD = 1400
BRAKE = b"\x32\x02\x08\x01"
SPARE = '  spare: {address: "192.168.0.29:8", kind: tool}\n'
"""An endpoint before the others, which then have other numbers."""
PEERS = {
    "spare": ("192.168.0.29", 8),
    "sensors": ("192.168.0.30", 8),
    "wheels": ("192.168.0.31", 8),
    "operator": ("192.168.0.10", 9000),
}
STRANGER = ("192.168.0.99", 9000)


@dataclass(frozen=True)
class To:
    """How a target is delivered to."""

    hertz: int | None = None
    is_latest: bool = False
    only_positive: bool = False

    def __str__(self) -> str:
        rate = "" if self.hertz is None else f", max_rate: {self.hertz} Hz"
        condition = ", when: number > 0" if self.only_positive else ""
        return rate + (", on_limit: latest" if self.is_latest else "") + condition


RATES = [To(), To(20), To(7, is_latest=True), To(20, is_latest=True), To(50, is_latest=True)]
CONDITIONS = [To(only_positive=True), To(20, is_latest=True, only_positive=True)]
SOURCES: Mapping[str, tuple[str | None, ...]] = {
    "sensors": ("sensors",),
    "wheels": ("wheels",),
    "[wheels, sensors]": ("sensors", "wheels"),
    "any": ("spare", "sensors", "wheels", "operator", None),
}
CHOICES: Mapping[str, list[Any]] = {
    "sources": [*SOURCES],
    "spare": ["", SPARE],
    "telemetry": [*RATES, *CONDITIONS],
    "bulk": [To(), To(), *RATES],
    "topic": [*RATES, *CONDITIONS],
    "drive": RATES,
    "arm": [To(), To(), *RATES],
    "orders": RATES,
    "frames": RATES,
    "ttl": [None, None, TTL],
    "rank": [COMMAND, TELEMETRY, TELEMETRY, BULK],
    "radio": [None, 2_000, 20_000, 200_000],
    "wire": [None, None, 2_000, 20_000],
    "deadman": [(500, 100), (300, 70), (900, 400)],
    "collect": [400, 1000],
}


@dataclass(frozen=True)
class Setting:
    """What may differ between two tables; bandwidths in bytes per second, times in ms."""

    sources: str
    spare: str
    telemetry: To
    bulk: To
    topic: To
    drive: To
    arm: To
    orders: To
    frames: To
    ttl: int | None
    rank: int
    radio: int | None
    wire: int | None
    deadman: tuple[int, int]
    collect: int

    def text(self) -> str:
        names = ("command", "telemetry", "bulk")
        options = [f"priority: {names[self.rank]}", *([] if self.ttl is None else [f"ttl: {self.ttl}ms"])]
        return TABLE.format(
            **{name: value for name, value in vars(self).items() if isinstance(value, To)},
            sources=self.sources,
            spare=self.spare,
            ttl=ORDERS_TTL,
            options="\n    ".join(options),
            radio="" if self.radio is None else f", bandwidth: {self.radio}B/s",
            wire="" if self.wire is None else f", bandwidth: {self.wire}B/s",
            timeout=self.deadman[0],
            repeat=self.deadman[1],
            collect=self.collect,
        )

    def model(self) -> Table:
        def target(route: str, label: str, to: To, **more: Any) -> Target:
            return Target(route, label, hertz=to.hertz, is_latest=to.is_latest, only_positive=to.only_positive, **more)

        timeout, repeat = self.deadman
        command: Any = {"is_board": True, "rank": COMMAND}
        bandwidths = {"operator": self.radio, "wheels": self.wire}
        ttl = {"drive": ORDERS_TTL, "arm": ORDERS_TTL, "orders": ORDERS_TTL, "telemetry": self.ttl}
        return Table(
            targets=(
                target("telemetry", "operator", self.telemetry, rank=self.rank),
                target("telemetry", "latest", self.topic, is_topic=True),
                target("bulk", "operator", self.bulk, rank=BULK),
                target("drive", "wheels", self.drive, feeds=("drive",), **command),
                target("arm", "wheels", self.arm, feeds=("drive",), **command),
                target("part", "frames", self.frames, is_topic=True),
                target("orders", "wheels", self.orders, **command),
            ),
            sources={
                "telemetry": tuple(each for each in SOURCES[self.sources] if each != "spare" or self.spare),
                "bulk": ("sensors",),
                **dict.fromkeys(("drive", "arm", "part"), ("operator",)),
                "orders": (None,),
            },
            ttl={route: ms * MS for route, ms in ttl.items() if ms is not None},
            bandwidths={name: bandwidth for name, bandwidth in bandwidths.items() if bandwidth is not None},
            timeouts={"part": self.collect * MS},
            deadmen={"drive": DeadmanPlan("drive", timeout * MS, repeat * MS, (("wheels", (BRAKE,)),))},
        )


def _settings() -> Iterator[Setting]:
    """Some, each followed by others that differ from it in one thing."""
    noise = random.Random(33)
    for _ in range(6):
        made = Setting(**{name: noise.choice(choices) for name, choices in CHOICES.items()})
        yield made
        for name in noise.sample([*CHOICES], 6):
            yield replace(made, **{name: noise.choice(CHOICES[name])})


SETTINGS = list(_settings())
NUMBERS = st.integers(0, len(SETTINGS) - 1)
AGES = st.one_of(st.just(0), st.integers(0, 400 * MS), st.sampled_from([(TTL + d) * MS for d in (-1, 0, 1)]))
STEPS = st.one_of(st.integers(0, 30 * MS), st.integers(0, 1200 * MS), st.sampled_from((20 * MS, 50 * MS, 300 * MS)))
AHEAD = st.one_of(st.integers(-600 * MS, 600 * MS), st.sampled_from((0, 3 * MS, 3600 * 1000 * MS)))
CASES = ("telemetry", "bulk", "drive", "telemetry", "drive", "arm")
TIMES, COUNTS = (1, 1, 2, 5, 20), (1, 2, 2, 3, 3, 3)
SIZES = st.one_of(st.integers(0, 40), st.integers(0, 1500), st.sampled_from((0, 15_000)))


@cache
def folder() -> TemporaryDirectory[str]:
    """Of all tables: they have the same types, as before and after a reload."""
    made = TemporaryDirectory()
    (Path(made.name) / "own.proto").write_text(PROTO)
    (Path(made.name) / "own.options").write_text(f"Sample.filling max_size:{MOST_TO_BOARD}\n")
    return made


@cache
def checked(setting: Setting) -> Checked:
    path = Path(folder().name) / "table.yaml"
    path.write_text(setting.text())
    made = check_table(path, {}, DEFINITIONS)
    assert made.program is not None, "\n".join(map(str, made.diagnostics))
    return made


DEFINITIONS = Definitions()


def envelope(case: str, **payload: object) -> bytes:
    envelopes = checked(SETTINGS[0]).envelopes
    assert envelopes is not None
    data: bytes = envelopes.first.message_class(**{case: payload}).SerializeToString()
    return data


class Both:
    """A simulation and its model, which are given the same."""

    def __init__(self, setting: Setting) -> None:
        self.setting, self.program = setting, checked(setting).program
        assert self.program is not None
        self.simulation, self.model = Rehearsal(self.program), Model(setting.model(), START)
        self._count = 0

    def _next_number(self, sign: int = 1) -> int:
        """One that no other message has."""
        self._count += 1
        return sign * self._count

    def _wall(self, age: int) -> int:
        return self.simulation.now + self.simulation.ahead - age

    def receive(self, case: str, sender: int, age: int, sign: int, size: int, times: int) -> None:
        """`sender` chooses one of those that may send it."""
        sources = self.model.table.sources[case]
        source = sources[sender % len(sources)]
        if case in {"drive", "arm"}:
            size = min(size, MOST_TO_BOARD)
        for _ in range(times):
            number = self._next_number(sign)
            data = envelope(case, number=number, filling=bytes(size))
            self.simulation.datagram("here", PEERS[source] if source else STRANGER, data, self._wall(age))
            self.model.datagram(
                case, source, data, number, self._wall(age), {"latest": b"\0\1\0\0" + pack("<i", number)}
            )
        self.compare()

    def receive_parts(self, frame: int, count: int, places: Sequence[int], age: int) -> None:
        for place in places:
            name = f"{self._next_number()}"
            data = envelope("part", frame=frame, count=count, place=place, name=name)
            self.simulation.datagram("here", PEERS["operator"], data, self._wall(age))
            self.model.part("part", Part(frame, count, place, name.encode()), self._wall(age))
        self.compare()

    def take_from_ros(self, age: int, times: int) -> None:
        for _ in range(times):
            number = self._next_number()
            self.simulation.ros("orders", b"\0\1\0\0" + pack("<i", number), self._wall(age))
            self.model.ros("orders", envelope("orders", number=number), number, self._wall(age))
        self.compare()

    def pass_time(self, ns: int) -> None:
        for each in (self.simulation, self.model):
            each.advance(each.now + ns)
        self.compare()

    def set_clock(self, ahead: int) -> None:
        self.simulation.set_clock(ahead)
        self.model.ahead = ahead

    def reload(self, number: int) -> None:
        self._adopt(SETTINGS[number])

    def change(self, name: str, choice: int) -> None:
        """A reload that changes one thing."""
        choices = CHOICES[name]
        self._adopt(replace(self.setting, **{name: choices[choice % len(choices)]}))

    def _adopt(self, setting: Setting) -> None:
        assert self.program is not None
        self.setting, self.program = setting, checked(setting).program_in(self.program.counters.continued())
        assert self.program is not None
        self.simulation.reload(self.program)
        self.model.reload(setting.model())
        self.compare()

    def restart(self) -> None:
        self.simulation.restart()
        self.model = Model(self.setting.model(), START)

    def close(self) -> None:
        self.simulation.close()
        self.model.close()
        self.compare()

    def compare(self) -> None:
        """By target, in order; what a deadman does it may report before or after its datagram."""
        happened = [event for event in self.simulation.events if not isinstance(event, (Received, DeadmanChanged))]
        changes = [
            (each.at, each.route, each.active) for each in self.simulation.events if isinstance(each, DeadmanChanged)
        ]
        assert _by_target(map(_happened, happened)) == _by_target(self.model.happened)
        assert changes == self.model.changes
        for events in (self.simulation.events, self.model.happened, self.model.changes):
            events.clear()


class Tables(RuleBasedStateMachine):
    @initialize(number=NUMBERS)
    def start(self, number: int) -> None:
        self.both = Both(SETTINGS[number])

    @rule(
        case=st.sampled_from(CASES),
        sender=st.integers(0, 3),
        age=AGES,
        sign=st.sampled_from((1, -1)),
        size=SIZES,
        times=st.sampled_from(TIMES),
    )
    def receive(self, case: str, sender: int, age: int, sign: int, size: int, times: int) -> None:
        self.both.receive(case, sender, age, sign, size, times)

    @rule(frame=st.integers(1, 5), count=st.sampled_from(COUNTS), places=st.lists(st.integers(-1, 2)), age=AGES)
    def receive_parts(self, frame: int, count: int, places: list[int], age: int) -> None:
        self.both.receive_parts(frame, count, places, age)

    @rule(age=AGES, times=st.integers(1, 3))
    def take_from_ros(self, age: int, times: int) -> None:
        self.both.take_from_ros(age, times)

    @rule(ns=STEPS)
    def pass_time(self, ns: int) -> None:
        self.both.pass_time(ns)

    @rule(ahead=AHEAD)
    def set_clock(self, ahead: int) -> None:
        self.both.set_clock(ahead)

    @rule(number=NUMBERS)
    def reload(self, number: int) -> None:
        self.both.reload(number)

    @rule(name=st.sampled_from(sorted(CHOICES)), choice=st.integers(0, 6))
    def change(self, name: str, choice: int) -> None:
        self.both.change(name, choice)

    @rule()
    def restart(self) -> None:
        self.both.restart()

    def teardown(self) -> None:
        self.both.close()


TestTables = Tables.TestCase
TestTables.settings = settings(max_examples=25, stateful_step_count=40, deadline=None)


def step_of(both: Both, noise: random.Random) -> None:
    """One as a busy rover has them; Hypothesis has few of those that a limit takes."""
    age = noise.choice((0, 0, noise.randrange(400 * MS), (TTL + noise.choice((-1, 0, 1))) * MS))
    match noise.choices(range(7), (35, 15, 10, 30, 1, 3, 5))[0]:
        case 0:
            size = noise.choice((noise.randrange(41), noise.randrange(1500), 0, 15_000))
            both.receive(
                noise.choice(CASES), noise.randrange(4), age, noise.choice((1, 1, -1)), size, noise.choice(TIMES)
            )
        case 1:
            places = noise.choice(([-1], [0, 1, 2], [noise.randrange(3)], [noise.randrange(3) for _ in range(4)]))
            both.receive_parts(noise.randint(1, 5), noise.choice(COUNTS), places, age)
        case 2:
            both.take_from_ros(age, noise.choice((1, 1, 3)))
        case 3:
            both.pass_time(noise.choice((noise.randrange(30 * MS), noise.randrange(1200 * MS), 20 * MS, 50 * MS)))
        case 4:
            both.set_clock(noise.choice((noise.randrange(-600 * MS, 600 * MS), 0, 3 * MS, 3600 * 1000 * MS)))
        case 5:
            both.reload(noise.randrange(len(SETTINGS)))
        case 6:
            both.change(noise.choice(sorted(CHOICES)), noise.randrange(7))


@pytest.mark.parametrize("count", [40, pytest.param(750, marks=pytest.mark.slow)])
def test_long_histories_are_as_the_models_say(count: int) -> None:
    """With one simulation: what one leaves behind does not reach the next."""
    both = Both(SETTINGS[0])
    for seed in range(count):
        noise = random.Random(seed)
        both.restart()
        both.reload(noise.randrange(len(SETTINGS)))
        for _ in range(70):
            step_of(both, noise)
        both.close()


def _by_target(events: Iterable[Happened]) -> dict[tuple[str, str], list[Happened]]:
    found: dict[tuple[str, str], list[Happened]] = {}
    for each in events:
        found.setdefault((each.route, each.target), []).append(each)
    return found


def _happened(event: Event) -> Happened:
    match event:
        case Sent():
            return Happened(event.at, event.route, event.target, "braked" if event.by_deadman else "sent", event.data)
        case Published():
            return Happened(event.at, event.route, event.target, "published", _content(event))
        case Dropped():
            return Happened(event.at, event.route, event.target, event.reason)
        case Filtered():
            return Happened(event.at, event.route, event.target, "filtered")
        case Collected():
            return Happened(event.at, event.route, event.target, "collected")
    raise AssertionError(event)


def _content(event: Published) -> bytes:
    """Of a frame the names of its parts."""
    if event.target != "frames":
        return event.data
    (target,) = [each for route in checked(SETTINGS[0]).routes for each in route.targets if each.label == "frames"]
    assert target.type is not None
    return b"|".join(each.name.encode() for each in deserialize(target.type, event.data).status)
