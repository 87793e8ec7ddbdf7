"""Expressions of the table's language over payloads, as `router tap --where` asks them."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest

from router.cli.send import envelope_of
from router.compiler import check_table
from router.datagrams import Decoded, Wire
from router.errors import UsageError
from router.observe.tap import Lost
from router.recording.mirror import BRAKED, SENT, TRIPPED, Action, MirroredDatagram
from router.table.addresses import Address
from router.tools.tap import Condition, Filter, RunningTap, listen, shown, tapped_datagram
from router.tools.udp import open_udp
from router.values.reading import payload
from tests.observe.fake_running import sim_program

TABLES = Path(__file__).parents[1] / "rehearsal" / "tables"


def datagram(wire: Wire, *words: str) -> bytes:
    case = wire.case("every_kind")
    return wire.encode(case, payload(case, words))


def test_a_line_tells_time_peer_case_and_fields(wire: Wire) -> None:
    (told,) = tapped_datagram(0, "board", datagram(wire, "i32=5", "mode=MODE_ON"), wire)
    assert told.line(with_hex=False).split(" ", 1)[1] == "board every_kind i32=5 mode=MODE_ON"
    assert told.line(with_hex=True).endswith("[0a0410056001]")


def test_repairs_are_told(wire: Wire) -> None:
    (trimmed,), (padded,) = (tapped_datagram(0, "board", data, wire) for data in (b"\x12", b"\x12\0\0\0"))
    assert trimmed.line(with_hex=False).endswith("(trimmed: 1 zeros restored)")
    assert padded.line(with_hex=False).endswith("(padded: 2 zeros removed)")


def test_each_message_of_a_datagram_has_a_line() -> None:
    told = tapped_datagram(0, "camera", b"\x3a\x02\x08\x09\x12\x02\x08\x05", wire_of("vision.yaml"))
    assert [each.line(with_hex=False).split(" ", 1)[1] for each in told] == [
        "camera detection frame=5",
        "camera geometry length=9",
    ]


def wire_of(table: str) -> Wire:
    program = check_table(TABLES / table, {}).program
    assert program is not None
    return Wire(program.envelopes)


@pytest.mark.parametrize(
    ("table", "case", "inside", "around", "beside"),
    [
        (
            "beside.yaml",
            "speed",
            "value=1.5",
            "envelope.header.seq=2 envelope.robot=3 envelope.mode=AUTONOMOUS envelope.volts=0.5",
            {"header": {"seq": 2}, "robot": 3, "mode": "AUTONOMOUS", "volts": 0.5},
        ),
        ("beside.yaml", "speed", "value=1.5", "", {}),
        ("named.yaml", "burt.Status", "mode=DRIVING", "envelope.sequence=7", {"sequence": 7}),
        ("vision.yaml", "detection", "frame=5", "envelope.camera=2", {"camera": 2}),
        ("framed.yaml", "referee", "sequence=5", "", None),
    ],
)
def test_fields_beside_the_payload_are_shown_as_they_are_sent(
    table: str, case: str, inside: str, around: str, beside: object
) -> None:
    wire = wire_of(table)
    data = envelope_of(wire, [case, *inside.split(), *around.split()])
    [told] = tapped_datagram(0, "board", data, wire)
    assert told.line(with_hex=False).split(" ", 1)[1] == " ".join(filter(None, ("board", case, inside, around)))
    assert json.loads(told.json(with_hex=False)).get("envelope") == beside
    [sent] = shown(Action(2, SENT, "drive", "board", data=data), wire)
    assert sent.line(with_hex=False).endswith(" ".join(filter(None, (case, inside, around))))
    assert json.loads(sent.json(with_hex=False)).get("envelope") == beside


@pytest.mark.parametrize(
    ("route", "topic", "by"),
    [
        ("service.arm", "service.arm", "service.arm"),
        ("service.home", "service.home.on_timeout", "service.home from service.home.on_timeout"),
        ("drive", "drive", "drive from topic drive"),
    ],
)
def test_messages_of_services_come_from_no_topic(wire: Wire, route: str, topic: str, by: str) -> None:
    [sent] = shown(Action(2, SENT, route, "board", topic, data=datagram(wire, "i32=5")), wire)
    assert sent.line(with_hex=False).split(" ", 1)[1] == f"sent to board ({by}): every_kind i32=5"


def test_several_payload_cases_are_sent_in_one_datagram() -> None:
    wire = wire_of("vision.yaml")
    data = envelope_of(wire, ["geometry", "length=9", "envelope.camera=2", "detection", "frame=5"])
    assert [each.line(with_hex=False).split(" ", 1)[1] for each in tapped_datagram(0, "camera", data, wire)] == [
        "camera detection frame=5 envelope.camera=2",
        "camera geometry length=9 envelope.camera=2",
    ]


@pytest.mark.parametrize(
    ("table", "words", "complaint"),
    [
        ("vision.yaml", "detection frame=5 detection", "the payload case 'detection' is named twice"),
        ("vision.yaml", "detection frame", "'frame' is neither a field with a value nor a payload case; write frame="),
        (
            "vision.yaml",
            "detektion frame=5",
            "vision.Wrapper has no payload case 'detektion'; did you mean 'detection'",
        ),
        ("named.yaml", "Status level=1 burt.Status", "WrappedMessage cannot hold Status and burt.Status at once"),
        ("beside.yaml", "speed nested", "Frame cannot hold speed and nested at once"),
    ],
)
def test_payload_cases_that_one_datagram_cannot_hold_are_refused(table: str, words: str, complaint: str) -> None:
    with pytest.raises(UsageError) as refused:
        envelope_of(wire_of(table), words.split())
    assert str(refused.value).startswith(complaint)


@pytest.mark.parametrize(
    ("table", "case", "where", "holds"),
    [
        ("beside.yaml", "speed", "envelope.robot == 3 and value > 1", True),
        ("beside.yaml", "speed", "envelope.mode == Mode.MANUAL", False),
        ("named.yaml", "burt.Status", "envelope.sequence > 6", True),
        ("vision.yaml", "detection", "envelope.camera == 3", False),
    ],
)
def test_a_condition_reads_fields_beside_the_payload(table: str, case: str, where: str, holds: bool) -> None:
    wire = wire_of(table)
    words = {"speed": "value=1.5 envelope.robot=3 envelope.mode=AUTONOMOUS", "detection": "envelope.camera=2"}
    data = envelope_of(wire, [case, *words.get(case, "envelope.sequence=7").split()])
    [told] = tapped_datagram(0, "board", data, wire)
    assert Filter((), Condition(where, wire.envelopes, [wire.case(case)])).takes(told, 0) is holds


def test_payloads_that_the_last_one_replaces_are_told(wire: Wire) -> None:
    other = wire.encode(wire.case("plain"), payload(wire.case("plain"), []))
    (told,) = tapped_datagram(0, "board", other + datagram(wire, "i32=5"), wire)
    assert told.line(with_hex=False).endswith("every_kind i32=5 (superseded: plain)")
    assert json.loads(told.json(with_hex=False))["superseded"] == ["plain"]


def test_an_undecodable_datagram_is_shown_with_reason_and_bytes(wire: Wire) -> None:
    (told,) = tapped_datagram(0, "127.0.0.1:5", b"\xff\xff", wire)
    assert told.line(with_hex=False).split(" ", 1)[1] == (
        "127.0.0.1:5 undecodable (malformed: does not parse as PBEnvelope): ffff"
    )
    assert json.loads(told.json(with_hex=False))["hex"] == "ffff"


def test_a_rejected_datagram_is_marked_with_the_reason(wire: Wire) -> None:
    (told,) = tapped_datagram(0, "127.0.0.9:5", datagram(wire, "i32=5"), wire, "source_mismatch")
    assert " 127.0.0.9:5 rejected (source_mismatch) every_kind i32=5" in told.line(with_hex=False)
    assert json.loads(told.json(with_hex=False))["rejected"] == "source_mismatch"


def test_json_has_the_fields_by_their_proto_names(wire: Wire) -> None:
    (told,) = tapped_datagram(0, "board", datagram(wire, "point.x=3", "single=nan"), wire)
    said = json.loads(told.json(with_hex=False))
    assert said["fields"] == {"single": "NaN", "point": {"x": 3}}
    assert (said["case"], said["peer"], said["bytes"], "hex" in said) == ("every_kind", "board", 11, False)


@pytest.mark.parametrize(
    ("cases", "shown"),
    [
        (
            (),
            [
                "board every_kind i32=5",
                "sent to board (drive from topic cmd): every_kind i32=5",
                "the deadman of drive tripped",
                "sent to board (the deadman of drive): plain (all default)",
            ],
        ),
        (("plain",), ["sent to board (the deadman of drive): plain (all default)"]),
    ],
)
def test_a_running_router_shows_what_it_receives_and_sends_in_order(
    wire: Wire, cases: tuple[str, ...], shown: list[str]
) -> None:
    command, brake = datagram(wire, "i32=5"), wire.encode(wire.case("plain"), payload(wire.case("plain"), []))
    actions = [
        Action(2, SENT, "drive", "board", "cmd", data=command),
        Action(3, TRIPPED, "drive"),
        Action(4, BRAKED, "drive", "board", data=brake),
    ]
    tap = RunningTap(wire, Filter(cases))
    received = MirroredDatagram(1, "here", ("127.0.0.2", 5), "board", "", command)
    [batch] = tap.take([[*actions, received, Lost(7)]])
    assert [each.line(with_hex=False).split(" ", 1)[1] for each in batch] == shown
    assert tap.missed == 7


def test_datagrams_are_heard_in_order(wire: Wire) -> None:
    with open_udp(Address("127.0.0.1", 0), "tap") as tap, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        for data in (b"\x12\x00", b"", b"\x0a\x00"):
            board.sendto(data, tap.getsockname())
        hearing = listen(tap, wire, wire.envelopes.first, lambda peer: f"port {peer[1]}")
        [first], [second], [third] = next(hearing), next(hearing), next(hearing)
    assert first.decoded is not None
    assert third.decoded is not None
    assert (first.decoded.case.name, second.problem, third.decoded.case.name) == ("plain", "empty", "every_kind")
    assert first.peer.startswith("port ")


ENVELOPES = sim_program().envelopes
CASES = ENVELOPES.cases


def holds(text: str, case: str, source: str = "sensor_board", **fields: object) -> bool:
    decoded = Decoded(CASES[case], CASES[case].message_class(**fields), 0)
    return Condition(text, ENVELOPES, [CASES[case]]).holds(decoded, source, 0)


@pytest.mark.parametrize(
    ("text", "is_true"),
    [
        ("accel_z > 9", True),
        ("accel_z > 10", False),
        ("abs(accel_x) < 1 and is_calibrated", True),
        ("state == SensorState.SENSOR_OPERATING", True),
        ("source == 'sensor_board'", True),
        ("source == 'arm_board'", False),
        ("received_at == 0", False),
    ],
)
def test_a_condition_is_an_expression_over_the_payload(text: str, is_true: bool) -> None:
    if "received_at" in text:
        with pytest.raises(UsageError, match="--where: "):
            holds(text, "imu_info")
        return
    assert holds(text, "imu_info", accel_z=9.5, is_calibrated=True, state=1) == is_true


def test_cases_without_the_field_are_left_out() -> None:
    condition = Condition("satellites < 4", ENVELOPES, list(CASES.values()))
    assert condition.cases == {"gps_info"}
    assert not condition.holds(Decoded(CASES["imu_info"], CASES["imu_info"].message_class(), 0), "sensor_board", 0)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("satelites < 4", "--where: SensorBoardGPSInfo has no field 'satelites'; did you mean 'satellites'?"),
        ("satellites", "--where: it is int32, not a bool; compare something, as in speed > 0"),
        ("satellites <", "--where: not an expression: a value is missing after '<'"),
        ("__import__('os')", "--where: "),
    ],
)
def test_what_is_no_condition_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(UsageError) as refused:
        Condition(text, ENVELOPES, list(CASES.values()) if "<" in text else [CASES["gps_info"]])
    assert str(refused.value).startswith(complaint)


def test_where_it_cannot_be_computed_it_does_not_hold_and_is_remembered() -> None:
    condition = Condition("altitude / speed > 1", ENVELOPES, [CASES["gps_info"]])
    assert not condition.holds(Decoded(CASES["gps_info"], CASES["gps_info"].message_class(), 0), "sensor_board", 0)
    assert condition.failure.startswith("gps_info: ")
