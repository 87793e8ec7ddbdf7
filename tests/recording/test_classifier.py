"""What is in a datagram, beside routing: the same as in routing."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given

from router.compiler import check_table
from router.declared import MAX_DATAGRAM
from router.recording.mirror import Classifier
from router.types.case_by import ByCases, ByOneof
from router.types.protobuf import PayloadCase
from tests.envelopes import I32, I64, LEN, VARINT, framed, tag
from tests.observe.fake_running import sim_program
from tests.recording.recorder_rig import classifier, datagrams
from tests.tables import ROUTES

PROGRAM = sim_program()
KNOWN = Classifier(PROGRAM.envelopes, PROGRAM.table)
NUMBERS = frozenset(PROGRAM.envelopes.first.numbers.values())
VALUES = {VARINT: b"\xff\x01", I64: bytes(8), I32: bytes(4), LEN: b"\x02ab"}
BRAKE = PROGRAM.envelopes.first.message_class(manual_brake={"brake": True}).SerializeToString()


def case_in(data: bytes, known: Classifier = KNOWN, listener: str = "rover") -> str | None:
    found = known.payloads(listener, data)
    return found[0][0].name if found else None


@pytest.mark.parametrize("case", PROGRAM.envelopes.first.cases.values(), ids=lambda case: case.name)
def test_the_case_is_found_without_parsing(case: PayloadCase) -> None:
    data = PROGRAM.envelopes.first.message_class(**{case.name: {}}).SerializeToString()
    assert ByOneof("payload").numbers_in(data, NUMBERS) == [case.number]
    assert KNOWN.payloads("rover", data) == [(case, case.message_class())]


@pytest.mark.parametrize("data", [b"", b"\x80", b"\xff\xff\xff"])
def test_what_begins_with_no_tag_has_no_payload(data: bytes) -> None:
    assert ByOneof("payload").numbers_in(data, NUMBERS) == []
    assert case_in(data) is None


@pytest.mark.parametrize("before", [b"", *(tag(20, kind) + value for kind, value in VALUES.items())])
def test_a_payload_is_found_behind_other_fields_of_the_envelope(before: bytes) -> None:
    for number in (1, 16, 2047, 2048, 2**29 - 1):
        assert ByOneof("payload").numbers_in(before + framed(number, b"x"), {number}) == [number]
    assert ByOneof("payload").numbers_in(before + framed(17, b"x"), {16}) == []


def test_each_case_of_a_datagram_is_found_once() -> None:
    data = framed(16, b"x") + tag(3, VARINT) + b"\1" + framed(2, b"") + framed(16, b"")
    assert ByCases(["two", "sixteen"]).numbers_in(data, {2, 16}) == [16, 2]
    assert ByCases(["two", "sixteen"]).numbers_in(data[:4], {2}) == []


@given(datagrams())
def test_an_encoded_payload_is_the_payload(data: bytes) -> None:
    known = classifier()
    decoded, encoded = known.payloads("rover", data), known.encoded_payloads("rover", data)
    assert [case.name for case, _ in encoded] == [case.name for case, _ in decoded]
    for (case, payload), (_, message) in zip(encoded, decoded, strict=True):
        assert case.message_class.FromString(payload).SerializeToString() == message.SerializeToString()


def test_what_is_longer_than_the_router_takes_has_no_payload() -> None:
    whole = BRAKE * (MAX_DATAGRAM // len(BRAKE))
    assert case_in(whole) == "manual_brake"
    assert case_in(whole + bytes(MAX_DATAGRAM + 1 - len(whole))) is None


def test_zeros_are_repaired_where_the_listener_does_that(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    table.write_text(f"version: 1\nextends: {ROUTES}/sim.yaml\nlisten: {{rover: {{framing: exact}}}}\n")
    program = check_table(table).program
    assert program is not None
    exact = Classifier(program.envelopes, program.table)
    padded = BRAKE + bytes(5)
    assert [case_in(padded), case_in(padded, exact), case_in(BRAKE, exact)] == ["manual_brake", None, "manual_brake"]
    assert case_in(padded, listener="another") is None


def test_senders_are_called_what_the_table_calls_them() -> None:
    peers = [("127.0.0.30", 25008), ("127.0.0.10", 1), ("10.9.9.9", 1)]
    assert [KNOWN.sender("rover", peer) for peer in peers] == ["sensor_board", "basestation", ""]


def test_a_sender_is_called_what_the_listener_takes_it_for(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    table.write_text(
        f"version: 1\nextends: {ROUTES}/sim.yaml\n"
        "listen: {radio: {address: 127.0.0.6:25000, interface: lo}}\n"
        "endpoints: {basestation: {listener: radio}}\n"
    )
    program = check_table(table).program
    assert program is not None
    known, station = Classifier(program.envelopes, program.table), ("127.0.0.10", 29000)
    assert [known.sender(listener, station) for listener in ("rover", "radio", "gone")] == ["", "basestation", ""]
    assert known.sender("rover", ("127.0.0.30", 25008)) == "sensor_board"
