"""The `.msg` language: definitions as people write them, generated ones, and text that is none."""

from __future__ import annotations

import importlib.util
import string
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.msg import PRIMITIVES, MsgError, is_zero, parse_msg

U8 = Int(8, False)


def field(declaration: str) -> Field:
    (parsed,) = parse_msg("pkg", declaration).fields
    return parsed


@pytest.mark.parametrize(
    ("declaration", "declared"),
    [
        ("bool x", Bool()),
        ("byte x", U8),
        ("char x", U8),
        ("int8 x", Int(8, True)),
        ("uint64 x", Int(64, False)),
        ("float32 x", Float(32)),
        ("string x", String()),
        ("string<=10 x", String(10)),
        ("wstring<=10 x", String(10, wide=True)),
        ("uint8[] x", List(U8)),
        ("uint8[3] x", List(U8, length=3)),
        ("uint8[<=3] x", List(U8, bound=3)),
        ("string<=5[<=3] x", List(String(5), bound=3)),
        ("\tfloat64\t \tx  ", Float(64)),
    ],
)
def test_types(declaration: str, declared: Type) -> None:
    parsed = field(declaration)
    assert (parsed.name, parsed.type) == ("x", declared)


@pytest.mark.parametrize(
    ("declaration", "declared"), [("Motor x", "pkg/msg/Motor"), ("std_msgs/Header[2] x", "std_msgs/msg/Header[2]")]
)
def test_other_messages(declaration: str, declared: str) -> None:
    assert str(field(declaration).type) == declared


@pytest.mark.parametrize(
    ("declaration", "default"),
    [
        ("float64 w 1", 1.0),
        ("float64 w -0.0", -0.0),
        ("float64 w 0", None),
        ("int8 status -2 # STATUS_UNKNOWN", -2),
        ("uint8 mask 0xff", 255),
        ("bool on true", True),
        ("bool on False", None),
        ('string name "it\'s"', "it's"),
        (r"string name 'it\'s'", "it's"),
        ("string name unquoted text", "unquoted text"),
        ("string name ''", None),
        ("int32[3] a [1, 2, -3]", (1, 2, -3)),
        ("int32[<=3] a [7]", (7,)),
        ("int32[] a []", None),
        ("float32[2] a [0.0, 0]", None),
        ("string[] a ['x, y', \"z\", plain]", ("x, y", "z", "plain")),
    ],
)
def test_default_values(declaration: str, default: object) -> None:
    parsed = field(declaration).default
    assert (parsed, repr(parsed)) == (default, repr(default)), "-0.0 is not 0.0, True is not 1"


def test_constants_have_the_declared_type() -> None:
    text = "uint8 FIX=2\nint32 LOW = -1\nfloat32 PI=3.5\nbool ON=true\nstring NAME = 'a b'\nstring<=3 name\nbyte B=7\n"
    assert parse_msg("pkg", text).constants == {"FIX": 2, "LOW": -1, "PI": 3.5, "ON": True, "NAME": "a b", "B": 7}


def test_comments_belong_to_the_field_below_beside_or_above() -> None:
    text = (
        "# What the file is about.\n"
        "float32 a\n"
        "# All of b,\n"
        "# on two lines.\n"
        "float32 b  # m/s\n"
        "           # over ground\n"
        "\n"
        "# Of nothing.\n"
        "\n"
        "float32 c\n"
        "## About a constant.\n"
        "uint8 X=1  # x\n"
        "float32 d  ## doubled\n"
    )
    comments = {parsed.name: parsed.comment for parsed in parse_msg("pkg", text).fields}
    assert comments == {"a": "", "b": "All of b, on two lines. m/s over ground", "c": "", "d": "doubled"}


@pytest.mark.parametrize(
    ("text", "message", "place"),
    [
        ("float32", "no name after 'float32'", (1, 1, 8)),
        ("\n  float32 Speed", "'Speed' is not a valid field name; write it in lower case", (2, 11, 16)),
        ("float32 a__b", "'a__b' is not a valid field name; write it in lower case", (1, 9, 13)),
        ("float a", "'float' is not a type", (1, 1, 6)),
        ("uint8<=3 a", "'uint8<=3' is not a type; only strings have a bound", (1, 1, 9)),
        ("uint8[0] a", "'uint8[0]' is not a type", (1, 1, 9)),
        ("uint8[-1] a", "'uint8[-1]' is not a type", (1, 1, 10)),
        ("uint8[9999999999] a", "'uint8[9999999999]' is not a type", (1, 1, 18)),
        ("a/b/C x", "'a/b/C' is not a type", (1, 1, 6)),
        ("uint8 a\nuint8 a", "'a' is declared twice", (2, 7, 8)),
        ("uint8 A=1\nuint8 A=2", "'A' is declared twice", (2, 7, 8)),
        ("uint8 a=1", "'a' is not a valid constant name; write it in upper case", (1, 7, 8)),
        ("uint8[2] A=1", "a constant cannot be of type uint8[2]", (1, 1, 9)),
        ("Motor A=1", "a constant cannot be of type Motor", (1, 1, 6)),
        ("uint8 A=256", "256 is outside the range of uint8, 0 to 255", (1, 9, 12)),
        ("uint8 A=x", "'x' is not an integer", (1, 9, 10)),
        ("uint8 A=", "'' is not an integer", (1, 1, 2)),
        ("float32 a x", "'x' is not a number", (1, 11, 12)),
        ("bool a maybe", "'maybe' is neither true nor false", (1, 8, 13)),
        ("string<=2 a 'abc'", "'abc' is longer than 2 characters", (1, 13, 18)),
        ("string a 'a'b'", "a quote inside the string needs a backslash: a'b", (1, 10, 15)),
        ("uint8[2] a [1]", "the array has 2 elements, but its default has 1", (1, 12, 15)),
        ("uint8[<=1] a [1, 2]", "the list has at most 1 elements, but its default has 2", (1, 14, 20)),
        ("uint8[] a 1", "'1' is not a list; write [1, 2]", (1, 11, 12)),
        ("uint8[] a [1,,2]", "'[1,,2]' is not a list of uint8", (1, 11, 17)),
        ("Motor a 1", "a field of type pkg/Motor takes no default value", (1, 9, 10)),
    ],
)
def test_fault_has_message_and_place(text: str, message: str, place: tuple[int, int, int]) -> None:
    with pytest.raises(MsgError) as caught:
        parse_msg("pkg", text)
    error = caught.value
    assert (error.message, (error.line, error.column, error.end_column)) == (message, place)


