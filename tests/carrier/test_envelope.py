"""The carrier decides about datagrams as protobuf does, over schemas with fields of every kind."""

from __future__ import annotations

import ctypes
import random
from collections.abc import Mapping
from pathlib import Path

import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.declared import MAX_DATAGRAM
from router.errors import Code
from router.types.case_by import ByCases
from router.types.wire import read_varint
from tests.carrier.datagrams import GROUP, GROUP_END, maker_for
from tests.carrier.decisions import HEAD, ONEOF, SCHEMAS, CarrierSide, table
from tests.envelopes import I32, I64, LEN, VARINT, damaged, framed, tag, varint
from tests.oracles.envelopes import Decision, decide, parts
from tests.small_tables import program

ONEOF_HEAD = HEAD.replace("CHOICE", ONEOF)
Sides = tuple[CompiledTable, CarrierSide]


@pytest.fixture(scope="module")
def sides(library: ctypes.CDLL, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Sides]:
    """By schema: the table, and the carrier."""
    folder = tmp_path_factory.mktemp("envelope")
    tables = {schema: table(schema, folder) for schema in SCHEMAS}
    return {schema: (made, CarrierSide(library, made)) for schema, made in tables.items()}


def decided(sides: Sides, data: bytes, repairs: bool = True) -> Decision:
    """The decision of the carrier, which has to be the oracle's; what it says of the payload is checked too."""
    made, carrier = sides
    decision = carrier.decide(data, repairs)
    assert decision == decide(made.envelopes.first, made.inbound, data, MAX_DATAGRAM, repairs)
    if decision.reason is None and isinstance(made.envelopes.first.choice, ByCases) and decision.superseded:
        assert [*carrier.parts()] == parts(made.envelopes.first, carrier.whole())
        return decision
    if decision.reason is None and decision.number in {case.number for case in made.envelopes.first.cases.values()}:
        case = next(case for case in made.envelopes.first.cases.values() if case.number == decision.number)
        payload, parse = carrier.payload(), made.envelopes.first.message_class.FromString
        found = payload.of(carrier.whole())
        assert payload.is_single or read_varint(found, 0)[0] == case.number << 3 | LEN
        try:
            alone = case.message_class.FromString(found) if payload.is_single else getattr(parse(found), case.name)
            ((_, held),) = made.envelopes.first.payloads_of(parse(carrier.whole()))
        except DecodeError:  # one level too deep for the envelope
            return decision
        assert alone.SerializePartialToString() == held.SerializePartialToString()
    return decision


@pytest.mark.parametrize("schema", SCHEMAS)
@given(noise=st.randoms(use_true_random=False), repairs=st.booleans())
def test_pieces_of_the_wire_format(
    sides: Mapping[str, Sides], schema: str, noise: random.Random, repairs: bool
) -> None:
    decided(sides[schema], maker_for(sides[schema][0].envelopes.first, noise).datagram(), repairs)


@given(data=damaged(), repairs=st.booleans())
def test_damaged_envelopes_of_the_rover(sides: Mapping[str, Sides], data: bytes, repairs: bool) -> None:
    decided(sides["rover"], data, repairs)


@pytest.mark.parametrize("schema", SCHEMAS)
@given(data=st.binary(max_size=40), repairs=st.booleans())
def test_any_bytes(sides: Mapping[str, Sides], schema: str, data: bytes, repairs: bool) -> None:
    decided(sides[schema], data, repairs)


@pytest.mark.parametrize("schema", SCHEMAS)
@pytest.mark.parametrize("seed", [*range(20), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(20, 100))])
def test_a_thousand_of_each_seed(sides: Mapping[str, Sides], schema: str, seed: int) -> None:
    maker = maker_for(sides[schema][0].envelopes.first, random.Random(seed))
    for _ in range(1000):
        decided(sides[schema], maker.datagram(), seed % 3 != 0)


TREE, TEXTS, SCALARS, OLD, MAPS, UNROUTED, UNROUTED_TREE, NUMBER = 2, 15, 16, 2047, 2048, 4, 5, 20
BEAT = tag(NUMBER, VARINT) + b"\1"


