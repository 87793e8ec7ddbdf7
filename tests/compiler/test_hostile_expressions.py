"""Whatever stands in a table: the check of an expression ends in a kind or a finding, and never runs it."""

from __future__ import annotations

import warnings
from bisect import bisect_left
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from router.compiler.expressions import DEEPEST, ExpressionError
from router.errors import Code
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String
from tests.compiler.compiling import compiled, scope_of
from tests.compiler.machine import FAILURES

MODE = Enum("Mode", (("OFF", 0), ("ON", 1)))
INNER = MessageType("Inner", (Field("x", Float(32)),))
SOURCE = MessageType(
    "Source",
    fields=(
        Field("a", Int(32, True)), Field("f", Float(64)), Field("flag", Bool()), Field("name", String()),
        Field("mode", MODE), Field("numbers", List(Int(8, False))), Field("inner", INNER, has_presence=True),
        Field("many", List(INNER)), Field("data", Bytes()), Field("three", List(Float(32), 3)),
        Field("from", Int(64, False)), Field("in", Int(64, True)),
    ),
)  # fmt: skip

FORBIDDEN = [
    "__import__('os').system('true')", "().__class__", "a.__class__", "''.join([name])", "name.upper()",
    "(lambda: a)()", "lambda: a", "[x for x in numbers]", "{a}", "{a: a}", "(a, a)", "(x for x in numbers)",
    "(y := a)", "f'{a}'", "f''", "a if flag else (yield)", "await a", "[*numbers]", "a @ a", "a << 2", "a & 1",
    "a | 1", "a ^ 1", "~a", "a is a", "a is not a", "numbers[a]", "numbers[-1]", "numbers[0:1]", "numbers[:]",
    "numbers[True]", "None", "...", "1j", "b'x'", "9**9**9", "a ** a", "a ** -1", "a ** 0.5", "a ** 9", "a.real",
    "mode.value",
]  # fmt: skip
OTHERS = [
    "", " ", "\t", "#", "a # comment", "a;a", "a\na", "a = 1", "import os", "del a", "print(a)", "exec('1')",
    "eval(name)", "open('/etc/passwd')", "getattr(a, 'x')", "globals()", "a(", "a)", "(a", "[a", "'unterminated",
    "\"", "'''", "a +", "+", "a b", "1_000_000", "1__0", "0777", "0x", "1e999", "-1e999", "1e308 * 10",
    "1e999 - 1e999", "1 / 0", "1 // 0.0", "1 % 0", "a / 0", "a // (a * 0)", "a % (a * 0)", "(1 << 9)", "\x00",
    "a\x00", "'\x00'", "'\ud800'", "\ud800", "\xe9", "\xaa", "\U0001d41a", "a\u0660", "\u200ba", "\ufeffa",
    "a\xa0+ a", "\x0ca", "\\", "a \\\n + a", "$a", "a?b:c", "a && flag", "!flag", "a++", "a.b.c.d", "inner.y",
    "inner.x.y", "inner.x()", "name[0].x", "*a", "inner()", "mode()", "Mode", "Mode.", "Mode.NONE", "Mode.ON.OFF",
    "Mode.ON()", "message.a.b", "message.message", "source.a", "received_at.sec", "received_at + 1", "-received_at",
    "seconds(a)", "seconds()", "seconds(received_at, 1)", "round(x=1)", "round(*numbers)", "round(1, 2)", "has()",
    "has(a)", "has(1)", "has('a')", "has(inner, inner)", "has(Mode.ON)", "has(source)", "has(message)",
    "has(inner.x)", "has(many[0])", "has(many[0].x)", "has(nothing)", "has(message.nothing)", "has", "abs", "abs.x",
    "nothing", "clamp(a)", "clamp(a, 5, 4)", "wrap(a, 5, 4)", "clamp(a, 1)", "min()", "min(1)", "max(1, 'a')",
    "min(flag, 1)", "[]", "[[]]", "[1, 'a']", "[[1], [2.5]][0][0]", "[][0]", "[1][1]", "[1][10**6]", "a in []",
    "a in a", "a in name", "'a' in name", "flag < flag", "a < 'a'", "a == name", "inner == inner",
    "numbers == numbers", "not a", "a and flag", "flag or a", "a if a else a", "a if flag else name",
    "inner if flag else inner", "inner + inner", "name * 2", "2 * name", "'%s' % a", "-name", "-flag", "-inner",
    "str(inner)", "len(a)", "len(inner)", "float(a)", "int(f)", "int('1')", "True + 1", "1 if True else", "if a: a",
    "for", "class", "def f(): pass", "async", "match", "_", "__debug__", "__builtins__", "_expression_0_", "m", "m.a",
    "v", "counts", "data", "fit(a, 1, 2)", "print", "FAILURES", "((((10**8)**8)**8)**8)**8", "(a**8)**8",
    "((f**8)**8)**8",
]  # fmt: skip
LARGE = [
    "9" * 400, "9" * 5000, "9" * 100_000, "1" + "0" * 309 + ".0", "0." + "0" * 10_000 + "1", "'" + "x" * 100_000 + "'",
    "(" * 50 + "a" + ")" * 50, "(" * 5000 + "a" + ")" * 5000, "[" * 500 + "]" * 500, "-" * 5000 + "a",
    "not " * 5000 + "flag",
    " + ".join(["a"] * 5000), " and ".join(["flag"] * 1000), " < ".join(["a"] * 1000), "a if flag else " * 5000 + "a",
    "abs(" * 90 + "a" + ")" * 90, "a" + ".b" * 5000, "many" + "[0]" * 5000, "[" + "a, " * 2_000 + "]", "a" * 100_000,
    "min(" + ", ".join(["a"] * 300) + ")", "'" + "\\" * 9999, " * ".join(["a"] * 50), "\n" * 5000 + "a",
    " " * 100_000 + "a",
]  # fmt: skip


