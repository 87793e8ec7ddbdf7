"""What a board cannot take, or must not get, is not sent to it and feeds no deadman; one with nanopb says the same."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain
from time import sleep
from typing import Any, NamedTuple

import pytest
from google.protobuf.unknown_fields import UnknownFieldSet
from hypothesis import settings

from router.datagrams import wire_of_protos
from router.types.wire import delimited, varint
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import ROUTER
from tests.acceptance.site import RouterProcess, Site, key, site, total, wait_until
from tests.boards.board import PARTS, Board, Verdict, compiled
from tests.boards.mutating import Mutator
from tests.ports import free_port

WIRE = wire_of_protos(PARTS)
LARGEST = WIRE.envelopes.first.max_size
"""Bytes of the largest envelope that the board takes."""

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/boards/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
{endpoints}"""

MORE = """\
version: 1
extends: table.yaml
endpoints:
  lenient_board: {allow_non_finite: true}
defaults: {deadman: {timeout: 500ms, repeat: 50ms}}
routes:
  drive:
    - source: basestation
      destinations: &all [board, lenient_board, tool]
      ttl: 500ms
      deadman: &brake {send: {brake: {brake: true}}, to: board, disarmed_by: brake,
                       at_start: silent}
    - source: {topic: drive, type: geometry_msgs/msg/Twist}
      destinations: *all
      ttl: 500ms
      deadman: *brake
  turn:
    - {source: basestation, destinations: *all, deadman: &none {none: for tests}}
  numbers:
    - {source: basestation, destinations: *all, deadman: *none}
    - {source: {topic: singles, type: std_msgs/msg/Float32MultiArray}, fields: {singles: data}, destinations: *all,
       deadman: *none}
    - {source: {topic: reals, type: std_msgs/msg/Float64MultiArray}, fields: {reals: data}, destinations: *all,
       deadman: *none}
    - {source: {topic: single, type: std_msgs/msg/Float64}, fields: {single: float32(data)}, destinations: *all,
       deadman: *none}
    - {source: {topic: gains, type: std_msgs/msg/Float32MultiArray}, fields: {wheel.gains: data}, destinations: *all,
       deadman: *none}
  label:
    - {source: basestation, destinations: *all, deadman: *none}
    - {source: {topic: text, type: std_msgs/msg/String}, fields: {text: data}, destinations: *all, deadman: *none}
    - {source: {topic: names, type: std_msgs/msg/String}, fields: {names: "[data]"}, destinations: *all,
       deadman: *none}
    - {source: {topic: counts, type: std_msgs/msg/Int32MultiArray}, fields: {counts: data}, destinations: *all,
       deadman: *none}
    - {source: {topic: blob, type: std_msgs/msg/UInt8MultiArray}, fields: {blob: data}, destinations: *all,
       deadman: *none}
  brake: {source: basestation, destinations: board, deadman: *none}
"""
SOCKETS = {
    "basestation": "127.0.0.10",
    "lenient_board": "127.0.0.40",
    "tool": "127.0.0.60",
}
RANDOM = settings().max_examples
AT_ONCE = 50
"""Datagrams that may be on their way, so that nothing is lost."""

BOARDS = ("board", "lenient_board")
BESIDE = ("lenient_board", "tool")
"""What gets the same, but has no nanopb."""

TOPICS = {
    "drive": "geometry_msgs/msg/Twist",
    "singles": "std_msgs/msg/Float32MultiArray",
    "reals": "std_msgs/msg/Float64MultiArray",
    "single": "std_msgs/msg/Float64",
    "gains": "std_msgs/msg/Float32MultiArray",
    "text": "std_msgs/msg/String",
    "names": "std_msgs/msg/String",
    "counts": "std_msgs/msg/Int32MultiArray",
    "blob": "std_msgs/msg/UInt8MultiArray",
}


def envelope(case: str, payload: bytes = b"", **values: Any) -> bytes:
    """An envelope with a payload of these values, and of these bytes after them."""
    found = WIRE.envelopes.first.cases[case]
    return delimited(found.number, found.message_class(**values).SerializeToString() + payload)


def floats(number: int, *values: float) -> bytes:
    """A list of floats that is not packed."""
    return b"".join(varint(number << 3 | 5) + struct.pack("<f", value) for value in values)


def doubles(number: int, *values: float) -> bytes:
    """A packed list of doubles."""
    return delimited(number, struct.pack(f"<{len(values)}d", *values))


def ints(number: int, *values: int) -> bytes:
    """A list of integers that is not packed."""
    return b"".join(varint(number << 3) + varint(value) for value in values)


