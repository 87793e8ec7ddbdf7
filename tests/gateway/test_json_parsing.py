"""JSON text is read as the json module reads it, or refused: in one sentence, in bounded time, whatever it is."""

from __future__ import annotations

import contextlib
import json
import math
import tracemalloc
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from router.gateway.invalid import InvalidMessageError
from router.gateway.json_parsing import parse_json
from router.gateway.json_pieces import let_go
from tests.gateway.client_json import FORMS, written

PADDING = b" " * (1 << 16)
"""Behind a text, makes it long, so that it is read in pieces."""
MANY = b"1," * 100_000

BAD: dict[str, tuple[bytes, str]] = {
    "nothing": (b"", "no JSON: Expecting value (character 0)"),
    "space": (b" \n", "no JSON: Expecting value"),
    "a word": (b"nothing", "no JSON: Expecting value (character 0)"),
    "a byte order mark": (b"\xef\xbb\xbf{}", "no JSON: Expecting value (character 0)"),
    "no UTF-8": (b'{"a":"\xff"}', "no UTF-8 at byte 6"),
    "an encoded surrogate": (b'"\xed\xa0\x80"', "no UTF-8 at byte 1"),
    "half of a surrogate pair": (b'{"a":["x\\ud800y"]}', "a string has half of a surrogate pair"),
    "half of one in a name": (b'{"\\uDFFF":1}', "a string has half of a surrogate pair"),
    "an open string": (b'{"a":"b', "no JSON: Unterminated string starting at (character 5)"),
    "a control character": (b'"a\nb"', "no JSON: Invalid control character at (character 2)"),
    "an unknown escape": (b'"\\x41"', "no JSON: Invalid \\escape"),
    "an open list": (b"[1,2", "no JSON: Expecting ',' delimiter (character 4)"),
    "an open object": (b'{"a":1', "no JSON: Expecting ',' delimiter (character 6)"),
    "a name without a value": (b'{"a"}', "no JSON: Expecting ':' delimiter (character 4)"),
    "a name that is none": (b"{1:2}", "no JSON: Expecting property name enclosed in double quotes (character 1)"),
    "a comma at the end of a list": (b"[1,]", "no JSON: "),
    "a comma at the end of an object": (b'{"a":1,}', "no JSON: "),
    "a comma too many": (b"[1,,2]", "no JSON: Expecting value (character 3)"),
    "a comma alone": (b"[,]", "no JSON: Expecting value (character 1)"),
    "two values": (b"{} {}", "no JSON: Extra data (character 3)"),
    "a bracket too many": (b"[1]]", "no JSON: Extra data (character 3)"),
    "a bracket of the other kind": (b"[1}", "no JSON: "),
    "NaN": (b"[NaN]", "NaN is no JSON"),
    "an infinity": (b'{"a":[-Infinity]}', "-Infinity is no JSON"),
    "1e400": (b"1e400", "'1e400' is beyond what a double holds"),
    "-1E+309": (b"[-1E+309]", "'-1E+309' is beyond what a double holds"),
    "a fraction of 400 digits": (b"1" * 400 + b".5", "is beyond what a double holds"),
    "an integer of 26 digits": (b"1" * 26, "an integer has more than 25 digits"),
    "an integer of 5 MB": (b"1" * 5_000_000, "an integer has more than 25 digits"),
    "a hexadecimal number": (b"[0x10]", "no JSON: "),
    "a leading zero": (b"[01]", "no JSON: "),
    "a plus sign": (b"[+1]", "no JSON: Expecting value (character 1)"),
    "a point without digits": (b"[1.]", "no JSON: "),
    "a name twice": (b'{"a":{"b":1,"c":2,"b":3}}', "'b' is there twice"),
    "a name twice, escaped once": (b'{"a":1,"\\u0061":2}', "'a' is there twice"),
    "65 lists": (b"[" * 65 + b"]" * 65, "more than 64 deep (character 64)"),
    "65 objects": (b'{"a":' * 65 + b"1" + b"}" * 65, "more than 64 deep"),
    "65 of both": (b'[{"a":' * 32 + b"[1]" + b"}]" * 32, "more than 64 deep"),
    "66 of both": (b'[{"a":' * 33 + b"1" + b"}]" * 33, "more than 64 deep"),
    "65 behind a string": (b'["' + b"]" * 99 + b'",' + b"[" * 64 + b"]" * 65, "more than 64 deep"),
    "100,000 brackets": (b"[" * 100_000, "more than 64 deep (character 64)"),
    "100,000 braces": (b'{"a":' * 100_000, "more than 64 deep"),
    "too many lists": (b"[" + b"[]," * 120_000 + b"1]", "more than 100000 lists"),
    "too many texts": (b"[" + b'0,"",' * 400_001 + b"1]", "more than 400000 texts and names"),
    "too many texts with brackets": (b"[" + b'"]",' * 400_001 + b"1]", "more than 400000 texts and names"),
    "too many names": (b"{" + b",".join(b'"%d":0' % i for i in range(400_001)) + b"}", "more than 400000 texts"),
}
BAD_LISTS: dict[str, tuple[bytes, str]] = {
    "a comma at its end": (b"]", "no JSON: "),
    "a comma and space at its end": (b" ]", "no JSON: "),
    "no end": (b"1", "no JSON: Expecting "),
    "an end of an object": (b"1}", "no JSON: Expecting ',' delimiter"),
    "NaN in it": (b"NaN]", "NaN is no JSON"),
    "a large number in it": (b"1e0400]", "'1e0400' is beyond what a double holds"),
    "a large number of the other spelling in it": (b"-1E+400]", "'-1E+400' is beyond what a double holds"),
    "a long number in it": (b"1" * 400 + b".0]", "is beyond what a double holds"),
    "a long integer in it": (b"9" * 26 + b"]", "an integer has more than 25 digits"),
    "a very long integer in it": (b"9" * 100_000 + b"]", "an integer has more than 25 digits"),
    "an open string in it": (b'"]', "no JSON: Unterminated string starting at (character 200001)"),
    "a word in it": (b"nul]", "no JSON: "),
    "a colon in it": (b"1:2]", "no JSON: Expecting ',' delimiter"),
}


