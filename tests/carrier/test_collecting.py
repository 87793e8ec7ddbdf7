"""Frames come out complete, in order and once, whatever way their parts come in; and each part is counted once."""

from __future__ import annotations

import random
from collections.abc import Sequence
from ctypes import CDLL
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.compiler import Checked, check_table
from router.compiler.compiled_table import CompiledTable
from router.rehearsal.cdr import deserialize
from router.types.model import MessageType
from tests.carrier.delivering import Delivering, Outcome, Payload
from tests.oracles.frames import Frames, Part

NS, MS = 1_000_000_000, 1_000_000
NEVER = (1 << 63) - 1
PROTO = """\
syntax = "proto3";
message Part {
  string text = 1; sint64 number = 2; uint64 unsigned = 3; sint64 count = 4; uint64 total = 5; sint64 at = 6;
  uint64 place = 7; bytes data = 8; float x = 9; string name = 10;
}
message Other { int32 value = 1; }
message PBEnvelope {
  oneof payload { Part part = 1; Other other = 2; Part signed = 3; Part texts = 4; }
  int32 extra = 9;
}
"""
TABLE = """\
version: 1
envelope: {protos: ., message: PBEnvelope, oneof: payload}
listen: {here: {address: "127.0.0.1:25000"}}
endpoints: {left: {address: "127.0.0.2:8", kind: tool}, right: {address: "127.0.0.3:8", kind: tool}}
routes:
  part:
    source: [left, right]
    collect: {by: number, count: total, order: place, timeout: 1s}
    topics: &topics
      - {topic: all, type: diagnostic_msgs/msg/DiagnosticArray, fields: {header.frame_id: name, status: items}}
      - {topic: sizes, type: std_msgs/msg/Int64MultiArray, fields: {data: "[count, len(items)]"}}
  signed:
    source: [left, right]
    collect: {by: number, count: count, order: at, timeout: 1s}
    topics: *topics
  texts:
    source: [left, right]
    collect: {by: text, count: total, order: round(x), timeout: 1s}
    topics: *topics
  other: {ignore: nobody wants it}
"""


@cache
def checked() -> Checked:
    with TemporaryDirectory() as folder:
        (Path(folder) / "own.proto").write_text(PROTO)
        (Path(folder) / "t.yaml").write_text(TABLE)
        made = check_table(Path(folder) / "t.yaml", {})
    assert made.program is not None, made.diagnostics
    return made


def program() -> CompiledTable:
    made = checked().program
    assert made is not None
    return made


@cache
def type_of(topic: str) -> MessageType:
    of_topics = {each.label: each.type for each in checked().routes[0].targets}
    found = of_topics[topic]
    assert found is not None
    return found


def envelope(case: str, **fields: Any) -> bytes:
    made: Any = program().envelopes.first.message_class()
    getattr(made, case).SetInParent()
    for name, value in fields.items():
        setattr(getattr(made, case), name, value)
    return bytes(made.SerializeToString())


class Collecting:
    """The collector of a route, for two topics. Offered parts are called as their count and place."""

    def __init__(self, functions: CDLL, case: str = "part") -> None:
        self.case, self.now = case, 0
        self.carrier = Delivering(functions, program().lowered.to_topics[case], 0, "left", ("right",), NS)

    def offer(self, *, column: int = 0, **fields: Any) -> list[str] | None:
        """Offer a part, and return the names of those of the frame that is complete then."""
        return self.names(self.carrier.part(envelope(self.case, **fields), self.now, column))

    def offer_all(self, count: int, *, number: int = 1) -> list[str] | None:
        made = [self.part(number, count, place) for place in range(count)]
        assert not any(made[:-1])
        return made[-1]

    def part(self, number: int, total: int, place: int, column: int = 0) -> list[str] | None:
        return self.offer(number=number, total=total, place=place, name=f"{total}.{place}", column=column)

    def names(self, outcomes: Sequence[Outcome] | None) -> list[str] | None:
        if outcomes is None:
            return None
        got = {outcome.label: deserialize(type_of(outcome.label), bytes(outcome.got)) for outcome in outcomes}  # type: ignore[arg-type]
        names = [status.name for status in got["all"].status]
        assert got["all"].header.frame_id == names[0]
        assert got["sizes"].data == [len(names)] * 2
        return names

    def wait(self, until: int) -> int:
        """Return when it is due next."""
        self.now = until
        return self.carrier.serve(until)

    @property
    def counted(self) -> dict[str, int]:
        first, second = (self.carrier.counted(label) for label in ("all", "sizes"))
        assert first == second
        return first

    def details(self) -> list[str]:
        """Of what was lost since the last call."""
        losses = self.carrier.losses()
        first, second = ([text for label, text in losses if label == topic] for topic in ("all", "sizes"))
        assert first == second
        return first


