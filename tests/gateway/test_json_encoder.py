"""CDR bytes become the JSON of the existing gateway: generated code and the oracle agree on any type."""

from __future__ import annotations

import itertools
import json
import linecache
import math
import struct
import traceback
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from router.errors import MappingError
from router.gateway.json_codec import UnreadableError, encoder
from router.gateway.json_types import PLACEHOLDER, Style
from router.rehearsal.cdr import deserialize as parse
from router.rehearsal.cdr import serialize as cdr
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.ros import ros_interfaces
from tests.compiler.generated_types import values
from tests.compiler.reading import field_values, messages
from tests.oracles.reference_json import reference_value

MANY = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
FEW = settings(max_examples=3, suppress_health_check=list(HealthCheck))
STYLES = pytest.mark.parametrize("style", Style)
UINT8, NOTHING = Int(8, signed=False), MessageType("made/msg/Nothing")
HEADER = b"\0\1\0\0"


def message(**fields: Type) -> MessageType:
    return MessageType("made/msg/Made", tuple(Field(name, type_) for name, type_ in fields.items()))


def text(declared: MessageType, data: bytes, style: Style = Style.WRAPPED) -> str:
    return encoder(declared, style)(data).decode()


def shown(written: str) -> str:
    """The value of a text, in which the order of keys, -0.0 and the kind of each number can be seen."""
    return repr(json.loads(written))


def reference(declared: MessageType, value: Any, style: Style) -> str:
    return repr(reference_value(declared, value, is_wrapped=style is Style.WRAPPED))


def has_wide_text(declared: Type) -> bool:
    match declared:
        case MessageType():
            return any(has_wide_text(field.type) for field in declared.fields)
        case List():
            return has_wide_text(declared.element)
        case _:
            return isinstance(declared, String) and declared.wide


# what is well-formed


@STYLES
@MANY
@given(st.data())
def test_any_message_is_written_as_the_oracle_does(style: Style, data: st.DataObject) -> None:
    declared = data.draw(messages())
    value = field_values(data.draw(values(declared)), declared)
    serialized = cdr(declared, value, data.draw(st.sampled_from([0x00, 0xFF])))
    written = text(declared, serialized, style)
    assert shown(written) == reference(declared, value, style)
    assert text(declared, serialized + data.draw(st.binary(max_size=9)), style) == written


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(ros_interfaces().names()))
def test_type_of_the_distribution_is_written_as_the_oracle_does(name: str) -> None:
    declared = ros_interfaces().get(name)
    assert declared is not None

    @FEW
    @given(values(declared))
    def equal(drawn: object) -> None:
        value = field_values(drawn, declared)
        for style in Style:
            assert shown(text(declared, cdr(declared, value), style)) == reference(declared, value, style)

    equal()


ELEMENTS: dict[str, list[Any]] = {
    "bool": [True, False, True], "string": ["map", "odom"], "wstring": ["a", ""], NOTHING.name: [{}],
}  # fmt: skip


@pytest.mark.parametrize(
    "element",
    [Bool(), Int(8, signed=True), UINT8, Int(16, signed=True), Int(32, signed=False), Int(64, signed=True), Float(32),
     Float(64), String(), String(wide=True), NOTHING],
    ids=str,
)  # fmt: skip
def test_lists_of_any_length_are_whole(element: Type) -> None:
    for count in (0, 1, 2, 3, 63, 64, 65, 4095, 4096, 4097, 8193):
        listed = list(itertools.islice(itertools.cycle(ELEMENTS.get(str(element), [0, 1, 100, 7, 9])), count))
        for length in {None, count or None}:
            declared = message(first=UINT8, listed=List(element, length), last=Float(64))
            value: Any = {"first": 1, "listed": listed, "last": 0.5}
            assert shown(text(declared, cdr(declared, value))) == reference(declared, value, Style.WRAPPED)


@STYLES
def test_texts_of_any_length_are_whole(style: Style) -> None:
    declared = message(narrow=String(), wide=String(wide=True), after=UINT8)
    for length, letters in itertools.product([0, 1, 4095, 4096, 4097, 9000], ["a", "\0", "é😀", '"']):
        value: Any = {"narrow": letters * length, "wide": letters * length, "after": 1}
        assert shown(text(declared, cdr(declared, value), style)) == reference(declared, value, style)