def refusal(text: bytes) -> str:
    with pytest.raises(InvalidMessageError) as caught:
        parse_json(text)
    return str(caught.value)


@pytest.mark.parametrize("name", BAD)
def test_bad_text_is_refused_in_one_sentence(name: str) -> None:
    text, expected = BAD[name]
    assert expected in refusal(text)
    assert len(refusal(text)) < 120
    long = refusal(text + PADDING)
    assert expected.partition(" (")[0] in long  # the padding may be what is blamed
    assert len(long) < 120


@pytest.mark.parametrize("name", BAD_LISTS)
def test_bad_list_of_many_numbers_is_refused(name: str) -> None:
    end, expected = BAD_LISTS[name]
    assert expected in refusal(b"[" + MANY + end)
    assert len(refusal(b'{"data":[' + MANY + end + b"}")) < 120


@pytest.mark.parametrize("padding", [b"", PADDING], ids=["short", "long"])
def test_what_is_just_allowed_is_read(padding: bytes) -> None:
    for text in (
        b"[" * 64 + b"]" * 64,
        b'[{"a":' * 32 + b"1" + b"}]" * 32,
        b"[" + b"[[1],{}]," * 100 + b'"[[[\\"{{{"]',
        b'{"a":' * 64 + b"1" + b"}" * 64,
        b'"' + b"[" * 1000 + b'"',
        b'"\\ud83d\\ude00 \\\\ud800"',
        b"9999999999999999999999999",
        b"-9999999999999999999999999",
        b"[1e308,-1e308,1e-400,1." + b"0" * 400 + b"]",
        b'[true,false,null,\t"",{},[ ],{ },[[]]]',
        b" \r\n\t1 ",
        '"\N{LINE SEPARATOR}\N{GRINNING FACE}"'.encode(),
    ):
        assert parse_json(text + padding) == json.loads(text)


_numbers = st.integers(-(10**20), 10**20) | st.floats(allow_nan=False, allow_infinity=False)
_texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
_trees: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | _numbers | _texts | st.lists(_numbers | st.booleans(), max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_texts, inner, max_size=4),
    max_leaves=20,
)


@given(_trees, st.sampled_from(FORMS))
def test_any_value_is_read_short_or_long(value: Any, form: dict[str, Any]) -> None:
    text = written(value, form)
    for read in (parse_json(text), parse_json(text + PADDING), parse_json(PADDING + text)):
        assert read == value
        assert repr(read) == repr(json.loads(text))  # which tells 1 from true and 1.0