@given(
    st.text(alphabet=st.one_of(st.sampled_from(" \t\n#=[]<>'\"\\,-.0123456789_/uint8stringfloabAB"), st.characters()))
)
@example("string<=99999999999999999999 x")
@example("int8 X=" + "9" * 5000)
@example("string[] a ['\\")
def test_any_text_is_a_definition_or_the_declared_error(text: str) -> None:
    try:
        parse_msg("pkg", text)
    except MsgError as fault:
        error = fault
    else:
        return
    assert 1 <= error.line <= len(text.splitlines())
    assert 1 <= error.column < error.end_column


names = st.from_regex(r"[a-z]([a-z0-9]|_[a-z0-9]){0,8}", fullmatch=True)
plain_text = st.text(alphabet=sorted(set(string.printable) - set("#='\"\\\t\n\r\x0b\x0c")), max_size=8)
lists = st.one_of(
    st.none(), st.just(List(U8)), st.builds(List, st.just(U8), length=st.integers(1, 4)),
    st.builds(List, st.just(U8), bound=st.integers(1, 4)),
)  # fmt: skip
"""Lists of any element."""


def values(type_: Type) -> st.SearchStrategy[object]:
    if isinstance(type_, Bool):
        return st.booleans()
    if isinstance(type_, Int):
        return st.integers(type_.low, type_.high)
    if isinstance(type_, Float):
        return st.floats(allow_nan=False)
    assert isinstance(type_, String)
    return plain_text.map(lambda text: text[: type_.bound])


def written(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(written, value))}]"
    return f'"{value}"' if isinstance(value, str) else str(value)


@st.composite
def declarations(draw: st.DrawFn, name: str) -> tuple[str, Field]:
    """A line of a `.msg` file and the field that it declares."""
    base = draw(st.sampled_from([*PRIMITIVES, "Motor", "std_msgs/Header"]))
    shape = draw(lists)
    element: Type = PRIMITIVES.get(base) or MessageType(f"{'pkg/' * ('/' not in base)}{base}".replace("/", "/msg/"))
    if isinstance(element, String):
        element = String(draw(st.none() | st.integers(1, 9)), element.wide)
    declared = replace(shape, element=element) if shape else element
    default = None if isinstance(element, MessageType) else draw(st.none() | values(element))
    if default is not None and shape is not None:
        low, high = (shape.length, shape.length) if shape.length else (0, shape.bound or 4)
        items = draw(st.lists(values(element), min_size=low or 0, max_size=high))
        default = tuple(item.strip() if isinstance(item, str) else item for item in items)
    spelled = base if isinstance(element, MessageType) else spelling(base, element)
    text = f"{spelled}{str(declared).removeprefix(str(element))} {name}" + (
        "" if default is None else f" {written(default)}"
    )
    return text, Field(name, declared, default=None if is_zero(default) else default)


def spelling(base: str, element: Type) -> str:
    return f"{base}<={element.bound}" if isinstance(element, String) and element.bound is not None else base


@st.composite
def definitions(draw: st.DrawFn) -> tuple[str, tuple[Field, ...]]:
    lines = [draw(declarations(name)) for name in draw(st.lists(names, unique=True, max_size=6))]
    return "\n".join(text for text, _ in lines), tuple(parsed for _, parsed in lines)


@given(definitions())
def test_generated_definition_parses_to_what_it_was_written_from(generated: tuple[str, tuple[Field, ...]]) -> None:
    text, expected = generated
    parsed = parse_msg("pkg", text).fields
    assert [(f.name, str(f.type), f.default) for f in parsed] == [(f.name, str(f.type), f.default) for f in expected]


@pytest.mark.skipif(importlib.util.find_spec("rosidl_adapter") is None, reason="ROS's own parser is not installed")
@given(definitions())
def test_parser_of_ros_reads_the_same(generated: tuple[str, tuple[Field, ...]]) -> None:
    from rosidl_adapter.parser import parse_message_string  # type: ignore[import-untyped,import-not-found,unused-ignore]

    text, _ = generated
    theirs = parse_message_string("pkg", "Generated", text)
    for ours, other in zip(parse_msg("pkg", text).fields, theirs.fields, strict=True):
        assert ours.name == other.name
        default = tuple(other.default_value) if isinstance(other.default_value, list) else other.default_value
        assert ours.default == (None if is_zero(default) else default)
        declared = ours.type
        size = (declared.length or declared.bound) if isinstance(declared, List) else None
        assert (isinstance(declared, List), size) == (other.type.is_array, other.type.array_size)
        element = declared.element if isinstance(declared, List) else declared
        assert isinstance(element, MessageType) == (not other.type.is_primitive_type())
        if isinstance(element, String):
            assert element == String(other.type.string_upper_bound, wide=other.type.type == "wstring")