def test_wrapped_is_the_existing_gateways_style() -> None:
    declared = message(x=Float(64), a=message(flag=Bool()), text=String(), wide=String(wide=True), few=List(UINT8))
    value: Any = {"x": 0.01, "a": {"flag": True}, "text": "hi", "wide": "hi", "few": [1, 2]}
    assert text(declared, cdr(declared, value)) == (
        '{"a":[{"flag":[true]}],"few":[1,2],"text":["hi"],"wide":[[104,105]],"x":[0.01]}'
    )


def test_plain_has_scalars_and_messages_bare() -> None:
    declared = message(x=Float(64), a=message(flag=Bool()), text=String(), wide=String(wide=True), few=List(UINT8))
    value: Any = {"x": 0.01, "a": {"flag": True}, "text": "hi", "wide": "hi", "few": [1, 2]}
    assert text(declared, cdr(declared, value), Style.PLAIN) == (
        '{"a":{"flag":true},"few":[1,2],"text":"hi","wide":"hi","x":0.01}'
    )


def test_message_without_fields_shows_its_one_byte() -> None:
    assert text(NOTHING, HEADER + b"\7") == f'{{"{PLACEHOLDER.name}":[7]}}'
    assert text(NOTHING, HEADER + b"\7", Style.PLAIN) == f'{{"{PLACEHOLDER.name}":7}}'


GOLDEN = Path(__file__).with_name("golden").joinpath("strings.txt").read_text(encoding="utf-8").split("\n")[:-1]


def test_golden_strings_have_their_text_or_are_refused() -> None:
    for line in GOLDEN:
        data, _, expected = line.partition(" ")
        string = bytes.fromhex(data) + b"\0"
        serialized = HEADER + struct.pack("<I", len(string)) + string
        if expected == "refused":
            with pytest.raises(UnreadableError):
                text(message(it=String()), serialized)
        else:
            assert json.loads(text(message(it=String()), serialized)) == {"it": [json.loads(expected)]}


DOUBLES = [
    line.split(" ") for line in Path(__file__).with_name("golden").joinpath("doubles.txt").read_text().splitlines()
]


def test_every_golden_number_has_its_value() -> None:
    assert len(DOUBLES) > 3000
    data = b"".join(struct.pack("<Q", int(bits, 16)) for bits, _ in DOUBLES)
    written = text(message(it=List(Float(64), len(DOUBLES))), HEADER + data)
    assert shown(written) == repr({"it": [json.loads(expected) for _, expected in DOUBLES]})


@given(st.lists(st.integers(0, (1 << 32) - 1), min_size=1, max_size=100))
def test_a_float32_is_the_double_of_the_same_value(bits: list[int]) -> None:
    data = struct.pack(f"<{len(bits)}I", *bits)
    values = [value if math.isfinite(value) else None for value in struct.unpack(f"<{len(bits)}f", data)]
    for declared in (message(it=List(Float(32))), message(it=List(Float(32), len(bits)))):
        length = b"" if declared.fields[0].type.length else struct.pack("<I", len(bits))  # type: ignore[union-attr]
        assert shown(text(declared, HEADER + length + data)) == repr({"it": values})
    assert shown(text(message(it=Float(32)), HEADER + data[:4])) == repr({"it": values[:1]})


def test_a_float32_of_one_tenth_is_no_tenth() -> None:
    data = HEADER + struct.pack("<ff", 0.1, math.nan)
    assert text(message(a=Float(32), b=Float(32)), data) == '{"a":[0.10000000149011612],"b":[null]}'


# what is not


@STYLES
@MANY
@given(st.data())
def test_damaged_bytes_are_written_or_refused_as_the_oracle_does(style: Style, data: st.DataObject) -> None:
    declared = data.draw(messages(depth=1))
    serialized = bytearray(cdr(declared, field_values(data.draw(values(declared)), declared)))
    for _ in range(data.draw(st.integers(0, 3))):
        place = data.draw(st.integers(0, len(serialized) - 1))
        damage = data.draw(st.sampled_from([b"\0", b"\xff", b"\xff\xff\xff\xff", b"\1\0\0\0"]) | st.binary(max_size=4))
        serialized[place : place + len(damage)] = damage
    compare(declared, bytes(serialized[: data.draw(st.none() | st.integers(0, len(serialized)))]), style)


@STYLES
@MANY
@given(st.data(), st.binary(max_size=200))
def test_noise_is_written_or_refused_as_the_oracle_does(style: Style, data: st.DataObject, noise: bytes) -> None:
    compare(data.draw(messages(depth=1)), HEADER + noise, style)


