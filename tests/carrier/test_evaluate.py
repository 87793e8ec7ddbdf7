"""Each operation of the machine, against plain Python."""

from __future__ import annotations

import locale
import math
import shutil
import subprocess
from collections.abc import Callable
from ctypes import CDLL
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from tests.carrier.evaluating import (
    LIST,
    REAL,
    TEXT,
    C,
    Layout,
    Machine,
    Operation,
    Refusal,
    integer,
    load,
    real,
    text,
)

INT64, UINT64 = (-(1 << 63), (1 << 63) - 1), (0, (1 << 64) - 1)
EDGES = [0, 1, -1, 2, 7, -7, 1 << 53, (1 << 53) + 1, INT64[0], INT64[0] + 1, INT64[1], INT64[1] + 1, UINT64[1]]
DOUBLES = st.floats() | st.sampled_from([*map(float, EDGES), 0.5, -0.5, 1.8446744073709552e19, math.nan, math.inf])

Sided = tuple[int, bool]
"""An integer, and whether it is an unsigned one."""


def _sided(least: int = INT64[0], most: int = UINT64[1]) -> st.SearchStrategy[Sided]:
    def fits(value: int, is_unsigned: bool) -> bool:
        low, high = UINT64 if is_unsigned else INT64
        return max(low, least) <= value <= min(high, most)

    values = st.integers(least, most) | st.integers(-9, 9) | st.sampled_from(EDGES)
    return st.tuples(values, st.booleans()).filter(lambda made: fits(*made))


@pytest.fixture(scope="module")
def machine(evaluating: CDLL) -> Machine:
    made = Machine(evaluating)
    made.read(b"")
    return made


def _signs(*are_unsigned: bool, is_result: bool = False) -> int:
    names = ("FIRST_UNSIGNED", "SECOND_UNSIGNED", "THIRD_UNSIGNED")
    flags = sum(C[name] for name, is_unsigned in zip(names, are_unsigned, strict=False) if is_unsigned)
    return flags | (C["RESULT_UNSIGNED"] if is_result else 0)


def _unsigned(value: object, is_unsigned: bool) -> object:
    return value % (1 << 64) if is_unsigned and isinstance(value, int) else value


def _expected(exact: int | None, is_unsigned: bool) -> int | None:
    """None for a refusal."""
    low, high = UINT64 if is_unsigned else INT64
    return exact if exact is not None and low <= exact <= high else None


def _made(machine: Machine, is_unsigned: bool, *code: Operation) -> object:
    value = machine.value(*code)
    if isinstance(value, Refusal):
        assert value == Refusal("mapping_error", len(code) - 1)
        return None
    return _unsigned(value, is_unsigned)


# ---- integers