def nested(depth: int) -> bytes:
    """A tree that is `depth` levels below the outermost one."""
    tree = b""
    for _ in range(depth):
        tree = framed(1, tree)
    return tree


def grouped(depth: int) -> bytes:
    return tag(99, GROUP) * depth + tag(99, GROUP_END) * depth


def case(number: int, is_repaired: bool = False, superseded: int = 0) -> Decision:
    return Decision(None, number, is_repaired, superseded)


MALFORMED = Decision("malformed", 0, False)


@pytest.mark.parametrize(
    ("data", "decision"),
    [
        pytest.param(b"", Decision("empty", 0, False), id="nothing"),
        pytest.param(bytes(7), Decision("no_payload", 0, True), id="only padding"),
        pytest.param(framed(TREE, b""), case(TREE), id="an empty payload"),
        pytest.param(framed(TREE, b"") + bytes(3), case(TREE, True), id="padding"),
        pytest.param(tag(TREE, LEN), case(TREE, True), id="a size that was left out"),
        pytest.param(framed(SCALARS, tag(5, I32) + bytes(4))[:-4], case(SCALARS, True), id="zeros that were left out"),
        pytest.param(b"\x92\x00\x00", case(TREE), id="a long tag"),
        pytest.param(b"\x92\x80\x80\x80\x00\x00", case(TREE), id="the longest tag"),
        pytest.param(b"\x92\x80\x80\x80\x80\x00\x00", MALFORMED, id="too long a tag"),
        pytest.param(b"\x92\x80\x80\x80\x10\x00", MALFORMED, id="a tag of 33 bits"),
        pytest.param(b"\x12\x80\x80\x80\x80\x00", case(TREE), id="the longest size"),
        pytest.param(b"\x12\x80\x80\x80\x80\x80\x00", MALFORMED, id="too long a size"),
        pytest.param(b"\x12\xff\xff\xff\xff\x7f", MALFORMED, id="a size of 35 bits"),
        pytest.param(b"\x18" + b"\xff" * 9 + b"\x7f", Decision("no_payload", 0, False), id="the longest varint"),
        pytest.param(b"\x18" + b"\xff" * 10 + b"\x00", MALFORMED, id="too long a varint"),
        pytest.param(b"\x02\x00", MALFORMED, id="field number 0"),
        pytest.param(framed(1, b"\x02\x00"), case(1), id="field number 0 in a message without fields"),
        pytest.param(framed(TREE, b"\x02\x00"), MALFORMED, id="field number 0 in a payload"),
        pytest.param(framed(TREE, b"\x9b\x06\x02\x00\x9c\x06"), case(TREE), id="field number 0 in an unknown group"),
        pytest.param(b"\x16", MALFORMED, id="wire type 6"),
        pytest.param(b"\x17", MALFORMED, id="wire type 7"),
        pytest.param(tag(TREE, VARINT) + b"\x01", Decision("malformed", TREE, False), id="a payload as a number"),
        pytest.param(
            tag(77, VARINT) + b"\x01" + tag(TREE, I32) + b"abcd" + bytes(4),
            Decision("malformed", TREE, True),
            id="a payload as a number, padded",
        ),
        pytest.param(
            tag(77, I64) + b"abcdefgh" + tag(78, VARINT) + b"\x01", Decision("unknown_case", 77, False), id="unknown"
        ),
        pytest.param(grouped(100), Decision("unknown_case", 99, False), id="unknown groups"),
        pytest.param(grouped(101), MALFORMED, id="too many unknown groups"),
        pytest.param(tag(99, GROUP), MALFORMED, id="a group without end"),
        pytest.param(tag(99, GROUP_END), MALFORMED, id="an end without group"),
        pytest.param(tag(99, GROUP) + tag(98, GROUP_END), MALFORMED, id="the end of another group"),
        pytest.param(framed(TREE, tag(2, GROUP) + tag(2, GROUP_END)), case(TREE), id="a group"),
        pytest.param(framed(TREE, tag(2, GROUP)) + tag(2, GROUP_END), MALFORMED, id="a group that ends outside"),
        pytest.param(framed(TREE, framed(2, b"\xff")), case(TREE), id="a group's field as a message"),
        pytest.param(framed(TREE, tag(1, GROUP) + tag(1, GROUP_END)), case(TREE), id="a message's field as a group"),
        pytest.param(framed(TREE, nested(100)), case(TREE), id="the deepest payload"),
        pytest.param(framed(TREE, nested(101)), MALFORMED, id="too deep a payload"),
        pytest.param(framed(UNROUTED_TREE, nested(99)), case(UNROUTED_TREE), id="deepest without a route"),
        pytest.param(framed(UNROUTED_TREE, nested(100)), MALFORMED, id="too deep without a route"),
        pytest.param(tag(3, VARINT) + b"\1" + framed(TREE, nested(99)), case(TREE), id="deepest beside a field"),
        pytest.param(tag(3, VARINT) + b"\1" + framed(TREE, nested(100)), MALFORMED, id="too deep beside a field"),
        pytest.param(framed(TREE, nested(100)) + b"\0", MALFORMED, id="too deep for a padded one"),
        pytest.param(framed(TREE, nested(99) + grouped(100)), case(TREE), id="both"),
        pytest.param(framed(TREE, b"") + framed(TEXTS, b""), case(TEXTS, superseded=1), id="the last case counts"),
        pytest.param(framed(TREE, b"") + BEAT, case(NUMBER, superseded=1), id="the last member counts, message or not"),
        pytest.param(BEAT + framed(TREE, b""), case(TREE, superseded=1), id="a message after a number"),
        pytest.param(framed(TREE, b"") + BEAT + framed(TREE, b""), case(TREE, superseded=2), id="a number between"),
        pytest.param(framed(NUMBER, b"\1"), Decision("unknown_case", NUMBER, False), id="a number as a message"),
        pytest.param(framed(TREE, b"") + framed(NUMBER, b"\1"), case(TREE), id="a number as a message, after one"),
        pytest.param(tag(26, GROUP) + tag(26, GROUP_END), case(26), id="a group as a member"),
        pytest.param(framed(23, b"\xff"), MALFORMED, id="text as a member"),
        pytest.param(framed(TREE, b"\x0a\x01") + framed(TEXTS, b""), MALFORMED, id="the others have to be sound"),
        pytest.param(framed(TREE, b"\x0a\x00") + framed(TREE, b""), case(TREE), id="a payload in pieces"),
        pytest.param(framed(7, b"") + framed(TREE, b"") + framed(6, b"x"), case(TREE), id="another oneof"),
        pytest.param(framed(6, b"\xff") + framed(TREE, b""), MALFORMED, id="text beside the payload"),
        pytest.param(framed(TEXTS, framed(1, b"\xed\xa0\x80")), MALFORMED, id="a surrogate"),
        pytest.param(framed(TEXTS, framed(2, b"\xed\xa0\x80")), case(TEXTS), id="text that nobody checks"),
        pytest.param(framed(OLD, framed(7, b"\xff")), case(OLD), id="text of proto2"),
        pytest.param(framed(MAPS, framed(1, framed(1, b"\xff"))), MALFORMED, id="text as a key"),
        pytest.param(framed(MAPS, framed(2, framed(2, framed(2, b"\xff")))), MALFORMED, id="text in a value"),
        pytest.param(framed(OLD, framed(13, framed(1, b"\xff"))), case(OLD), id="text of proto2 as a key"),
        pytest.param(framed(OLD, framed(9, tag(100, LEN) + b"\x01\x07")), MALFORMED, id="an extension"),
        pytest.param(framed(OLD, framed(9, tag(150, LEN) + b"\x01\x07")), case(OLD), id="no known extension"),
        pytest.param(framed(OLD, framed(6, varint(77) + varint(2**64 - 1))), case(OLD), id="values of no enum"),
        pytest.param(framed(SCALARS, framed(13, bytes(8))), case(SCALARS), id="packed"),
        pytest.param(framed(SCALARS, framed(13, bytes(7))), MALFORMED, id="a cut packed fixed32"),
        pytest.param(framed(SCALARS, framed(14, bytes(12))), MALFORMED, id="a cut packed sfixed64"),
        pytest.param(framed(SCALARS, framed(12, b"\x01\x80")), MALFORMED, id="a cut packed varint"),
        pytest.param(framed(SCALARS, framed(3, bytes(7))), case(SCALARS), id="bytes for a number"),
        pytest.param(b"\x18\x01" * (MAX_DATAGRAM // 2), Decision("no_payload", 0, False), id="the longest"),
        pytest.param(b"\x18\x01" * (MAX_DATAGRAM // 2) + b"\1", Decision("truncated", 0, False), id="too long"),
        pytest.param(b"\x18\x01" * (MAX_DATAGRAM // 2 - 1) + b"\x92\0", MALFORMED, id="no room for what is missing"),
    ],
)
def test_rules(sides: Mapping[str, Sides], data: bytes, decision: Decision) -> None:
    assert decided(sides["hard"], data) == decision


def test_a_frame_is_restored_up_to_the_longest_datagram(sides: Mapping[str, Sides]) -> None:
    def cut(size: int) -> bytes:
        """A payload of so many bytes: a field of zeros, which are left out."""
        return tag(TEXTS, LEN) + varint(size) + tag(4, LEN) + varint(size - 3)

    assert decided(sides["hard"], cut(MAX_DATAGRAM - 3)) == case(TEXTS, True)
    assert decided(sides["hard"], cut(MAX_DATAGRAM - 2)) == MALFORMED


def test_a_listener_without_repairs_takes_no_zeros(sides: Mapping[str, Sides]) -> None:
    assert decided(sides["hard"], framed(TREE, b"") + b"\0", repairs=False) == MALFORMED
    assert decided(sides["hard"], tag(TREE, LEN), repairs=False) == MALFORMED


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ("oneof payload { Case case = 1; Closed lid = 2; }", "lid is in the envelope's oneof, and is a closed enum"),
        ("oneof payload { Set set = 1; }", "Set is a message set"),
    ],
)
def test_what_it_cannot_decide_is_a_finding(tmp_path: Path, fields: str, complaint: str) -> None:
    (tmp_path / "old.proto").write_text(
        'syntax = "proto2"; message Set { option message_set_wire_format = true; extensions 4 to max; }'
    )
    (tmp_path / "envelope.proto").write_text(
        'edition = "2023"; import "old.proto"; message Case {} message Other { Set set = 1; } '
        "enum Closed { option features.enum_type = CLOSED; ZERO = 0; }\n"
        f"message PBEnvelope {{ {fields} }}"
    )
    table = tmp_path / "table.yaml"
    table.write_text(ONEOF_HEAD.removesuffix("routes:\n").replace("PROTOS", str(tmp_path)) + "routes: {}\n")
    [finding] = [each for each in check_table(table).diagnostics if each.code is Code.BAD_PROTO]
    assert complaint in finding.message
    assert finding.span.file.endswith(("envelope.proto", "old.proto"))


def test_what_is_beside_the_payload_is_known_whatever_it_holds(library: ctypes.CDLL, tmp_path: Path) -> None:
    """For protobuf, a number that a closed enum does not have is an unknown field, as is a map's entry with one."""
    (tmp_path / "envelope.proto").write_text(
        'edition = "2023"; message Case {} enum Closed { option features.enum_type = CLOSED; ZERO = 0; }\n'
        "message PBEnvelope { oneof payload { Case case = 1; } Closed closed = 2; repeated Closed all = 3;"
        " map<int32, Closed> map = 4; }"
    )
    routes = "  case: {source: any, destinations: [tool]}\n"
    side = CarrierSide(library, program(tmp_path, routes, ONEOF_HEAD, tmp_path))
    for beside in (b"\x10\x07", b"\x1a\x01\x07", framed(4, b"\x08\x01\x10\x07")):
        assert side.decide(beside, repairs=False) == Decision("no_payload", 0, False)
        assert side.decide(beside + framed(1, b""), repairs=False) == Decision(None, 1, False)
