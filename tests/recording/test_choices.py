"""Recordings of each kind of envelope give back the datagrams, and their payloads without the table."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any, cast

import pytest
from google.protobuf import text_format
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessages
from mcap.reader import make_reader

from router.cli import main
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.datagrams import Wire
from router.recording.about import about
from router.recording.channels import Channels
from router.recording.encoder import Packer
from router.recording.mirror import SENT, Action, Classifier, MirroredDatagram
from router.recording.reader import Recorded, RecordedAction, Recording
from router.recording.schemas import recorded_envelopes
from router.tools.tap import tapped_datagram
from tests.recording.recorder_rig import START, Listed, shown, write

TABLES = Path(__file__).parents[1] / "rehearsal" / "tables"

FRAMED = [b"\x08\x02\x10\x02", b"", b"\x08\x03\x22\x07\x08\x00\x15", b"\x08\x03\0\0", b"\x22\x02\x08"]
NAMED = [
    b"\x0a\x06Status\x12\x02\x08\x05",
    b"\x0a\x0bburt.Status",
    b"\x12\x02\x08\x01\x18\x01\x0a\x0bburt.Status",
    b"\x0a\x0bburt.Status\x12\x04\x12\x02a",
]


SHARED = [
    b"\x12\x02\x08\x05",
    b"\x3a\x02\x08\x09\x18\x03\x12\x04\x08\x05\x12\x00",
    b"\x3a\x00\x12",
    b"\x3a\x00\x12\x00\0\0",
]
DATAGRAMS = [("framed.yaml", FRAMED), ("named.yaml", NAMED), ("vision.yaml", SHARED)]


def program(table: str | Path) -> CompiledTable:
    made = check_table(TABLES / table, {}).program
    assert made is not None
    return made


@pytest.mark.parametrize(("table", "datagrams"), DATAGRAMS)
def test_datagrams_and_payloads_come_back(table: str, datagrams: list[bytes], tmp_path: Path) -> None:
    made = program(table)
    batch = [shown(data, START + number) for number, data in enumerate(datagrams)]
    sent = [Action(START, SENT, "route", "board", data=datagrams[0])]
    classifier = Classifier(made.envelopes, made.table)
    packed = Packer().pack(Listed(batch), Listed(sent), classifier, START, 0)
    path = write(tmp_path / "it.mcap", Channels(), packed)
    with closing(Recording(path)) as recording:
        found = Wire(recorded_envelopes(recording.types(), recording.about))
        records = list(recording.everything())
    assert [record.data for record in records if isinstance(record, Recorded)] == datagrams
    assert [record.action.data for record in records if isinstance(record, RecordedAction)] == [datagrams[0]]
    own = Wire(made.envelopes)
    for data in datagrams:
        for now, before in zip(found.decode_all(data), own.decode_all(data), strict=True):
            assert now.case.name == before.case.name
            assert now.message.SerializeToString() == before.message.SerializeToString()


def test_viewers_get_each_message_of_a_datagram(tmp_path: Path) -> None:
    made = program("vision.yaml")
    classifier = Classifier(made.envelopes, made.table)
    packed = Packer().pack(Listed([shown(SHARED[1], START)]), Listed(list[Action]()), classifier, START, 0)
    path = write(tmp_path / "it.mcap", Channels(), packed)
    with path.open("rb") as file:
        found = {channel.topic: message.data for _, channel, message in make_reader(file).iter_messages()}
    assert found["geometry"] == b"\x08\x09"
    assert found["detection"] == b"\x08\x05\x12\x00"


def test_several_envelopes_come_back(tmp_path: Path) -> None:
    made = program("several.yaml")
    envelopes = made.envelopes

    def encoded(name: str) -> bytes:
        case, fields = envelopes.cases[name], {} if name.endswith("status") else {"level": 1}
        return envelopes.of(name).around(case, case.message_class(**fields)).SerializeToString()

    received = {"game.status": "game", "crowd.status": "crowd", "crowd.light": "crowd"}
    sent = {"show.light": "stage", "Light": "logger", "lamp": "lamp"}
    batch = [MirroredDatagram(START, at, ("127.0.0.1", 5), "", "", encoded(name)) for name, at in received.items()]
    acted = [Action(START, SENT, "crowd.light", to, data=encoded(name)) for name, to in sent.items()]
    packed = Packer().pack(Listed(batch), Listed(acted), Classifier(envelopes, made.table), START, 0)
    path = write(tmp_path / "it.mcap", Channels(), packed, metadata=about(made.table, "test"))
    with closing(Recording(path)) as recording:
        found = Wire(recorded_envelopes(recording.types(), recording.about))
        records = [*recording.everything()]
    datagrams = [each for each in records if isinstance(each, Recorded)]
    actions = [each.action for each in records if isinstance(each, RecordedAction)]
    assert [each.data for each in datagrams] == [each.data for each in batch]
    names = [found.decode(each.data, found.envelopes.at(each.listener)).case.name for each in datagrams]
    assert names == [*received]
    assert [found.decode(each.data, found.envelopes.to(each.target)).case.name for each in actions] == [*sent]


def test_an_envelope_without_recorded_payloads_is_not_taken_for_another(tmp_path: Path) -> None:
    made = program("several.yaml")
    case = made.envelopes.cases["game.status"]
    batch = [MirroredDatagram(START, "game", ("127.0.0.1", 5), "", "", case.message_class().SerializeToString())]
    packed = Packer().pack(Listed(batch), Listed(list[Action]()), Classifier(made.envelopes, made.table), START, 0)
    path = write(tmp_path / "it.mcap", Channels(), packed, metadata=about(made.table, "test"))
    with closing(Recording(path)) as recording:
        found = recorded_envelopes(recording.types(), recording.about)
    assert found.at("crowd").cases_in(b"\x1a\x00") == []
    assert [*found.at("game").cases] == ["game.status"]


def beside_frame(text: bytes, **fields: object) -> bytes:
    made = program("beside.yaml").envelopes.first.message_class
    frame = made.FromString(text)
    frame.MergeFrom(made(**fields))
    return frame.SerializeToString()


SPEED = b"\x1a\x09\x09" + bytes(6) + b"\xf0\x3f"  # speed {value: 1}
BESIDE = [
    beside_frame(SPEED, robot=3, mode=1, percent=7, place=2),
    beside_frame(b"\x22\x00", header={"seq": 9, "sent_at": {"seconds": 5}}, name="left"),
    beside_frame(b"\x22\x00", volts=0.0),
    beside_frame(b"\x22\x00", volts=0.0).rstrip(b"\0"),
    SPEED,
]


def recorded(path: Path, table: str | Path, received: list[bytes], sent: list[tuple[str, bytes]]) -> Path:
    """A recording of these datagrams, and of those sent to endpoints."""
    made = program(table)
    batch = [shown(data, START + number) for number, data in enumerate(received)]
    acted = [Action(START, SENT, "route", to, data=data) for to, data in sent]
    packed = Packer().pack(Listed(batch), Listed(acted), Classifier(made.envelopes, made.table), START, 0)
    return write(path / "it.mcap", Channels(), packed, metadata=about(made.table, "test"))


def printed(path: Path, capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    """What is printed after each time."""
    assert main(["show", str(path), *words]) == 0
    return [line.partition(" ")[2] for line in capsys.readouterr().out.splitlines()]


def test_fields_beside_the_payload_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(tmp_path, "beside.yaml", BESIDE, [("board", BESIDE[0])])
    speed = "speed value=1.0"
    beside = "envelope.robot=3 envelope.mode=AUTONOMOUS envelope.percent=7 envelope.place=2"
    assert printed(path, capsys) == [
        f"sensor_board {speed} {beside}",
        f"sent to board (route): {speed} {beside}",
        "sensor_board labelled envelope.header.seq=9 envelope.header.sent_at.seconds=5 envelope.name=left",
        "sensor_board labelled envelope.volts=0",
        "sensor_board labelled envelope.volts=0 (trimmed: 4 zeros restored)",
        f"sensor_board {speed}",
    ]
    assert len(printed(path, capsys, "--where", "has(envelope.header) and envelope.header.seq > 8")) == 1
    assert len(printed(path, capsys, "--where", "envelope.mode == Mode.AUTONOMOUS")) == 2
    assert len(printed(path, capsys, "--where", "not has(envelope.volts)")) == 4


def test_each_envelope_has_its_own_fields_beside_the_payload(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = program("several.yaml")
    crowd, tick = made.envelopes.by_name["crowd"].message_class, made.envelopes.by_name["show"].message_class
    noise, light = crowd(seq=7, status={"noise": 1.0}).SerializeToString(), tick(tick=3, light={}).SerializeToString()
    batch = [shown(noise, START, listener="crowd"), shown(b"", START + 1, listener="game")]
    acted = [Action(START + 2, SENT, "crowd.light", "stage", data=light)]
    packed = Packer().pack(Listed(batch), Listed(acted), Classifier(made.envelopes, made.table), START, 0)
    path = write(tmp_path / "it.mcap", Channels(), packed, metadata=about(made.table, "test"))
    assert printed(path, capsys) == [
        "sensor_board crowd.status noise=1 envelope.seq=7",
        "sensor_board game.status (all default)",
        "sent to stage (crowd.light): show.light envelope.tick=3",
    ]
    assert len(printed(path, capsys, "--where", "envelope.tick == 3")) == 1
    with path.open("rb") as file:
        topics = sorted(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert topics == [
        "crowd.status", "game.status", "raw/datagrams/crowd", "sent/raw/datagrams/show", "sent/show.light",
    ]  # fmt: skip


def test_an_empty_message_that_is_the_whole_frame_is_recorded_as_a_payload(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded(tmp_path, "framed.yaml", [b""], [("board", b"")])
    assert printed(path, capsys) == [
        "sensor_board referee (all default)",
        "sent to board (route): referee (all default)",
    ]
    with path.open("rb") as file:
        topics = sorted(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert topics == ["referee", "sent/referee"]
    with closing(Recording(path)) as recording:
        assert [each.data for each in recording.datagrams()] == [b""]


@pytest.mark.parametrize(("table", "datagrams"), [*DATAGRAMS, ("beside.yaml", BESIDE)])
def test_each_schema_decodes_its_messages_with_protobuf(table: str, datagrams: list[bytes], tmp_path: Path) -> None:
    own = Wire(program(table).envelopes)
    path = recorded(tmp_path, table, datagrams, [("board", datagrams[0])])
    found: dict[str, list[Message]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            made = GetMessages(FileDescriptorSet.FromString(schema.data).file)[schema.name]
            found.setdefault(channel.topic, []).append(made.FromString(message.data))
    decoded = [each for data in datagrams for each in own.decode_all(data)]
    for name in {each.case.name for each in decoded}:
        payloads = [each.message.SerializeToString() for each in decoded if each.case.name == name]
        assert [each.SerializeToString() for each in found[name]] == payloads
    sent = own.decode(datagrams[0])
    assert [each.SerializeToString() for each in found[f"sent/{sent.case.name}"]] == [sent.message.SerializeToString()]
    for topic in found.keys() & {"raw/datagrams", "sent/raw/datagrams"}:
        for each in found[topic]:
            whole = cast("Any", each)
            if (beside := own.decode(whole.data).beside) is not None:
                assert whole.envelope.SerializeToString() == beside.SerializeToString()


PROTO2 = """syntax = "proto2";
enum Mode { OFF = 2; ON = 5; }
message Note { required float x = 1; }
message Frame {
  required uint32 seq = 1; optional Note note = 2; optional Note other = 3; optional Mode mode = 4 [default = ON];
  repeated int32 packed = 6 [packed = true]; optional group Pair = 9 { optional int32 k = 1; }
}
"""
PROTO3 = """syntax = "proto3";
message Note { float x = 1; }
message Frame {
  optional uint32 seq = 1; oneof payload { Note note = 2; Note other = 3; } oneof battery { int32 a = 4; string b = 5; }
  message Inner { enum Mode { OFF = 0; ON = 1; } Mode mode = 1; }
  Inner inner = 6; repeated Inner.Mode modes = 7; map<string, int32> counts = 8; optional bool is_last = 9;
}
"""
EDITION = """edition = "2023";
option features.field_presence = IMPLICIT;
enum Mode { option features.enum_type = CLOSED; OFF = 0; ON = 5; }
message Note { float x = 1; }
message Frame {
  uint32 seq = 1 [features.field_presence = EXPLICIT]; oneof payload { Note note = 2; }
  Mode mode = 4 [features.field_presence = EXPLICIT];
  Note part = 6 [features.message_encoding = DELIMITED];
}
"""
NAME_CLASHES = """syntax = "proto3";
message Note { float x = 1; }
message Frame { string kind = 1; bytes body = 2; string name = 3; bytes data = 4; Note payload = 5; }
"""
SYNTAXES = [
    (PROTO2, "cases: [note, other]", "seq: 4 note {x: 1} other {x: 2} mode: OFF packed: [1, 2] Pair {k: 3}"),
    (PROTO2, "cases: [note, other]", "seq: 4 note {x: 1}"),
    (
        PROTO3,
        "oneof: payload",
        "seq: 0 note {} b: '' inner {mode: ON} modes: [ON] counts {key: 'a' value: 3} is_last: false",
    ),
    (EDITION, "oneof: payload", "seq: 0 note {} mode: ON part {x: 2}"),
    (NAME_CLASHES, "case: kind, payload: body", "kind: 'Note' name: 'n' data: 'd' payload {x: 3}"),
]


@pytest.mark.parametrize(("protos", "choice", "text"), SYNTAXES)
def test_fields_beside_the_payload_mean_what_their_protos_say(
    protos: str, choice: str, text: str, tmp_path: Path
) -> None:
    (tmp_path / "frame.proto").write_text(protos)
    table = tmp_path / "table.yaml"
    table.write_text(
        f"version: 1\nenvelope: {{protos: ., message: Frame, {choice}}}\n"
        'listen: {rover: {address: "127.0.0.1:5000"}}\nroutes: {}\n'
        'endpoints: {board: {address: "127.0.0.2:5000", kind: tool}}\n'
    )
    own = Wire(program(table).envelopes)
    frame = text_format.Parse(text, own.envelopes.first.message_class()).SerializeToString()
    with closing(Recording(recorded(tmp_path, table, [frame], [("board", frame)]))) as recording:
        wire = Wire(recorded_envelopes(recording.types(), recording.about))
        received, sent = recording.everything()
    assert isinstance(received, Recorded)
    assert isinstance(sent, RecordedAction)
    lines = [each.line(True) for each in tapped_datagram(START, "board", frame, own)]
    assert "envelope." in lines[0]
    assert [each.line(True) for each in tapped_datagram(START, "board", received.data, wire)] == lines
    assert sent.action.data == frame