@pytest.mark.parametrize(
    ("name", "exact"),
    [
        ("OP_CHECKED_ADD", lambda a, b: a + b),
        ("OP_CHECKED_SUBTRACT", lambda a, b: a - b),
        ("OP_CHECKED_MULTIPLY", lambda a, b: a * b),
        ("OP_DIVIDE", lambda a, b: a // b if b else None),
        ("OP_MODULO", lambda a, b: a % b if b else None),
    ],
)
def test_integers_are_exact_or_refused(machine: Machine, name: str, exact: Callable[[int, int], int | None]) -> None:
    @given(_sided(), _sided(), st.booleans())
    @example((INT64[0], False), (-1, False), False)
    @example((INT64[0], False), (-1, False), True)
    @example((UINT64[1], True), (UINT64[1], True), True)
    @example((UINT64[1], True), (INT64[0], False), False)
    def same(a: Sided, b: Sided, is_unsigned: bool) -> None:
        operation = Operation(name, flag=_signs(a[1], b[1], is_result=is_unsigned))
        expected = _expected(exact(a[0], b[0]), is_unsigned)
        assert _made(machine, is_unsigned, integer(a[0]), integer(b[0]), operation) == expected

    same()


@given(_sided(), _sided())
def test_what_fits_needs_no_check(machine: Machine, a: Sided, b: Sided) -> None:
    plain = {"OP_ADD": a[0] + b[0], "OP_SUBTRACT": a[0] - b[0], "OP_MULTIPLY": a[0] * b[0]}
    for name, exact in plain.items():
        value = machine.value(integer(a[0]), integer(b[0]), Operation(name))
        assert isinstance(value, int)
        assert value % (1 << 64) == exact % (1 << 64)


@given(_sided(), st.booleans())
@example((INT64[0], False), False)
@example((INT64[0], False), True)
@example((1 << 63, True), False)
def test_signs_of_integers(machine: Machine, a: Sided, is_unsigned: bool) -> None:
    flag = _signs(a[1], is_result=is_unsigned)
    assert _made(machine, is_unsigned, integer(a[0]), Operation("OP_CHECKED_NEGATE", flag=flag)) == _expected(
        -a[0], is_unsigned
    )
    if not a[1]:
        assert _made(machine, True, integer(a[0]), Operation("OP_ABSOLUTE")) == abs(a[0])
        assert _unsigned(machine.value(integer(a[0]), Operation("OP_NEGATE")), True) == -a[0] % (1 << 64)


@given(_sided(), _sided(), _sided())
@example((5, False), (3, False), (2, False))
def test_least_greatest_and_bounds(machine: Machine, x: Sided, low: Sided, high: Sided) -> None:
    is_unsigned = x[1] and low[1] and high[1]
    two = [integer(x[0]), integer(low[0])]
    three, flag = [*two, integer(high[0])], _signs(x[1], low[1], high[1])

    def same(made: object, expected: int) -> bool:  # the compiler knows which sign the result has
        return isinstance(made, int) and made % (1 << 64) == expected % (1 << 64)

    flag_of_two = _signs(x[1], low[1])
    assert same(machine.value(*two, Operation("OP_LEAST", flag=flag_of_two)), min(x[0], low[0]))
    assert same(machine.value(*two, Operation("OP_GREATEST", flag=flag_of_two)), max(x[0], low[0]))
    clamped = low[0] if x[0] < low[0] else min(x[0], high[0])
    assert same(machine.value(*three, Operation("OP_CLAMP", flag=flag)), clamped)
    is_inside = low[0] <= x[0] <= high[0]
    assert _made(machine, x[1], *three, Operation("OP_FIT", flag=flag)) == (x[0] if is_inside else None)
    wrapped = low[0] + (x[0] - low[0]) % (high[0] - low[0] + 1) if low[0] <= high[0] else None
    flag = _signs(x[1], low[1], high[1], is_result=is_unsigned)
    assert _made(machine, is_unsigned, *three, Operation("OP_WRAP", flag=flag)) == _expected(wrapped, is_unsigned)


# ---- real numbers


def _alike(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    return type(a) is type(b) and a == b


def _in_python(function: Callable[..., object], *arguments: float) -> object:
    try:
        made = function(*arguments)
    except (ArithmeticError, ValueError):
        return None
    return None if isinstance(made, complex) else made


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("OP_REAL_FLOOR_DIVIDE", lambda a, b: a // b),
        ("OP_REAL_MODULO", lambda a, b: a % b),
        ("OP_REAL_POWER", lambda a, b: a**b),
        ("OP_REAL_DIVIDE", lambda a, b: a / b),
        ("OP_REAL_ADD", lambda a, b: a + b),
        ("OP_REAL_SUBTRACT", lambda a, b: a - b),
        ("OP_REAL_MULTIPLY", lambda a, b: a * b),
        ("OP_REAL_LEAST", min),
        ("OP_REAL_GREATEST", max),
        ("OP_ATAN2", math.atan2),
    ],
)
def test_two_real_numbers(machine: Machine, name: str, plain: Callable[..., float]) -> None:
    @given(DOUBLES, DOUBLES)
    @example(2.0, math.nan)
    @example(2.0, math.inf)
    @example(0.0, -1.0)
    @example(-8.0, 1 / 3)
    @example(1e308, 2.0)
    def same(a: float, b: float) -> None:
        made = machine.value(real(a), real(b), Operation(name), of=REAL)
        assert _alike(None if isinstance(made, Refusal) else made, _in_python(plain, a, b))

    same()


@given(DOUBLES, DOUBLES)
@example(1.7e308, 1.7e308)
def test_hypot_gives_infinity_for_what_is_too_large(machine: Machine, a: float, b: float) -> None:
    expected = math.hypot(a, b)
    made = machine.value(real(a), real(b), Operation("OP_HYPOT"), of=REAL)
    assert isinstance(made, float)
    assert _alike(made, expected) or math.isclose(made, expected, rel_tol=1e-15)


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("OP_SQRT", math.sqrt),
        ("OP_SIN", math.sin),
        ("OP_COS", math.cos),
        ("OP_TAN", math.tan),
        ("OP_REAL_NEGATE", lambda x: -x),
        ("OP_REAL_ABSOLUTE", abs),
    ],
)
def test_one_real_number(machine: Machine, name: str, plain: Callable[..., float]) -> None:
    @given(DOUBLES)
    def same(a: float) -> None:
        made = machine.value(real(a), Operation(name), of=REAL)
        assert _alike(None if isinstance(made, Refusal) else made, _in_python(plain, a))

    same()