@pytest.fixture
def frames(delivering: CDLL) -> Collecting:
    return Collecting(delivering)


def names_of(count: int) -> list[str]:
    return [f"{count}.{place}" for place in range(count)]


# ---- complete


def test_a_frame_is_published_in_order_whatever_order_its_parts_have(frames: Collecting) -> None:
    assert [frames.part(7, 3, place) for place in (2, 0, 1)] == [None, None, names_of(3)]
    assert frames.counted == {"collected": 2, "delivered": 1}


def test_copies_are_filtered_before_and_after_the_frame_is_complete(frames: Collecting) -> None:
    made = [frames.part(7, 2, place) for place in (1, 1, 0, 0, 1)]
    frames.wait(NS - 1)
    made.append(frames.part(7, 2, 0))
    assert made == [None, None, names_of(2), None, None, None]
    assert frames.counted == {"filtered": 4, "collected": 1, "delivered": 1}


def test_each_sender_has_frames_of_its_own(frames: Collecting) -> None:
    assert [frames.part(7, 2, place, column) for place, column in ((0, 0), (1, 1), (0, 1))] == [None, None, names_of(2)]


def test_the_name_of_a_frame_may_be_text(delivering: CDLL) -> None:
    frames = Collecting(delivering, "texts")
    longest = "x" * 255
    offered = [(longest, 0), (longest[1:] + "y", 1), ("", 0), (longest, 1), ("", 1)]
    made = [frames.offer(text=text, total=2, x=place, name=str(place)) for text, place in offered]
    assert made == [None, None, None, ["0", "1"], ["0", "1"]]


def test_a_frame_may_have_parts_of_no_bytes(frames: Collecting) -> None:
    """As an envelope that is nothing but the payload, which is empty."""
    assert frames.carrier.part(b"\x0a\x02\x28\x01", payload=Payload(2, 2, True)) is not None


def test_a_payload_that_comes_in_pieces_is_one_part(frames: Collecting) -> None:
    """One of another case in front of it is replaced, and fields beside it are left out."""
    pieces = [envelope("part", number=7, name="old"), b"\x48\x05", envelope("part", total=2, name="2.0")]
    assert frames.names(frames.carrier.part(b"".join(pieces))) is None
    replaced = envelope("part", number=9, text="gone") + envelope("other", value=3)
    pieces = [envelope("part", total=2, place=1), b"\x48\x05", envelope("part", number=7, name="2.1")]
    whole = replaced + b"".join(pieces) + b"\x48\x05"
    payload = Payload(len(replaced), sum(map(len, pieces)), False)
    assert frames.names(frames.carrier.part(whole, payload=payload)) == ["2.0", "2.1"]


def test_what_is_held_stays_as_it_is_while_others_come_and_go(frames: Collecting) -> None:
    """It is moved meanwhile, several times."""
    for number in range(4):
        frames.offer(number=9 - number, total=1, name="x", data=bytes(3000))
        frames.offer(number=number, total=2, name=f"{number}", data=bytes(number * 5))
    for number in range(10, 3010):
        frames.offer(number=number, total=1, name="x", data=b"\xff" * (number % 1000))
    made = [frames.offer(number=number, total=2, place=1, name=f"{number} too") for number in range(4)]
    assert made == [[f"{number}", f"{number} too"] for number in range(4)]


# ---- incomplete


