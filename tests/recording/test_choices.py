"""Recordings of each kind of envelope give back the datagrams, and their payloads without the table."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest
from mcap.reader import make_reader

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.datagrams import Wire
from router.recording.about import about
from router.recording.channels import Channels
from router.recording.encoder import Packer
from router.recording.mirror import SENT, Action, Classifier, MirroredDatagram
from router.recording.reader import Recorded, RecordedAction, Recording
from router.recording.schemas import recorded_envelopes
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


def program(table: str) -> CompiledTable:
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
        found = Wire(recorded_envelopes(recording.cases(), recording.about))
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
        found = Wire(recorded_envelopes(recording.cases(), recording.about))
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
        found = recorded_envelopes(recording.cases(), recording.about)
    assert found.at("crowd").cases_in(b"\x1a\x00") == []
    assert [*found.at("game").cases] == ["game.status"]