@given(DOUBLES, DOUBLES, DOUBLES)
def test_real_clamp_lets_nan_through(machine: Machine, x: float, low: float, high: float) -> None:
    expected = low if x < low else min(x, high)
    made = machine.value(real(x), real(low), real(high), Operation("OP_REAL_CLAMP"), of=REAL)
    assert _alike(made, expected)


@pytest.mark.parametrize(
    ("name", "plain"),
    [("OP_ROUND", round), ("OP_TRUNCATE", math.trunc), ("OP_FLOOR", math.floor), ("OP_CEIL", math.ceil)],
)
def test_rounding_gives_an_integer_or_says_why_not(machine: Machine, name: str, plain: Callable[[float], int]) -> None:
    @given(DOUBLES)
    @example(-9.223372036854775808e18)
    @example(9.223372036854775808e18)
    @example(9.223372036854774784e18)
    @example(2.5)
    @example(-0.5)
    def same(x: float) -> None:
        made = machine.value(real(x), Operation(name))
        if not math.isfinite(x):
            assert made == Refusal("non_finite", 1)
        elif INT64[0] <= plain(x) <= INT64[1]:
            assert made == plain(x)
        else:
            assert made == Refusal("mapping_error", 1)

    same()


@given(DOUBLES)
@example(3.4028235677973366e38)
@example(math.nextafter(3.4028235677973366e38, 0))
def test_a_float32_is_finite(machine: Machine, x: float) -> None:
    made = machine.value(real(x), Operation("OP_FLOAT32"), of=REAL)
    is_refused = math.isfinite(x) and abs(Fraction(x)) >= Fraction((1 << 128) - (1 << 103))
    assert made == Refusal("mapping_error", 1) if is_refused else _alike(made, x)


@given(_sided())
def test_integers_as_real_numbers(machine: Machine, x: Sided) -> None:
    made = machine.value(integer(x[0]), Operation("OP_INTEGER_TO_REAL", flag=int(x[1])), of=REAL)
    assert made == float(x[0])


# ---- truth

_RELATIONS: dict[str, Callable[[object, object], bool]] = {
    "EQUAL": lambda a, b: a == b,
    "UNEQUAL": lambda a, b: a != b,
    "LESS": lambda a, b: a < b,  # type: ignore[operator]
    "LESS_OR_EQUAL": lambda a, b: a <= b,  # type: ignore[operator]
    "GREATER": lambda a, b: a > b,  # type: ignore[operator]
    "GREATER_OR_EQUAL": lambda a, b: a >= b,  # type: ignore[operator]
}


def _near(x: int) -> st.SearchStrategy[float]:
    """Real numbers about an integer, where rounding it would show."""
    return st.sampled_from([-1, 0, 1]).map(
        lambda by: math.nextafter(float(x), math.copysign(math.inf, by)) if by else float(x)
    )


@given(_sided(), st.data())
def test_integers_are_compared_with_anything_exactly(machine: Machine, a: Sided, data: st.DataObject) -> None:
    other = data.draw(_sided() | DOUBLES | _near(a[0]))
    if isinstance(other, float):
        b, types = real(other), "UNSIGNED_WITH_REAL" if a[1] else "SIGNED_WITH_REAL"
        value: int | float = other
    else:
        value, is_unsigned = other
        assume(is_unsigned or not a[1])
        b = integer(value)
        types = "UNSIGNED_INTEGERS" if a[1] else "SIGNED_WITH_UNSIGNED" if is_unsigned else "SIGNED_INTEGERS"
    for name, relation in _RELATIONS.items():
        operation = Operation("OP_COMPARE", C[types], flag=C[name])
        assert machine.condition(integer(a[0]), b, operation) == relation(a[0], value), name


