"""Whatever a file holds, load_table answers with findings and never raises."""

from __future__ import annotations

import json
from pathlib import Path

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from router.errors import Diagnostic
from tests.table.tables import GATEWAY, GOOD, load

LINES = GOOD.splitlines(keepends=True)
WORDS = ["version", "extends", "envelope", "listen", "endpoints", "routes", "imu_info", "source", "topics", "fields"]
WORDS += ["qos", "depth", "auto", "ros", "any", "address", "kind", "ignore", "when", "max_rate", "<<", "no", "0777"]
WORDS += ["deadman", "timeout", "send", "to", "collect", "by", "for_each", "keep", "ttl", "budget", "latest", "1s"]
GATEWAY_WORDS = [
    "transport",
    "udp",
    "tcp",
    "websocket",
    "zenoh",
    "receive",
    "format",
    "json",
    "gateway_v1",
    "gateway_v2",
]
GATEWAY_WORDS += ["include", "exclude", "regex", "rates", "publish_period", "each", "compression", "zstd", "inbound"]
GATEWAY_WORDS += [
    "gateway_v2",
    "topics",
    "topic",
    "type",
    "deadman",
    "max_datagram",
    "127.0.0.1:8502",
    "key",
    "connect",
]

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


@quick
@given(st.dictionaries(st.sampled_from(WORDS), trees), st.sampled_from(WORDS))
def test_any_tree_in_the_place_of_a_part(tmp_path: Path, tree: dict[str, object], key: str) -> None:
    (tmp_path / "base.yaml").write_text(GOOD)
    tree.pop("extends", None)
    check(tmp_path, json.dumps({"extends": "base.yaml", **tree}))
    tree.pop("version", None)
    check(tmp_path, json.dumps({"extends": "base.yaml", "routes": {"imu_info": {**tree, key: tree}}}))


@quick
@given(st.integers(0, len(GOOD) - 1), st.integers(0, 5), fragments)
def test_any_change_of_a_good_table(tmp_path: Path, start: int, length: int, fragment: str) -> None:
    text = GOOD[:start] + fragment + GOOD[start + length :]
    check(tmp_path, text.encode("utf-8", "surrogatepass"))


gateway_trees = st.recursive(
    scalars | st.sampled_from(GATEWAY_WORDS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(GATEWAY_WORDS), inner, max_size=5),
    max_leaves=30,
)


@quick
@given(st.dictionaries(st.sampled_from(GATEWAY_WORDS), gateway_trees), st.sampled_from(GATEWAY_WORDS))
def test_any_tree_in_the_place_of_a_gateway(tmp_path: Path, tree: dict[str, object], key: str) -> None:
    (tmp_path / "base.yaml").write_text(f"{GOOD}gateways:\n{GATEWAY}")
    check(tmp_path, json.dumps({"extends": "base.yaml", "gateways": {"vr_headset": tree, "other": {key: tree}}}))
    transport = {"transport": {"tcp": "127.0.0.1:8600"}}
    check(tmp_path, json.dumps({"extends": "base.yaml", "gateways": {"other": {**tree, **transport}}}))


@quick
@given(st.integers(0, len(GATEWAY) - 1), st.integers(0, 5), fragments)
def test_any_change_of_a_good_gateway(tmp_path: Path, start: int, length: int, fragment: str) -> None:
    text = f"{GOOD}gateways:\n{GATEWAY[:start]}{fragment}{GATEWAY[start + length :]}"
    check(tmp_path, text.encode("utf-8", "surrogatepass"))


@quick
@given(st.integers(0, len(LINES) - 1), st.integers(0, len(LINES) - 1))
def test_any_two_lines_changed_over(tmp_path: Path, first: int, second: int) -> None:
    lines = list(LINES)
    lines[first], lines[second] = lines[second], lines[first]
    check(tmp_path, "".join(lines))


def test_any_line_left_out(tmp_path: Path) -> None:
    for index in range(len(LINES)):
        check(tmp_path, "".join(LINES[:index] + LINES[index + 1 :]))