def with_number(value: float) -> Mapping[str, bytes]:
    """Envelopes that have a number in one place each, by the name of that place."""
    wheel = {"speed": 1.0, "gains": [1.0, 2.0]}
    return {
        "turn.angular.z": envelope("turn", angular={"z": value}),
        "numbers.single": envelope("numbers", single=value),
        "numbers.real": envelope("numbers", real=value),
        "numbers.maybe": envelope("numbers", maybe=value),
        "numbers.singles": envelope("numbers", singles=[0.0, 1.0, value]),
        "numbers.singles, not packed": envelope("numbers", floats(4, 1.0, value)),
        "numbers.reals": envelope("numbers", reals=[1.0, value]),
        "numbers.reals, packed": envelope("numbers", doubles(5, value, 1.0)),
        "numbers.wheel.speed": envelope("numbers", wheel={"speed": value}),
        "numbers.wheel.gains": envelope("numbers", wheel={"gains": [value, 1.0]}),
        "numbers.wheels.speed": envelope("numbers", wheels=[wheel, {"speed": value}]),
        "numbers.wheels.gains": envelope("numbers", wheels=[{"gains": [1.0, value]}, wheel]),
        "numbers.speed": envelope("numbers", speed=value),
        "numbers.spare.speed": envelope("numbers", spare={"speed": value}),
        "numbers.by_number": envelope("numbers", by_number={1: value}),
    }


NOT_FINITE = (math.nan, -math.nan, math.inf, -math.inf)
AT_THE_ENDS = (3.4028234663852886e38, -3.4028234663852886e38, 1.401298464324817e-45, -0.0)

TEXT = delimited(1, b"ok")
ENTRY = delimited(10, ints(1, 1))
SPEED = floats(8, 1.0)
TOO_LARGE = {
    "text": envelope("label", text="12345678"),
    "text of more bytes than characters": envelope("label", text="\u00e4" * 4),
    "bytes": envelope("label", blob=b"12345"),
    "element of a list of texts": envelope("label", names=["", "123456"]),
    "list of texts": envelope("label", names=["", "", ""]),
    "packed list": envelope("label", counts=[0, 0, 0, 0]),
    "list that should be packed": envelope("label", ints(5, 0, 0, 0, 0)),
    "list in pieces": envelope("label", ints(5, 1, 2), counts=[0, 0]),
    "list that is not packed": envelope("label", offsets=[1, 2, 3]),
    "packed list that should not be": envelope("label", delimited(6, bytes(3))),
    "list of enums": envelope("label", modes=[0] * 41),
    "list of floats": envelope("numbers", singles=[0.0] * 4),
    "packed list of doubles": envelope("numbers", doubles(5, 1.0, 2.0, 3.0)),
    "list of messages": envelope("numbers", wheels=[{}, {}, {}]),
    "map": envelope("numbers", by_number={1: 0.0, 2: 0.0, 3: 0.0}),
    "text in a message": envelope("numbers", wheel={"name": "12345678"}),
    "list in a message": envelope("numbers", wheel={"gains": [0.0] * 3}),
    "list in a list of messages": envelope("numbers", wheels=[{}, {"gains": [0.0] * 3}]),
    "list in a choice": envelope("numbers", spare={"gains": [0.0] * 3}),
    "message in pieces": envelope("numbers", delimited(6, floats(2, 1.0)), wheel={"gains": [1.0, 2.0]}),
    "payload in pieces": envelope("label", counts=[0, 0]) + envelope("label", counts=[0, 0]),
    "text that another one replaces": envelope("label", TEXT, text="12345678"),
    "entries of a map that replace each other": envelope("numbers", ENTRY * 2, by_number={1: 0.0}),
    "choice that is left": envelope("numbers", SPEED, spare={"gains": [0.0] * 3}),
    "payload before another one": envelope("label", text="12345678") + envelope("turn"),
    "unknown field in the payload": envelope("turn", delimited(999, bytes(400))),
    "unknown field beside the payload": envelope("turn") + delimited(999, bytes(400)),
    "unknown field of 16 KiB": envelope("turn", delimited(999, bytes(16000))),
    "one byte more": envelope("turn", delimited(999, bytes(LARGEST - 6))),
}
"""What a board has no room for."""

AS_LARGE_AS_CAN_BE = {
    "label": envelope(
        "label", text="1234567", blob=b"1234", key=b"1234", names=["12345", "12345"], counts=[-1, 2, 3],
        offsets=[-1, -(2**31)], modes=[0] * 40, pair=[1, 2], mode=1,
    ),
    "numbers": envelope(
        "numbers", wheel={"gains": [1.0, 2.0], "name": "1234567"}, wheels=[{"gains": [1.0, 2.0]}] * 2,
        singles=[1.0, 2.0, 3.0], reals=[1.0, 2.0], spare={"gains": [0.0, 1.0], "name": "1234567"},
        by_number={1: 1.0, 2**32 - 1: 2.0},
    ),
    "not packed": envelope("label", ints(5, 1, 2, 3)),
    "packed": envelope("label", delimited(6, bytes(2))),
    "an unknown field fills it": envelope("turn", delimited(999, bytes(LARGEST - 7))),
}  # fmt: skip