def without_placeholders(value: Any) -> Any:
    """With 0 for what a message without fields holds, which the oracle does not tell."""
    match value:
        case dict():
            zero = [0] if isinstance(value.get(PLACEHOLDER.name), list) else 0
            inside = {name: without_placeholders(each) for name, each in value.items()}
            return inside | {PLACEHOLDER.name: zero} if PLACEHOLDER.name in value else inside
        case list():
            return [without_placeholders(each) for each in value]
        case _:
            return value


def compare(declared: MessageType, data: bytes, style: Style) -> None:
    try:
        ours = repr(without_placeholders(json.loads(text(declared, data, style))))
    except UnreadableError:
        ours = None
    try:
        theirs = reference(declared, field_values(parse(declared, data), declared), style)
    except MappingError as error:
        if "without its NUL" in str(error):
            return  # which `parse` wants
        theirs = None
    except (ValueError, struct.error):
        theirs = None
    event("refused" if ours is None else "written")
    if theirs is None and style is Style.WRAPPED and has_wide_text(declared):
        return  # as a list of units, half a character is none too few
    assert ours == theirs


HOSTILE: dict[str, Type] = {
    "string": String(), "wstring": String(wide=True), "bytes": List(UINT8), "doubles": List(Float(64)),
    "bools": List(Bool()), "strings": List(String()), "empty messages": List(NOTHING),
    "messages that hold empty ones": List(message(many=List(NOTHING), one=NOTHING)),
    "messages of strings": List(message(name=String(), last=Float(64))),
}  # fmt: skip


@STYLES
@pytest.mark.parametrize("hostile", HOSTILE)
def test_length_beyond_the_end_is_refused_before_memory_is_taken_for_it(hostile: str, style: Style) -> None:
    write = encoder(message(hostile=HOSTILE[hostile], last=Float(32)), style)
    tracemalloc.start()
    try:
        for length in (0xFFFF_FFFF, 0x8000_0000, 100_000):
            with pytest.raises(UnreadableError):
                write(HEADER + struct.pack("<I", length) + bytes(1000))
        assert tracemalloc.get_traced_memory()[1] < 500_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("data", ["", "00", "0000000001", "00030000", "00070000", "1234"])
def test_other_representations_are_refused(data: str) -> None:
    with pytest.raises(UnreadableError, match=f"0x{data[:4]}"):
        text(message(number=UINT8), bytes.fromhex(data))


@pytest.mark.parametrize("string", [b"", b"\0", b"abc", b"abc\0", b"a\0c\0"])
def test_string_needs_no_nul_at_its_end(string: bytes) -> None:
    expected = string.removesuffix(b"\0").decode().replace("\0", "\\u0000")
    assert text(message(it=String()), HEADER + struct.pack("<I", len(string)) + string) == f'{{"it":["{expected}"]}}'


def test_half_a_wide_character_is_a_number_but_no_text() -> None:
    data = HEADER + struct.pack("<II", 1, 0xD800)
    assert text(message(it=String(wide=True)), data) == '{"it":[[55296]]}'
    with pytest.raises(UnreadableError):
        text(message(it=String(wide=True)), data, Style.PLAIN)


# the generated code


def test_fields_before_the_first_string_are_one_call() -> None:
    inner = message(x=Float(64), y=Float(32))
    encoder(message(first=Bool(), inner=inner, last=Int(8, signed=False), text=String()), Style.WRAPPED)
    assert "".join(linecache.getlines("<json of made/msg/Made>")).count(" = unpack(") == 1


def test_traceback_shows_the_generated_line() -> None:
    with pytest.raises(UnreadableError) as caught:
        text(message(number=Float(64)), HEADER + bytes(7))
    lines = "".join(traceback.format_exception(caught.value))
    assert 'File "<json of made/msg/Made>", line 7, in encode' in lines
    assert "v1, = unpack(cdr, at)" in lines


@STYLES
def test_text_that_is_not_utf8_is_quoted_with_what_to_do(style: Style) -> None:
    declared = MessageType("made/msg/Note", (Field("text", String()),))
    said = r"^the text 'caf\\xe9' is not UTF-8: correct its publisher$"
    with pytest.raises(UnreadableError, match=said):
        encoder(declared, style)(HEADER + b"\5\0\0\0caf\xe9\0")
