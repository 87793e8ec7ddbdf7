"""Whatever a file holds, load_table answers with findings and never raises."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from router.errors import Diagnostic
from router.table.schema import keys_of, table_schema
from tests.table.tables import GATEWAY, GOOD, load

WORDS = sorted({*re.findall(r"\b(\w+):", GOOD), "extends", "auto", "ros", "any", "<<", "no", "0777", "latest", "1s"})
GATEWAY_WORDS = sorted(
    {*re.findall(r"\b(\w+):", GATEWAY), "tcp", "websocket", "zenoh", "key", "connect", "json", "each"}
)

scalars = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from([*WORDS, "${X"])
)
trees = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(WORDS) | st.text(), inner, max_size=5),
    max_leaves=30,
)
fragments = st.text() | st.sampled_from(["\t", "{", "}", "[", "]", ":", "- ", "&a ", "*a", "!!x ", "${", "|", '"', "'"])

quick = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def check(folder: Path, text: str | bytes) -> list[Diagnostic]:
    table, findings = load(folder, text, {"X": "1"})
    assert table is not None or findings
    for finding in findings:
        assert finding.span.line >= 1
        assert finding.span.end_column >= finding.span.column >= 1
    return findings


@quick
@given(st.text() | st.binary())
@example("\ufeff\ufeff")
@example("%YAML 3.0\n---\n")
@example("\udc80".encode("utf-8", "surrogatepass"))
def test_any_text(tmp_path: Path, text: str | bytes) -> None:
    check(tmp_path, text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text)


@quick
@given(trees)
def test_any_tree(tmp_path: Path, tree: object) -> None:
    check(tmp_path, json.dumps(tree))


KEYS = sorted({key for part in table_schema()["definitions"].values() for key in keys_of(part)})


@pytest.mark.parametrize("key", KEYS)
def test_any_key_in_the_wrong_place(tmp_path: Path, key: str) -> None:
    assert check(tmp_path, json.dumps({key: None}))


@quick
@given(st.dictionaries(st.sampled_from(WORDS), trees), st.sampled_from(WORDS))
def test_any_tree_in_the_place_of_a_part(tmp_path: Path, tree: dict[str, object], key: str) -> None:
    (tmp_path / "base.yaml").write_text(GOOD)
    tree.pop("extends", None)
    check(tmp_path, json.dumps({"extends": "base.yaml", **tree}))
    tree.pop("version", None)
    check(tmp_path, json.dumps({"extends": "base.yaml", "routes": {"imu_info": {**tree, key: tree}}}))


WHOLE = f"{GOOD}gateways:\n{GATEWAY}"


@quick
@given(st.integers(0, len(WHOLE) - 1), st.integers(0, 5), fragments)
def test_any_change_of_a_good_table(tmp_path: Path, start: int, length: int, fragment: str) -> None:
    text = WHOLE[:start] + fragment + WHOLE[start + length :]
    check(tmp_path, text.encode("utf-8", "surrogatepass"))


gateway_trees = st.recursive(
    scalars | st.sampled_from(GATEWAY_WORDS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(GATEWAY_WORDS), inner, max_size=5),
    max_leaves=30,
)


@quick
@given(st.dictionaries(st.sampled_from(GATEWAY_WORDS), gateway_trees), st.sampled_from(GATEWAY_WORDS))
def test_any_tree_in_the_place_of_a_gateway(tmp_path: Path, tree: dict[str, object], key: str) -> None:
    (tmp_path / "base.yaml").write_text(WHOLE)
    check(tmp_path, json.dumps({"extends": "base.yaml", "gateways": {"vr_headset": tree, "other": {key: tree}}}))
    transport = {"transport": {"tcp": "127.0.0.1:8600"}}
    check(tmp_path, json.dumps({"extends": "base.yaml", "gateways": {"other": {**tree, **transport}}}))


def test_any_line_left_out(tmp_path: Path) -> None:
    lines = GOOD.splitlines(keepends=True)
    for index in range(len(lines)):
        check(tmp_path, "".join(lines[:index] + lines[index + 1 :]))
