"""What is filled beside a payload is what the protobuf library reads, and goes on after a reload."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from router import declared as c
from router.compiler import Checked, check_table
from router.compiler.compiled_table import Beside
from router.errors import Code, Diagnostic, Severity
from router.library import library
from router.rehearsal.rehearsal import Rehearsal, Sent

HERE = Path(__file__).parent
SECOND = 10**9
LATEST = (1 << 63) - 1
"""The last time (wall clock, ns) that the carrier can represent."""
TYPES = {
    **{f"{kind}{bits}": (bits, True) for kind in ("int", "sint", "sfixed") for bits in (32, 64)},
    **{f"{kind}{bits}": (bits, False) for kind in ("uint", "fixed") for bits in (32, 64)},
}
NUMBERS = "numbers: {" + ", ".join(f"{name}: sequence" for name in TYPES) + "}"
TIMES = (
    "around: {times: {stamp: now, seconds: now, milliseconds: 1e3 * now, microseconds: now * 1000000, "
    "nanoseconds: now * 1e9, half_seconds: now * 2, minutes: now / 60}, name: {text: left}}"
)
TABLE = """
version: 1
envelope: {protos: protos, message: Frame, oneof: payload}
listen: {rover: {address: "127.0.0.1:5000"}}
endpoints: {robot: {address: "127.0.0.2:8", kind: tool, set: {SET}}}
routes:
  drive: {source: {topic: stop, type: std_msgs/msg/Bool}, fields: {stop: data}, destinations: TO, ttl: 1s}
"""


def written(folder: Path, fields: str, to: str = "robot", options: str = "") -> Path:
    """A table whose router fills these fields. With nanopb's `options`, `robot` is a board."""
    protos, table = folder / "protos", folder / "table.yaml"
    protos.mkdir(exist_ok=True)
    copyfile(HERE / "protos" / "beside.proto", protos / "beside.proto")
    text = TABLE.replace("SET", fields).replace("TO", to)
    if options:
        (protos / "beside.options").write_text(options)
        text = text.replace("kind: tool", "kind: board")
    table.write_text(text)
    return table


def checked(folder: Path, fields: str, to: str = "robot", options: str = "") -> Checked:
    made = check_table(written(folder, fields, to, options), {})
    assert not made.has_errors, made.diagnostics
    return made


def error_of(table: Path) -> Diagnostic:
    """The only error of a table."""
    (error,) = [each for each in check_table(table, {}).diagnostics if each.severity is Severity.ERROR]
    return error


def beside_of(made: Checked) -> Beside:
    (subscription,) = made.routes[0].subscriptions
    (target,) = subscription.targets
    assert target.beside is not None
    return target.beside


def filled(made: Checked, number: int, wall: int) -> Any:
    """The envelope, from the protobuf library, of the message with this number, sent at this time."""
    beside, sequence = beside_of(made), ctypes.c_uint64(number - 1 & (1 << 64) - 1)
    fields = (c.BesideField * len(beside.changing))(*(c.BesideField(*each.members) for each in beside.changing))
    of = c.Beside(sequence=ctypes.addressof(sequence), fields=fields, count=len(fields))
    data = ctypes.create_string_buffer(beside.data, len(beside.data))
    library().beside_fill(ctypes.byref(of), data, wall)
    assert sequence.value == number
    assert made.envelopes is not None
    return made.envelopes.first.message_class.FromString(data.raw)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Checked:
    return checked(tmp_path_factory.mktemp("filling"), f"{NUMBERS}, {TIMES}")


@given(st.integers(0, (1 << 64) - 1))
@example((1 << 31) - 1)
@example(1 << 31)
@example(1 << 32)
@example((1 << 63) - 1)
@example(0)
def test_numbers_wrap_around_like_the_type_of_their_field(made: Checked, number: int) -> None:
    numbers = filled(made, number, 0).numbers
    for name, (bits, is_signed) in TYPES.items():
        wrapped = number & (1 << bits) - 1
        expected = wrapped - (1 << bits) if is_signed and wrapped >> bits - 1 else wrapped
        assert getattr(numbers, name) == expected, name