@given(DOUBLES, DOUBLES, st.binary(max_size=5), st.binary(max_size=5))
@example(0.0, 0.0, b"ab", b"abc")
@example(0.0, -0.0, b"", b"")
def test_reals_and_texts_are_compared(machine: Machine, a: float, b: float, left: bytes, right: bytes) -> None:
    for name, relation in _RELATIONS.items():
        flag = C[name]
        reals = machine.condition(real(a), real(b), Operation("OP_COMPARE", C["REALS"], flag=flag))
        assert reals == relation(a, b)
        texts = machine.condition(text(left), text(right), Operation("OP_COMPARE", C["TEXTS"], flag=flag))
        assert texts == relation(left, right)


def test_decisions(machine: Machine) -> None:
    refuses = [integer(1), integer(0), Operation("OP_DIVIDE")]
    assert machine.condition(integer(0), Operation("OP_AND", size=3), *refuses) is False
    assert machine.condition(integer(1), Operation("OP_AND", size=3), *refuses) == Refusal("mapping_error", 4)
    assert machine.condition(integer(1), Operation("OP_OR", size=3), *refuses) is True
    assert machine.condition(integer(0), Operation("OP_OR", size=1), integer(1)) is True
    choice = [Operation("OP_UNLESS", size=2), integer(7), Operation("OP_JUMP", size=3), *refuses]
    assert machine.value(integer(1), *choice) == 7
    assert machine.value(integer(0), *choice) == Refusal("mapping_error", 6)
    assert machine.value(integer(0), integer(1), Operation("OP_EITHER")) == 1
    assert machine.value(integer(0), Operation("OP_NOT")) == 1
    assert machine.value(integer(3), Operation("OP_FIT_COUNT", number=3)) == 3
    assert machine.value(integer(2), Operation("OP_FIT_COUNT", number=3)) == Refusal("mapping_error", 1)
    assert machine.value(integer(2), Operation("OP_FIT_COUNT", flag=1, number=3)) == 2
    assert machine.value(integer(4), Operation("OP_FIT_COUNT", flag=1, number=3)) == Refusal("mapping_error", 1)
    assert machine.value(integer(4), integer(4), Operation("OP_SAME_COUNT")) == 4
    assert machine.value(integer(4), integer(5), Operation("OP_SAME_COUNT")) == Refusal("mapping_error", 2)
    assert machine.value(integer(5), Operation("OP_KEEP", 3), integer(6), Operation("OP_DROP"), load(3),
                         Operation("OP_SUBTRACT")) == 0  # fmt: skip


# ---- text


@given(_sided())
def test_integers_as_text(machine: Machine, x: Sided) -> None:
    assert machine.value(integer(x[0]), Operation("OP_DECIMAL", flag=int(x[1])), of=TEXT) == str(x[0]).encode()


@given(DOUBLES, st.integers(0, 17))
@example(0.5, 0)
@example(1.5, 0)
@example(2.675, 2)
@example(-0.001, 2)
@example(-1.7976931348623157e308, 17)
@example(5e-324, 17)
@example(0.1, 17)
@example(-math.nan, 3)
@example(-math.inf, 3)
def test_real_numbers_with_decimals(machine: Machine, x: float, decimals: int) -> None:
    made = machine.value(real(x), Operation("OP_DIGITS", decimals), of=TEXT)
    if math.isnan(x):
        assert made == b"nan"
    elif math.isinf(x):
        assert made == str(x).encode()
    else:
        assert isinstance(made, bytes)
        assert made == f"{x:.{decimals}f}".encode()
        assert abs(Fraction(made.decode()) - Fraction(x)) <= Fraction(1, 2 * 10**decimals)