def test_a_frame_whose_time_is_up_counts_once(frames: Collecting) -> None:
    assert frames.wait(5 * MS) == NEVER
    frames.part(7, 4, 0)
    frames.part(7, 4, 3)
    frames.now = 900 * MS
    frames.part(7, 4, 1)
    assert frames.wait(900 * MS) == 5 * MS + NS
    assert frames.counted == {"collected": 2}
    assert frames.wait(5 * MS + NS) == NEVER
    assert frames.counted == {"collected": 2, "incomplete": 1}
    assert frames.details() == ["3 of 4 parts"]


def test_a_part_that_comes_before_anybody_has_looked_is_still_too_late(frames: Collecting) -> None:
    frames.part(7, 2, 0)
    frames.now = NS
    assert frames.part(7, 2, 1) is None
    assert frames.counted == {"incomplete": 1, "filtered": 1}


def test_at_the_end_what_is_open_is_incomplete(frames: Collecting) -> None:
    for number, count, place in ((7, 3, 0), (7, 3, 1), (8, 2, 0)):
        frames.part(number, count, place)
    frames.carrier.end_frames()
    assert frames.counted == {"collected": 1, "incomplete": 2}
    assert frames.details() == ["2 of 3 parts", "1 of 2 parts"]
    assert frames.wait(2 * NS) == NEVER


# ---- hostile numbers


@pytest.mark.parametrize(
    ("count", "place"), [(0, 0), (3, 3), (3, -1), (-1, 0), (-1, -2), (-(1 << 63), (1 << 63) - 1), (3, (1 << 32) + 1)]
)
def test_numbers_that_no_frame_has_are_a_failure_of_the_mapping(delivering: CDLL, count: int, place: int) -> None:
    frames = Collecting(delivering, "signed")
    frames.offer(number=7, count=3, at=0, name="a")
    assert frames.offer(number=7, count=count, at=place) is None
    assert frames.counted == {"mapping_error": 1}
    assert frames.details() == [f"a frame of {count} has no part {place}"]
    frames.offer(number=7, count=3, at=1, name="b")
    assert frames.offer(number=7, count=3, at=2, name="c") == ["a", "b", "c"]


def test_unsigned_numbers_are_no_negative_ones(frames: Collecting) -> None:
    most = (1 << 64) - 1
    frames.offer(number=7, total=most, place=most)
    frames.offer(number=7, total=most, place=most - 1)
    assert frames.counted == {"mapping_error": 1, "incomplete": 1}
    assert frames.details() == [
        f"a frame of {most} has no part {most}",
        f"a frame of {most} parts, more than 8192",
    ]


def test_a_name_that_is_too_long_is_a_failure_of_the_mapping(delivering: CDLL) -> None:
    frames = Collecting(delivering, "texts")
    frames.offer(text="x" * 256, total=2)
    assert frames.details() == ["'by' of 256 bytes, more than 255"]
    assert frames.counted == {"mapping_error": 1}


def test_a_place_that_is_not_finite_is_refused(delivering: CDLL) -> None:
    frames = Collecting(delivering, "texts")
    frames.offer(total=2, x=float("nan"))
    assert frames.counted == {"non_finite": 1}


def test_a_frame_that_would_never_have_room_is_not_opened(frames: Collecting) -> None:
    made = [frames.part(7, count, place) for count, place in ((2, 0), (1 << 32, 1), (8193, 1), (2, 1))]
    assert made == [None, None, None, names_of(2)]
    assert frames.counted == {"incomplete": 2, "collected": 1, "delivered": 1}


def test_the_largest_frame_has_room(frames: Collecting) -> None:
    assert frames.offer_all(8192) == names_of(8192)


def test_the_bytes_that_are_held_are_bounded(frames: Collecting) -> None:
    """Whatever frames are open, the oldest one ends."""
    data = bytes(16_000)
    for place in range(2000):
        frames.offer(number=7, total=8192, place=place, data=data)
        if frames.counted.get("incomplete"):
            break
    assert place == (1 << 24) // len(envelope("part", number=7, total=8192, place=999, data=data)[4:])
    assert frames.details() == [f"{place + 1} of 8192 parts"]
    assert frames.part(8, 1, 0) == ["1.0"]


# ---- against the rules


Arrival = tuple[int, int, int, Part]
"""A pause (ns), a sender, what it calls the frame, and the part."""


