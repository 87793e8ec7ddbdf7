"""Checks the `config` of Zenoh gateways with Zenoh's library. Opens nothing; findings quote no values."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from router.compiler.extras import missing_extra
from router.errors import Code, Diagnostic, did_you_mean
from router.table.model import Networks
from router.table.model.gateways import Gateway, ZenohConfig
from router.table.nodes import Path

try:
    import zenoh
except ModuleNotFoundError as error:
    what = f"a Zenoh gateway needs a Python package that is not installed: {error.name}"
    raise missing_extra(what, "gateways") from error

OWN_KEYS = {"mode": "mode", "connect/endpoints": "connect", "listen/endpoints": "listen"}
"""Keys of the library that tables set beside `config`, with their names in tables."""


CLIENT = "client"
"""The mode without a listener: connects only to `connect` or to peers discovered by multicast."""


def library_config(config: ZenohConfig | None) -> zenoh.Config:
    """Return the library's configuration. Raises ZError, whose text may contain secrets: see `reason`."""
    library: zenoh.Config
    if config is None:
        library = zenoh.Config()
    elif config.path is not None:
        library = zenoh.Config.from_file(config.path)
    else:
        library = zenoh.Config.from_json5(config.text)
    return library


def config_findings(config: ZenohConfig) -> Iterator[Diagnostic]:
    """Yield findings for settings that the library rejects, and for keys that belong beside `config`."""
    try:
        library = library_config(config)
    except zenoh.ZError as error:
        yield _refusal(config, error)
        return
    for key, ours in OWN_KEYS.items():
        if not is_default(library, key):
            span = config.spans.get(tuple(key.split("/")), config.span)
            where = f"'{key}' in '{config.path.name}'" if config.path else f"'{key}'"
            message = f"{where} is not allowed in the 'config' of a gateway"
            yield Diagnostic(span, Code.BAD_VALUE, message, f"set '{ours}' beside 'config' instead")


def scouting_findings(gateway: Gateway, networks: Networks) -> Iterator[Diagnostic]:
    """Yield a finding for a gateway that listens on all networks, or discovers others, in spite of `networks`."""
    settings = gateway.zenoh
    try:
        config = library_config(settings.config) if settings else None
    except zenoh.ZError:
        return  # has its own finding
    if settings is None or config is None:
        return
    by_itself = {"multicast": not settings.connect and not settings.listen, "gossip": settings.mode != CLIENT}
    said = {way: json.loads(config.get_json(f"scouting/{way}/enabled")) for way in by_itself}
    ways = [way for way, value in said.items() if (by_itself[way] if value is None else value)]
    does, remedies = [], []
    if settings.mode != CLIENT and not settings.listen:
        does.append("listens on all networks of this machine")
        remedies.append("'listen'")
    if ways:
        does.append(f"discovers others by {' and '.join(ways)}")
        off = ", ".join(f"{way}: {{enabled: false}}" for way in ways)
        remedies.append(f"'config: {{scouting: {{{off}}}}}'")
    if does:
        what = f"gateway '{gateway.name}' {' and '.join(does)}, beyond {networks}"
        hint = f"set {' and '.join(remedies)}, or 'mode: client' and 'connect'"
        yield Diagnostic(gateway.transport.span, Code.OUTSIDE_NETWORKS, what, hint)


def is_default(config: zenoh.Config, key: str) -> bool:
    """Return whether `key` has its default."""
    return bool(config.get_json(key) == zenoh.Config().get_json(key))


def reason(error: object) -> str:
    """Return the text of an error without quoted values and positions in the library's source."""
    text = re.sub(r" at /\S+:\d+\.?$", "", str(error).strip())
    if '{"access_control":' in text or "is invalid" in text:
        return "its values contradict each other, for example a user without a password"
    for pattern in _PLACED:
        if match := re.search(pattern, text, re.DOTALL):
            return f"line {match['line']}, column {match['column']}: {_without_values(match['what'])}"
    return _without_values(text.partition("\n")[0])


_PLACED = (
    r"--> (?P<line>\d+):(?P<column>\d+)\n.*= (?P<what>[^\n]*)$",
    r"msg: \"(?P<what>.*)\", location: .*line: (?P<line>\d+), column: (?P<column>\d+)",
    r"Error\(\"(?P<what>.*)\", line: (?P<line>\d+), column: (?P<column>\d+)\)",
    r"problem: \"(?P<what>[^\"]*)\", problem_mark: Mark { line: (?P<line>\d+), column: (?P<column>\d+)",
)
"""Formats of positions in the library's errors for JSON5 and YAML. In JSON5 errors, the source line comes first."""


def _without_values(text: str) -> str:
    return re.sub(r"(invalid (?:type|value): [a-z ]*[a-z]) ?[`\"\\].*[`\"], expected", r"\1, expected", text)


def _refusal(config: ZenohConfig, error: zenoh.ZError) -> Diagnostic:
    why, hint = reason(error), ""
    if unknown := re.search(r"unknown field `([^`]*)`, expected (.*)", why):
        why = f"{why[: unknown.start()]}unknown key '{unknown[1]}'"
        hint = did_you_mean(unknown[1], re.findall(r"`([^`]+)`", unknown[2]))
    elif "expected a string" in why:
        hint = "put the value in quotes"
    if config.path is not None:
        return Diagnostic(config.span, Code.BAD_FILE, f"Zenoh rejects '{config.path.name}': {why}", hint)
    span = config.spans.get(_blamed(json.loads(config.text), (), str(error)), config.span)
    return Diagnostic(span, Code.BAD_VALUE, f"Zenoh rejects this: {why}", hint)


def _blamed(value: Any, here: Path, message: str) -> Path:
    """Return the path of the innermost member of `value` that alone causes the same error."""
    if isinstance(value, (dict, list)) and _refused(here, type(value)()) != message:
        for step, member in value.items() if isinstance(value, dict) else enumerate(value):
            is_missing = message.startswith("missing field") and not isinstance(member, (dict, list))
            if not is_missing and _refused((*here, step), member) == message:
                return _blamed(member, (*here, step), message)
    return here


def _refused(path: Path, value: Any) -> str:
    for step in reversed(path):
        value = [value] if isinstance(step, int) else {step: value}
    try:
        zenoh.Config.from_json5(json.dumps(value))
    except zenoh.ZError as error:
        return str(error)
    return ""