BRAKE = envelope("brake", brake=True)
DRIVES = {
    "good": envelope("drive", linear={"x": 1.0}),
    "not finite": envelope("drive", linear={"x": math.nan}),
    "too large": envelope("drive", delimited(999, bytes(LARGEST - 6))),
}


class Yard(NamedTuple):
    """A router, everything that it sends to, and ROS."""

    place: Site
    board: Board
    router: RouterProcess
    talker: RosPeer

    def send(self, *datagrams: bytes) -> None:
        self.place.send("basestation", *datagrams)

    def refused_by_the_board(self) -> list[str]:
        """What it made of all that has been sent to it so far, without what it obeyed."""
        self.send(BRAKE)
        refused = []
        while (verdict := self.board.receive()).envelope != BRAKE:
            refused += [verdict.refused] if verdict.refused else [f"obeyed {verdict.envelope.hex()}"]
        return refused


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Yard]:
    folder = tmp_path_factory.mktemp("yard")
    program = compiled(folder, PARTS, "parts.proto", "PBEnvelope")
    address = "127.0.0.222", free_port("127.0.0.222")
    with ExitStack() as stack:
        place = stack.enter_context(site(folder, SOCKETS))
        board = stack.enter_context(Board(program, address, (ROUTER, place.listen)))
        place.table(TABLE + f"  board: {{{{address: {address[0]}:{address[1]}, kind: board}}}}\n")
        more = folder / "more.yaml"
        more.write_text(MORE)
        router = stack.enter_context(RouterProcess(folder, more))
        talker = stack.enter_context(RosPeer())
        talker.open_heard(TOPICS)
        yield Yard(place, board, router, talker)


def await_drops(yard: Yard, before: Counter[str], reason: str, targets: Iterable[str], times: int = 1) -> None:
    """Each target, and no other one, has dropped so many messages since `before`, all for this reason."""
    expected = dict.fromkeys(targets, times)

    def dropped() -> bool:
        counts = yard.place.changes(before)
        return expected == {
            target: total(counts, "messages_dropped", target=target, reason=reason)
            for target in ("board", *SOCKETS)
            if total(counts, "messages_dropped", target=target)
        }

    wait_until(dropped, "the last drop")


@pytest.mark.parametrize("value", NOT_FINITE, ids=str)
def test_a_number_that_is_not_finite_is_not_forwarded_to_boards(yard: Yard, value: float) -> None:
    before = yard.place.scrape()
    sent = list(with_number(value).values())
    yard.send(*sent)
    await_drops(yard, before, "non_finite", ("board",), len(sent))
    assert yard.place.waiting() == {"lenient_board": sent, "tool": sent}
    assert yard.refused_by_the_board() == []


def test_every_finite_number_is_forwarded(yard: Yard) -> None:
    for value in AT_THE_ENDS:
        for place, datagram in with_number(value).items():
            yard.send(datagram)
            assert not yard.board.receive().refused, place
            assert [yard.place.receive(name) for name in BESIDE] == [datagram] * 2


@pytest.mark.parametrize("what", TOO_LARGE)
def test_what_a_board_has_no_room_for_is_not_forwarded_to_boards(yard: Yard, what: str) -> None:
    before = yard.place.scrape()
    datagram = TOO_LARGE[what]
    yard.send(datagram)
    await_drops(yard, before, "too_large", BOARDS)
    assert yard.place.waiting() == {"tool": [datagram]}
    assert yard.refused_by_the_board() == []


@pytest.mark.parametrize("what", AS_LARGE_AS_CAN_BE)
def test_what_a_board_has_just_room_for_is_forwarded(yard: Yard, what: str) -> None:
    datagram = AS_LARGE_AS_CAN_BE[what]
    yard.send(datagram)
    assert not yard.board.receive().refused
    assert [yard.place.receive(name) for name in BESIDE] == [datagram] * 2


def test_padding_takes_no_room(yard: Yard) -> None:
    datagram = envelope("turn", linear={"x": 1.0})
    yard.send(datagram.ljust(16 * 1024, b"\0"))
    assert yard.board.receive().envelope == datagram
    assert [yard.place.receive(name) for name in BESIDE] == [datagram] * 2


