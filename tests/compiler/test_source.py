"""Generated code: the text that people read is the code that runs, and it blames the route table."""

from __future__ import annotations

import ast
import sys
import traceback

import pytest

from router.compiler import Checked, check_table
from router.compiler.lookup import Definitions
from router.compiler.source import Source
from router.errors import SourceSpan
from tests.compiler.compiling import Published
from tests.compiler.conftest import CheckText
from tests.oracles.python_engine import handlers
from tests.oracles.python_engine.handlers import remember
from tests.tables import ROUTES

SPAN = SourceSpan("table.yaml", 3, 5, 9)


def generated(checked: Checked) -> list[Source]:
    """The code of all routes of a table."""
    assert checked.program is not None
    remember(checked)
    return [handlers.generated(checked.program, handler).source for handler in checked.program.routes]


@pytest.mark.parametrize("table", ["rover", "sim", "legacy"])
def test_text_is_the_code_that_runs(definitions: Definitions, table: str) -> None:
    for out in generated(check_table(ROUTES / f"{table}.yaml", {}, definitions)):
        # unparsed, because a literal -1 is one node in the tree and two in parsed text
        assert ast.unparse(ast.parse(out.text())) == ast.unparse(out.tree())


@pytest.mark.parametrize("table", ["rover", "sim", "legacy"])
def test_every_node_stands_somewhere_in_the_table(definitions: Definitions, table: str) -> None:
    checked = check_table(ROUTES / f"{table}.yaml", {}, definitions)
    assert checked.table is not None
    lines = max(len(path.read_text(encoding="utf-8").splitlines()) for path in checked.table.files)
    for out in generated(checked):
        for node in ast.walk(out.tree()):
            if isinstance(node, (ast.expr, ast.stmt)):
                assert 1 <= node.lineno <= lines
                assert node.end_col_offset is not None
                assert 0 <= node.col_offset < node.end_col_offset


def test_values_enter_by_name_and_names_are_never_used_twice() -> None:
    out = Source()
    assert [out.constant("known", value) for value in (b"a", b"b", b"a")] == ["known", "known_2", "known_3"]
    assert out.constants == {"known": b"a", "known_2": b"b", "known_3": b"a"}


def test_expression_inside_a_line_is_put_in_brackets_where_it_needs_them() -> None:
    out = Source()
    both = ast.parse("a or b", mode="eval").body
    out.line(f"if not {out.expression(both)}:", SPAN)
    with out.indented():
        out.line(f"{out.expression(both)},", SPAN)
    assert out.text() == "if not (a or b):\n    a or b,\n"


# run-time failures


ROUTE = """
routes:
  imu_info:
    source: board
    topics:
      - topic: out
"""
FAILING = {
    "division by zero in a field": (
        ["type: geometry_msgs/msg/Vector3", "fields:", "  x: accel_x", "  y: 1 + accel_x / gyro_x"],
        "accel_x / gyro_x",
        ZeroDivisionError,
    ),
    "division by zero in a when": (
        ["type: geometry_msgs/msg/Vector3", "fields: {x: accel_x}", "when: 1 / gyro_x > 2"],
        "1 / gyro_x",
        ZeroDivisionError,
    ),
    "a number that the field cannot hold": (
        ["type: std_msgs/msg/UInt8", "fields: {data: round(mag_x * 1000)}"],
        "round(mag_x * 1000)",
        Exception,
    ),
    "an expression behind non-ASCII text": (
        [
            "type: std_msgs/msg/Header",
            """fields: {frame_id: "'é€'", stamp: time_from_seconds(accel_x / gyro_x)}  # Größe""",
        ],
        "accel_x / gyro_x",
        ZeroDivisionError,
    ),
    "non-ASCII text in the expression": (
        ["type: std_msgs/msg/String", """fields: {data: "'é€' + text(accel_x / gyro_x, 1)"}"""],
        "accel_x / gyro_x",
        ZeroDivisionError,
    ),
}
"""The topic, of which the last line fails; the part that is blamed; the error."""


@pytest.mark.parametrize("name", FAILING)
def test_traceback_points_into_the_table(name: str, check_text: CheckText) -> None:
    topic, blamed, kind = FAILING[name]
    line = topic[-1].strip()
    program = check_text(ROUTE + "".join(f"        {part}\n" for part in topic)).program
    assert program is not None
    ((handler,),) = program.inbound.values()
    serve = Published(program, handler)
    assert serve(handler.case.message_class(accel_x=1.0, mag_x=1e6)) == {}
    (report,) = serve.reports
    assert isinstance(report.error, kind)

    text = (program.table.path).read_text(encoding="utf-8").splitlines()
    number = 1 + next(index for index, candidate in enumerate(text) if line in candidate)
    frame = next(entry for entry in traceback.extract_tb(report.error.__traceback__) if entry.filename == "table.yaml")
    assert frame.lineno == number
    assert frame.line == line
    assert frame.name == "route_imu_info"
    shown = "".join(traceback.format_exception(report.error)).splitlines()
    place = shown.index(f'  File "table.yaml", line {number}, in route_imu_info')
    assert shown[place + 1] == f"    {line}"
    if sys.version_info >= (3, 11):
        indent = shown[place + 1].index(blamed)
        carets = shown[place + 2]
        assert carets.strip("~^") == " " * indent
        assert len(carets) == indent + len(blamed)