def check_ends_well(text: str) -> ExpressionError | None:
    """The finding, or None for an expression that is well-formed; then it has a kind."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a table says what is wrong with it in findings alone
        try:
            node, _ = compiled(text, scope_of(SOURCE, [MODE]))
        except ExpressionError as error:
            return error
        assert str(node.kind)
        return None


def test_forbidden_syntax_is_named_as_such() -> None:
    for text in FORBIDDEN:
        error = check_ends_well(text)
        assert error is not None, text
        assert error.diagnostic.code is Code.FORBIDDEN_EXPRESSION, text
        assert "\n" not in str(error.diagnostic)


def test_odd_text_ends_in_a_kind_or_a_finding() -> None:
    for text in OTHERS:
        check_ends_well(text)


@pytest.mark.parametrize("text", LARGE, ids=[f"{text[:12]}-{len(text)}" for text in LARGE])
def test_large_text_ends_in_a_kind_or_a_finding(text: str) -> None:
    check_ends_well(text)


def test_deepest_expression_that_is_accepted_compiles() -> None:
    shapes = ["abs({})", "({} + a)", "({} if flag else a)", "[{}, a][0]", "min(a, {})", "-{}"]
    for shape in shapes:
        texts = ["a"]
        while len(texts) <= DEEPEST:
            texts.append(shape.format(texts[-1]))
        deepest = bisect_left(texts, True, key=lambda text: check_ends_well(text) is not None)
        assert deepest > 5, shape


_TOKENS = st.sampled_from(
    [
        "a", "f", "flag", "name", "mode", "numbers", "inner", "many", "Mode", "ON", "x", "message", "source",
        "received_at", "has", "abs", "clamp", "wrap", "round", "str", "int", "len", "min", "0", "1", "2", "-1", "0.5",
        "'a'", "''", "True", "None", "(", ")", "[", "]", ",", ".", "+", "-", "*", "/", "//", "%", "**", "<", "<=", "==",
        "!=", "in", "not", "and", "or", "if", "else", "is", "lambda", ":", ":=", "{", "}", "@", "~", "=", "seconds",
        "time_from_seconds", "float32", "nan", "inf", "sum", "max", "text", "data", "three", "from", "message.in",
    ]
)  # fmt: skip


@settings(max_examples=5 * settings().max_examples)
@given(st.lists(_TOKENS, max_size=14).map(" ".join) | st.text(max_size=60))
def test_any_tokens_and_any_text_end_in_a_kind_or_a_finding(text: str) -> None:
    check_ends_well(text)


@given(
    st.sampled_from(FORBIDDEN + OTHERS),
    st.sampled_from(
        ["abs({})", "[{}]", "({}) + 1", "({}) * numbers", "[1, {}] * three", "sum({})", "1 if {} else 2", "{} < 1"]
    ),
)
def test_odd_text_inside_others_ends_in_a_kind_or_a_finding(text: str, around: str) -> None:
    check_ends_well(around.format(text))


def test_what_is_well_formed_fails_only_in_ways_that_are_counted() -> None:
    message = SimpleNamespace(a=0, f=1e308, flag=True, name="", mode=0, numbers=[], inner=None, many=[])
    for text in ["1 / a", "f ** 8", "numbers[0]", "round(f * 10)", "sqrt(-1)", "1 % a", "float32(f)",
                 "(round(f) ** 8) / 2", "many[3].x", "time_from_seconds(f * f)"]:  # fmt: skip
        _, run = compiled(text, scope_of(SOURCE, [MODE]))
        with pytest.raises(FAILURES):
            run(message)