def test_the_locale_does_not_matter_to_decimals(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = [shutil.which("localedef") or "false", "-i", "de_DE", "-f", "UTF-8", str(tmp_path / "de_DE.UTF-8")]
    if subprocess.run(made, capture_output=True, check=False).returncode:
        pytest.skip("needs localedef with the sources of locales")
    monkeypatch.setenv("LOCPATH", str(tmp_path))
    locale.setlocale(locale.LC_NUMERIC, "de_DE.UTF-8")
    try:
        assert locale.localeconv()["decimal_point"] == ","
        assert machine.value(real(1234.5), Operation("OP_DIGITS", 2), of=TEXT) == b"1234.50"
        assert machine.value(real(-1234.0), Operation("OP_DIGITS", 0), of=TEXT) == b"-1234"
    finally:
        locale.setlocale(locale.LC_NUMERIC, "C")


@given(st.text(max_size=9), st.text(max_size=9), st.binary(max_size=9))
def test_texts(machine: Machine, a: str, b: str, octets: bytes) -> None:
    both = [text(a.encode("utf-8", "ignore")), text(b.encode("utf-8", "ignore")), Operation("OP_JOIN")]
    joined = machine.value(*both, of=TEXT)
    assert isinstance(joined, bytes)
    assert machine.value(*both, Operation("OP_CHARACTERS")) == len(joined.decode())
    assert machine.value(*both, Operation("OP_SIZE")) == len(joined)
    assert machine.value(*both, Operation("OP_FIT_SIZE", number=len(joined)), of=TEXT) == joined
    if joined:
        too_small = Operation("OP_FIT_SIZE", number=len(joined) - 1)
        assert machine.value(*both, too_small) == Refusal("mapping_error", 3)
    try:
        octets.decode()
        expected: object = octets
    except UnicodeDecodeError:
        expected = Refusal("mapping_error", 1)
    assert machine.value(text(octets), Operation("OP_UTF8"), of=TEXT) == expected


def test_text_is_bounded(machine: Machine) -> None:
    doubled = [Operation("OP_KEEP", 9), load(9), Operation("OP_JOIN")]
    sixteen = b"0123456789abcdef"
    assert machine.value(text(sixteen), *doubled * 15, Operation("OP_SIZE")) == 16 << 15
    refusal = machine.value(text(sixteen), *doubled * 16, Operation("OP_SIZE"))
    assert refusal == Refusal("mapping_error", 48)


# ---- lists


def _listed(*values: int) -> list[Operation]:
    return [*map(integer, values), Operation("OP_LIST", size=len(values))]


IN_CELLS = C["IN_CELLS"]


def _each(slot: int, *body: Operation, keeps: bool = False) -> list[Operation]:
    """Execute `body` for each element of the list in `slot`, which is on the stack then. The list is used up."""
    next_ = Operation("OP_NEXT", slot, flag=IN_CELLS)
    inner = [next_, *body, Operation("OP_AGAIN")]
    return [load(slot), Operation("OP_SIZE"), Operation("OP_REPEAT", flag=int(keeps), size=len(inner)), *inner]


@given(st.lists(st.integers(*INT64), max_size=9), st.integers(0, 9))
def test_lists_of_values(machine: Machine, values: list[int], index: int) -> None:
    made = _listed(*values)
    assert machine.value(*made, of=LIST) == values
    assert machine.value(*made, Operation("OP_SIZE")) == len(values)
    element = machine.value(*made, Operation("OP_ELEMENT", flag=IN_CELLS, number=index))
    assert element == (values[index] if index < len(values) else Refusal("mapping_error", len(made)))


@given(st.lists(st.integers(-1000, 1000), max_size=9))
def test_sum_of_a_list(machine: Machine, values: list[int]) -> None:
    made = [*_listed(*values), Operation("OP_KEEP", 1), Operation("OP_DROP"), integer(0)]
    assert machine.value(*made, *_each(1, Operation("OP_CHECKED_ADD"))) == sum(values)


@given(st.lists(st.integers(-1000, 1000), max_size=9))
def test_a_list_made_element_by_element(machine: Machine, values: list[int]) -> None:
    keep = [
        Operation("OP_KEEP", 1),
        Operation("OP_DROP"),
        Operation("OP_LIST"),
        Operation("OP_KEEP", 2),
        Operation("OP_DROP"),
    ]
    double = [integer(2), Operation("OP_MULTIPLY"), Operation("OP_APPEND", 2)]
    assert machine.value(*_listed(*values), *keep, *_each(1, *double, keeps=True), load(2), of=LIST) == [
        2 * value for value in values
    ]


def test_loops_in_loops_and_what_they_take(machine: Machine) -> None:
    keep = [Operation("OP_KEEP", 1), Operation("OP_DROP")]
    add = [load(4), Operation("OP_ADD"), Operation("OP_KEEP", 4), Operation("OP_DROP")]
    body = [load(3), Operation("OP_MULTIPLY"), *add]
    inner = [*_listed(10, 20), Operation("OP_KEEP", 2), Operation("OP_DROP"), *_each(2, *body)]
    outer = _each(1, Operation("OP_KEEP", 3), Operation("OP_DROP"), *inner)
    start = [integer(0), Operation("OP_KEEP", 4), Operation("OP_DROP")]
    many = list(range(100))
    assert machine.value(*_listed(*many), *keep, *start, *outer, load(4)) == 30 * sum(many)


def test_cells_are_free_again_behind_a_turn_that_does_not_keep_them(machine: Machine) -> None:
    turn = [integer(1)] * 200 + [Operation("OP_LIST", size=200), Operation("OP_DROP"), Operation("OP_AGAIN")]
    times = 100_000  # 20 million cells, if they were kept: more than there may be
    for keeps, expected in ((False, 5), (True, Refusal("mapping_error", 203))):
        repeat = Operation("OP_REPEAT", flag=int(keeps), size=len(turn))
        assert machine.value(integer(5), integer(times), repeat, *turn) == expected


@given(st.lists(st.integers(-2, 300), max_size=9))
def test_octets_of_a_list(machine: Machine, values: list[int]) -> None:
    made = machine.value(*_listed(*values), Operation("OP_OCTETS", flag=IN_CELLS), of=TEXT)
    fits = all(0 <= value <= 255 for value in values)
    assert made == (bytes(values) if fits else Refusal("mapping_error", len(values) + 1))


@given(st.lists(st.integers(-(1 << 31), (1 << 31) - 1), unique=True, max_size=9), st.integers(*INT64))
def test_members(machine: Machine, values: list[int], other: int) -> None:
    data = b"".join(value.to_bytes(4, "little", signed=True) for value in sorted(values))
    for number in {*values, other}:
        made = machine.value(integer(number), Operation("OP_MEMBER", data=data, size=len(values)))
        assert made == (number if number in values else Refusal("mapping_error", 1))


def test_defaults_of_slots(evaluating: CDLL) -> None:
    machine = Machine(evaluating, Layout(defaults={2: 7, 3: 0.5, 4: b"text"}))
    machine.read(b"")
    assert machine.value(load(2)) == 7
    assert machine.value(load(3), of=REAL) == 0.5
    assert machine.value(load(4), of=TEXT) == b"text"
    assert machine.value(integer(1), Operation("OP_KEEP", 2)) == 1
    assert machine.value(load(2)) == 1
    machine.read(b"")
    assert machine.value(load(2)) == 7


def test_a_message_that_takes_too_much_work_is_refused(machine: Machine) -> None:
    """As a list that is gone through for each element of another one."""
    times = 1 << 13
    joined = [text(b"a" * 4096), text(b"b" * 4096), Operation("OP_JOIN"), Operation("OP_DROP")]
    for turn in ((), joined):
        inner = [integer(times), Operation("OP_REPEAT", size=len(turn) + 1), *turn, Operation("OP_AGAIN")]
        outer = [integer(times), Operation("OP_REPEAT", size=len(inner) + 1), *inner, Operation("OP_AGAIN")]
        machine.read(b"")
        assert machine.value(integer(5), integer(times), Operation("OP_REPEAT", size=1), Operation("OP_AGAIN")) == 5
        assert isinstance(machine.value(*outer), Refusal)
        assert isinstance(machine.value(*inner), Refusal)  # of another target
        machine.read(b"")
        assert machine.value(integer(5)) == 5


def test_a_message_that_gets_too_long_is_refused(machine: Machine) -> None:
    long = Operation("OP_KNOWN", slot=1, data=b"abcdefgh" * 512)
    for times, is_refused in ((1 << 10, False), (1 << 15, True)):
        machine.read(b"")
        made = machine.message(integer(times), Operation("OP_REPEAT", size=2), long, Operation("OP_AGAIN"))
        assert isinstance(made, Refusal) is is_refused