@given(st.integers(0, LATEST) | st.integers(1_700_000_000 * SECOND, 4_100_000_000 * SECOND))
@example(0)
@example(LATEST)
def test_times_have_the_unit_of_the_table(made: Checked, wall: int) -> None:
    around = filled(made, 1, wall).around
    times = around.times
    assert times.stamp.seconds * SECOND + times.stamp.nanos == wall
    assert 0 <= times.stamp.nanos < SECOND
    assert times.seconds == wall // SECOND & (1 << 32) - 1
    assert times.milliseconds == wall // 10**6
    assert times.microseconds == wall // 1000
    assert times.nanoseconds == wall
    assert times.minutes == wall // (60 * SECOND)
    assert times.half_seconds == pytest.approx(2 * wall / SECOND, rel=1e-15)
    assert around.name == "left"


OPTIONS = "Numbers.uint32 int_size:8\nNumbers.sint32 int_size:16\nAround.name max_size:8\n"


def test_a_number_wraps_around_where_the_firmware_stores_fewer_bits(tmp_path: Path) -> None:
    fields = "numbers: {uint32: sequence, sint32: sequence, int64: sequence}"
    numbers = filled(checked(tmp_path, fields, options=OPTIONS), 0x1FFFF, 0).numbers
    assert (numbers.uint32, numbers.sint32, numbers.int64) == (0xFF, -1, 0x1FFFF)


def test_a_constant_that_the_firmware_cannot_store_is_a_finding(tmp_path: Path) -> None:
    error = error_of(written(tmp_path, "numbers: {uint32: 256}", options=OPTIONS))
    what = "'robot' rejects this: numbers.uint32 is 256; the board takes 0 to 255"
    assert (error.code, error.message) == (Code.BOARD_PAYLOAD, what)


def test_a_required_field_inside_a_field_that_is_set_needs_a_value(tmp_path: Path) -> None:
    error = error_of(written(tmp_path, "around: {times: {seconds: now}}"))
    assert (error.code, error.message) == (Code.MISSING_KEY, "nothing fills 'stamp', which Times requires")


def sent(rehearsal: Rehearsal, made: Checked) -> list[Mapping[str, Any]]:
    """The numbers of what was sent since the last call."""
    assert made.envelopes is not None
    parse = made.envelopes.first.message_class.FromString
    frames: list[Any] = [parse(event.data) for event in rehearsal.events if isinstance(event, Sent)]
    rehearsal.events.clear()
    return [{field.name: value for field, value in frame.numbers.ListFields()} for frame in frames]


STOP = bytes((0, 1, 0, 0, 1))
"""A std_msgs/msg/Bool as CDR."""


def test_numbers_go_on_after_a_reload_and_what_is_held_has_the_fields_of_its_table(tmp_path: Path) -> None:
    to = "{endpoint: robot, max_rate: 1 Hz, on_limit: latest}"
    first = checked(tmp_path, "numbers: {uint32: sequence}", to)
    assert first.program is not None
    rehearsal = Rehearsal(first.program)
    rehearsal.ros("stop", STOP)
    rehearsal.ros("stop", STOP)
    assert sent(rehearsal, first) == [{"uint32": 1}]
    second = checked(tmp_path, "numbers: {uint64: sequence, int32: 7}, around: {name: {text: a}}", to)
    assert second.program is not None
    rehearsal.reload(second.program)
    assert sent(rehearsal, second) == [{"uint32": 2}]  # held by the earlier table
    rehearsal.ros("stop", STOP)
    assert sent(rehearsal, second) == [{"uint64": 3, "int32": 7}]
    rehearsal.restart()
    rehearsal.ros("stop", STOP)
    assert sent(rehearsal, second) == [{"uint64": 1, "int32": 7}]