NO_FIELD_HOLDS: Sequence[tuple[str, Mapping[str, Any]]] = (
    ("single", {"data": 3.4e38 * 10}),
    ("single", {"data": -3.4028235678e38}),
    ("text", {"data": "12345678"}),
    ("names", {"data": "123456"}),
    ("blob", {"data": [1, 2, 3, 4, 5]}),
    ("counts", {"data": [1, 2, 3, 4]}),
    ("singles", {"data": [1.0, 2.0, 3.0, 4.0]}),
    ("reals", {"data": [1.0, 2.0, 3.0]}),
    ("gains", {"data": [1.0, 2.0, 3.0]}),
)
"""Messages that cannot be mapped, by topic: a double beyond every float, and what `.options` have no room for."""


@pytest.mark.parametrize(("topic", "message"), NO_FIELD_HOLDS, ids=str)
def test_what_no_field_holds_is_not_sent_from_ros(yard: Yard, topic: str, message: Mapping[str, Any]) -> None:
    before = yard.place.scrape()
    yard.talker.say(topic, message)
    await_drops(yard, before, "mapping_error", (*BOARDS, "tool"))
    assert yard.place.waiting() == {}
    assert yard.refused_by_the_board() == []


@pytest.mark.parametrize(
    ("source", "bad"), [("basestation", "not finite"), ("basestation", "too large"), ("ros", "not finite")]
)
def test_what_is_not_sent_to_a_board_feeds_no_deadman(yard: Yard, source: str, bad: str) -> None:
    yard.board.waiting()
    active = key("deadman_active", route=f"drive_from_{source}")

    def give(what: str) -> None:
        if source == "basestation":
            yard.send(DRIVES[what])
        else:
            yard.talker.say("drive", {"linear": {"x": 1.0 if what == "good" else math.nan}})
        sleep(0.02)

    def braked() -> bool:
        give(bad)
        return BRAKE in {verdict.envelope for verdict in yard.board.waiting()}

    for _ in range(10):
        give("good")
    assert {verdict.case for verdict in yard.board.waiting()} == {WIRE.case("drive").number}
    wait_until(braked, "the brake")
    for _ in range(50):
        give(bad)
    assert {verdict.envelope for verdict in yard.board.waiting()} == {BRAKE}
    assert yard.place.samples()[active] == 1
    yard.send(BRAKE)
    wait_until(lambda: yard.place.samples()[active] == 0, "the end of it")
    yard.board.waiting()
    yard.place.waiting()


def test_the_board_has_refused_nothing(yard: Yard) -> None:
    """Of all that the tests above have sent."""
    assert yard.refused_by_the_board() == []
    counts = yard.place.scrape()
    sent = total(counts, "datagrams_sent", destination="board")
    assert sent + total(counts, "deadman_datagrams_sent", destination="board") == yard.board.obeyed


def test_the_log_names_the_field_and_its_bound(yard: Yard) -> None:
    lines = [line for line in yard.router.events("message dropped") if line["reason"] == "too_large"]
    assert {line["target"] for line in lines} == {*BOARDS}
    for line in lines:
        assert re.fullmatch(r"(the envelope|[a-z_.]+) has \d+ (byte|element)s?; the board takes \d+", line["detail"])


NOT_CHECKED = {"wrong wire type", "invalid wire_type", "integer too large", "varint overflow"}
"""nanopb's words for fields of another wire type, groups, and varints of more bits than the field."""


def is_expected(verdict: Verdict) -> bool:
    """Whether the board obeys, or refuses what the router does not check."""
    if verdict.refused == "array overflow":  # it looks at the wire type of one element too many later
        return has_other_wire_types(WIRE.envelopes.first.message_class.FromString(verdict.datagram))
    return verdict.refused in {"", *NOT_CHECKED}


def has_other_wire_types(message: Any) -> bool:
    """Whether a known number, at any depth, has another wire type than its field: protobuf takes it for unknown."""
    unknown: Any = UnknownFieldSet(message)
    if any(each.field_number in message.DESCRIPTOR.fields_by_number for each in unknown):
        return True
    inside = [(field, value) for field, value in message.ListFields() if field.message_type is not None]
    messages = [value if field.is_repeated else [value] for field, value in inside if field.name != "by_number"]
    return any(map(has_other_wire_types, chain.from_iterable(messages)))


def test_of_envelopes_that_are_almost_right_boards_get_those_that_they_can_take(yard: Yard) -> None:
    mutator = Mutator(WIRE, 0)
    for _ in range(10 * RANDOM // AT_ONCE):
        turn = yard.place.scrape()
        yard.send(*(mutator.envelope() for _ in range(AT_ONCE)))
        yard.place.settle(turn, AT_ONCE)
    arrived, verdicts = yard.place.waiting(), yard.board.waiting()
    assert len(arrived["tool"]) > len(arrived["lenient_board"]) > 0
    assert {verdict.refused for verdict in verdicts} >= {"", "wrong wire type"}
    assert [verdict for verdict in verdicts if not is_expected(verdict)] == []
