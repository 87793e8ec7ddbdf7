"""What the Zenoh library says of a `config`: blamed on the right place, and without the values that may be secret."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from router.compiler.zenoh_config import config_findings, reason
from router.errors import SourceSpan
from router.table.model.gateways import ZenohConfig

SECRET = "fjord-4711"  # noqa: S105 - of nobody
HERE = SourceSpan("routes/rover.yaml", 5)


def mapping(value: Any) -> ZenohConfig:
    """Its places have for columns the length of their paths."""
    return ZenohConfig(HERE, json.dumps(value), spans={path: SourceSpan("t", 9, len(path)) for path in _paths(value)})


def _paths(value: Any, here: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    members = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for step, member in members for path in ((*here, step), *_paths(member, (*here, step)))]


def login(**values: object) -> dict[str, Any]:
    return {"transport": {"auth": {"usrpwd": values}}}


@pytest.mark.parametrize(
    "value",
    [
        {},
        login(user="me", password=SECRET),
        {"scouting": {"multicast": {"enabled": True}}, "connect": {"timeout_ms": {"peer": 100}}},
        {"transport": {"link": {"tls": {"root_ca_certificate": "/nowhere.pem"}}}},
    ],
)
def test_what_the_library_takes_has_no_finding(value: object) -> None:
    assert list(config_findings(mapping(value))) == []


@pytest.mark.parametrize(
    ("value", "depth", "what"),
    [
        (login(user="me", password=4711), 4, "invalid type: integer, expected a string"),
        (login(user="me", password=[SECRET]), 4, "invalid type: sequence, expected a string"),
        ({"transport": {"auth": {"usrpwd": SECRET}}}, 3, "invalid type: string, expected struct UsrPwdConf"),
        ({"transport": {"link": {"tx": {"lease": {}}}}}, 4, "error parsing number"),
        ({"qos": {"publication": [{"key_exprs": [1]}, {"key_exprs": [2]}]}}, 5, "invalid type: integer, expected"),
        (login(user="me"), 4, "contradict each other"),
        (login(user="me", word=SECRET), 4, "unknown key 'word'"),
        ({"access_control": {"rules": [{"id": "a", "permission": "allow"}]}}, 3, "missing field `key_exprs`"),
        ({"id": "not a number"}, 1, "Invalid id"),
        ({"mode": "peer"}, 1, "'mode' is not allowed in the 'config' of a gateway"),
    ],
)
def test_what_it_refuses_is_blamed_on_the_innermost_place_without_its_value(value: Any, depth: int, what: str) -> None:
    [finding] = config_findings(mapping(value))
    assert (finding.span.line, finding.span.column) == (9, depth)
    assert what in finding.message
    assert SECRET not in str(finding)
    assert "4711" not in str(finding)


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.json5", f'{{a: "{SECRET}" b}}', "line 1, column "),
        ("a.json5", f'{{transport: {{auth: {{usrpwd: "{SECRET}"}}}}}}', "line 1, column 29: invalid type: string"),
        ("a.yaml", f"transport:\n  auth:\n    usrpwd: {SECRET}\n", "invalid type: string"),
        ("a.yaml", f"transport:\n\tpassword: {SECRET}\n", "line 2, column 1: found character"),
        ("a.yaml", f"transport: {{auth: {{usrpwd: {{password: {SECRET}}}}}}}\n", "contradict each other"),
        ("a.json5", f'{{transport: {{auth: {{usrpwd: {{password: "{SECRET}"}}}}}}}}', "contradict each other"),
        ("a.json5", "", "Empty config file"),
        ("a.conf", "{}", "Unsupported file type"),
    ],
)
def test_a_file_that_it_refuses_is_blamed_on_the_line_that_names_it(
    tmp_path: Path, name: str, text: str, what: str
) -> None:
    path = tmp_path / name
    path.write_text(text)
    [finding] = config_findings(ZenohConfig(HERE, text, path))
    assert finding.span == HERE
    assert finding.message.startswith(f"Zenoh rejects '{name}': ")
    assert what in finding.message
    assert SECRET not in str(finding)


def test_a_file_has_none_of_the_keys_that_the_table_has(tmp_path: Path) -> None:
    path = tmp_path / "a.json5"
    path.write_text('{mode: "router", listen: {endpoints: ["tcp/127.0.0.1:7447"]}, connect: {endpoints: []}}')
    findings = [finding.message for finding in config_findings(ZenohConfig(HERE, "", path))]
    assert findings == [
        f"'{key}' in 'a.json5' is not allowed in the 'config' of a gateway" for key in ("mode", "listen/endpoints")
    ]


def test_the_places_in_the_source_of_the_library_are_not_told() -> None:
    with pytest.raises(zenoh.ZError) as raised:
        zenoh.Config.from_file("/nowhere.json5")
    assert reason(raised.value) == "No such file or directory (os error 2)"