@settings(max_examples=20)
@given(st.lists(_numbers | st.booleans(), min_size=1, max_size=20), st.sampled_from(FORMS), st.integers(0, 30))
def test_many_numbers_are_read_wherever_pieces_end(values: list[Any], form: dict[str, Any], shift: int) -> None:
    many = {"a" * shift: values * 3000, "b": [values * 10] * 20, "c": [{"x": value} for value in values] * 20}
    text = written(many, form)
    read = parse_json(text)
    assert repr(read) == repr(many)


@settings(max_examples=300)
@given(_trees, st.sampled_from(FORMS), st.data())
def test_damaged_text_is_refused_or_read_alike_short_and_long(value: Any, form: dict[str, Any], data: Any) -> None:
    text = bytearray(written(value, form))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        text[at : at + data.draw(st.integers(0, 2))] = data.draw(st.sampled_from(_DAMAGE))
    outcomes = []
    for form_of_it in (bytes(text), bytes(text) + PADDING):
        try:
            outcomes.append(repr(parse_json(form_of_it)))
        except InvalidMessageError:
            outcomes.append("refused")
    assert outcomes[0] == outcomes[1]
    if outcomes[0] != "refused":
        assert outcomes[0] == repr(json.loads(bytes(text)))


_DAMAGE = [b"", b"[", b"]", b"{", b"}", b'"', b",", b":", b"\\", b"\\u", b"e", b"e9999", b"-", b".", b"0", b"9" * 30,
           b"NaN", b"null", b"\xff", b"\xc3\xa9", b"\0", b"\\ud800", b" "]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        (b"[" + b"[]," * 60_000 + b"1]", 25),
        (b"[" + b'{"a":1},' * 30_000 + b"1]", 40),
        (b"[" + b"1e9," * 60_000 + b"1]", 15),
        (b"[" + b'"ab",' * 60_000 + b"1]", 20),
        (b"9" * 1_000_000, 3),
        (b"[" * 1_000_000, 3),
    ],
    ids=["lists", "objects", "numbers", "strings", "digits", "brackets"],
)
def test_memory_is_in_proportion_to_the_text(text: bytes, factor: int) -> None:
    tracemalloc.start()
    try:
        with contextlib.suppress(InvalidMessageError):
            parse_json(text)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < factor * len(text)


@pytest.mark.parametrize("shift", range(12))
def test_a_long_text_is_read_whole_wherever_pieces_end(shift: int) -> None:
    for part in ("\\ud83d\\ude00", "\\\\ud83d", "\\\\", '\\"', "\\u0041\\n", "[,]", "\N{GRINNING FACE}"):
        text = f'{{"a":["{"x" * shift}{part * 20_000}",1],"{part}{"y" * 10_000}":"{part}"}}'
        assert parse_json(text.encode()) == json.loads(text)
        for half in ("\\ud83d", "\\ude00", "\\ud83d\\ud83d\\ude00"):
            assert "half of a surrogate pair" in refusal(f'["{"x" * shift}{part * 20_000}{half}"]'.encode())
        for wrong in ('\\u12"', "\\", '\\u"', '\\x"', ""):
            assert "no JSON: " in refusal(f'["{"x" * shift}{part * 20_000}{wrong}]'.encode())


@pytest.mark.parametrize(
    "more", ['"[",', '"\\"]",', '"a,b",', "null,", '"",{},', '{"b":"]"},[2,3],', '"' + "x" * 9000 + '",']
)
def test_numbers_between_other_things_are_read(more: str) -> None:
    text = f'{{"a":[{f"0,1.5,{more}" * 10_000}0],"b":1}}'
    assert parse_json(text.encode()) == json.loads(text)


def test_what_is_let_go_is_empty() -> None:
    several = [[{"a": [1.5] * 20_000}] * 10_000, "x", 3]
    value = {"data": several, "more": 1}
    let_go(value)
    assert (several, value["more"]) == ([], 1)


def test_numbers_keep_their_kind() -> None:
    read = parse_json(b"[1,1.0,-0.0,true,1e2]")
    assert isinstance(read, list)
    assert [type(value) for value in read] == [int, float, float, bool, float]
    assert math.copysign(1, read[2]) == -1