@st.composite
def arrivals(draw: st.DrawFn) -> Arrival:
    """Parts of few small frames, so that all of the rules have something to do."""
    count = draw(st.sampled_from([1, 2, 2, 3, 3, 3, 7, 8]))
    column, number, place = draw(st.integers(0, 1)), draw(st.integers(0, 6)), draw(st.integers(-1, count))
    part = Part((column, number), count, place, draw(st.sampled_from([b"", b"x", b"y" * 99])))
    return draw(st.sampled_from([0, 0, 0, 1, 100 * MS, 300 * MS, NS])), column, number, part


def judge(frames: Collecting, oracle: Frames, arrived: Sequence[Arrival]) -> None:
    """Timers are served in time."""
    for pause, column, number, part in arrived:
        until = frames.now + pause
        while oracle.next_due is not None and oracle.next_due <= until:
            due = oracle.next_due
            oracle.tick(due)
            assert frames.wait(due) == (oracle.next_due or NEVER)
        frames.now = until
        expected = oracle.offer(until, part)
        fields: dict[str, Any] = {"count": part.size, "at": part.place, "name": part.payload.decode()}
        made = frames.offer(number=number, column=column, **fields)
        assert made == ([payload.decode() for payload in expected] if expected is not None else None)
        oracle.counted["delivered"] += expected is not None
        assert frames.counted == +oracle.counted
        assert frames.details() == oracle.details
        oracle.details.clear()
    oracle.end(frames.now)
    frames.carrier.end_frames()
    assert frames.counted == +oracle.counted
    assert sum(oracle.counted.values()) == len(arrived)


@settings(suppress_health_check=list(HealthCheck))
@given(arrived=st.lists(arrivals(), max_size=120))
def test_frames_are_as_the_rules_say(delivering: CDLL, arrived: list[Arrival]) -> None:
    judge(Collecting(delivering, "signed"), Frames(NS), arrived)


@pytest.mark.parametrize("most", [2, 200, 8192, 1 << 32])
def test_floods_of_many_frames_are_as_the_rules_say(delivering: CDLL, most: int) -> None:
    """Limits of frames and of names that are remembered are reached."""
    noise = random.Random(most)
    arrived = []
    for _ in range(6000):
        count, column, number = noise.randint(1, most), noise.randrange(2), noise.randrange(3000)
        part = Part((column, number), count, noise.randrange(count), b"x" * noise.randrange(2))
        arrived.append((noise.choice([0, MS // 10]), column, number, part))
    judge(Collecting(delivering, "signed"), Frames(NS), arrived)


def test_floods_of_large_frames_are_as_the_rules_say(delivering: CDLL) -> None:
    """The limit of parts is reached, between frames that get complete."""
    noise = random.Random(1)
    arrived = []
    for step in range(12_000):
        number = step // 500 + noise.randrange(24)
        count = 2000 if number % 4 else 60
        part = Part((0, number), count, noise.randrange(count), f"{step}".encode())
        arrived.append((MS // 100, 0, number, part))
    judge(Collecting(delivering, "signed"), Frames(NS), arrived)


def test_large_payloads_are_as_the_rules_say(delivering: CDLL) -> None:
    """The limit of bytes is reached, and what is held is moved many times."""
    noise = random.Random(1)
    frames, oracle = Collecting(delivering, "signed"), Frames(NS)
    for step in range(8000):
        number = step // 100 + noise.randrange(30)
        count = 150 if number % 3 else 20
        place, name, data = noise.randrange(count), f"{step}", bytes(noise.randrange(16_000))
        datagram = envelope("signed", number=number, count=count, at=place, name=name, data=data)
        size = len(datagram) - (2 if len(datagram) < 130 else 3 if len(datagram) < 16_387 else 4)
        frames.now = step * MS // 10
        expected = oracle.offer(frames.now, Part(number, count, place, name.encode() + bytes(size - len(name))))
        made = frames.names(frames.carrier.part(datagram, frames.now))
        assert made == ([each.rstrip(b"\0").decode() for each in expected] if expected is not None else None)
        oracle.counted["delivered"] += expected is not None
    assert frames.counted == +oracle.counted
    assert frames.details() == oracle.details
    assert min(frames.counted[name] for name in ("delivered", "incomplete", "filtered")) > 3
