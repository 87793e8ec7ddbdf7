"""Keys as they are shown: what is shown of a table can be written into one, and means the same there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any

from hypothesis import given, settings
from hypothesis import strategies as st

from router.table import model
from router.table.build import structure
from router.table.compose import compose
from router.table.keys import Words, flat, keys_of, phrases
from router.table.model import Destination, Keep, RouteTable
from router.table.nodes import MappingNode
from router.table.schema import table_schema
from router.table.source import read_source
from router.table.units import DURATION
from tests.table.tables import load

TABLE = """\
version: 1
envelope: {{protos: ../protos, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: 0.0.0.0:5000, {listener}}}}}
endpoints: {{arm: {{address: 10.0.0.1:8, kind: board, {endpoint}}}}}
record: {{directory: /recordings, {record}}}
gateways: {{dashboard: {{transport: {{udp: 10.0.0.2:9000}}, format: gateway_v2, {gateway}}}}}
routes: {{}}
"""
UNITS = ("duration", "size", "disk_size", "data_rate", "period", "max_rate")
"""The schema's definitions of numbers with a unit."""


def numbers(low: int, high: int, *units: str) -> st.SearchStrategy[str]:
    return st.builds("{}{}".format, st.integers(low, high), st.sampled_from(units))


TIMES = numbers(10, 5000, "ms", "s", "min", "h")
SETTINGS = {
    "listener": {
        "receive_buffer": numbers(64, 1000, "kB", "KiB", "MiB"),
        "coalesce": st.just("never") | numbers(1, 9999, "us"),
    },
    "endpoint": {"stale_after": st.just("never") | TIMES, "budget": numbers(1, 5000, "kB/s", "KiB/s", "MB/s")},
    "record": {
        "continuous": st.sampled_from(["true", "false"]),
        "last": TIMES,
        "max_size": numbers(2, 5000, "MB", "MiB", "GiB"),
        "max_age": TIMES,
        "keep": numbers(2, 5000, "MB", "GB", "GiB"),
    },
    "gateway": {
        "publish_period": st.just("each") | TIMES,
        "schema_period": TIMES,
        "discovery_period": TIMES,
        "max_datagram": numbers(1, 60, "kB", "KiB"),
        "max_message": numbers(1, 200, "kB", "MiB"),
    },
}


def table_of(folder: Path, chosen: dict[str, dict[str, str]]) -> RouteTable:
    parts = {part: ", ".join(f"{key}: {text}" for key, text in texts.items()) for part, texts in chosen.items()}
    table, findings = load(folder, TABLE.format(**parts))
    assert findings == []
    assert table
    return table


def shown(table: RouteTable) -> dict[str, dict[str, str]]:
    parts = {
        "listener": table.listeners["rover"],
        "endpoint": table.endpoints["arm"],
        "record": table.record,
        "gateway": table.gateways["dashboard"],
    }
    return {part: {key: flat(settings)[key] for key in SETTINGS[part]} for part, settings in parts.items()}


def test_what_is_shown_of_a_setting_means_the_same_in_a_table(tmp_path: Path) -> None:
    @settings(max_examples=25)
    @given(st.fixed_dictionaries({part: st.fixed_dictionaries(keys) for part, keys in SETTINGS.items()}))
    def holds(chosen: dict[str, dict[str, str]]) -> None:
        table = table_of(tmp_path, chosen)
        again = table_of(tmp_path, shown(table))
        for part in ("listeners", "endpoints", "gateways"):
            assert flat(getattr(again, part)) == flat(getattr(table, part))
        assert again.record == table.record
        assert again.endpoints["arm"].stale_after == table.endpoints["arm"].stale_after

    holds()


def test_every_number_with_a_unit_is_shown_with_it() -> None:
    models = [part for part in vars(model).values() if is_dataclass(part) and isinstance(part, type)]
    shown = {key.name for part in models for key in keys_of(part) if key.quantity is not None}
    assert set(_with_units(table_schema(), "")) - shown == set()


def _with_units(node: Any, key: str) -> Iterator[str]:
    """The keys whose values the schema takes for numbers with units."""
    if isinstance(node, list):
        for member in node:
            yield from _with_units(member, key)
    elif isinstance(node, dict):
        if node.get("$ref", "").rpartition("/")[2] in UNITS:
            yield key
        for name, inner in node.get("properties", {}).items():
            yield from _with_units(inner, name)
        for name, inner in node.items():
            if name == "definitions":
                for named in inner.values():
                    yield from _with_units(named, "")
            elif name != "properties":
                yield from _with_units(inner, key)


def test_the_schema_is_searched_for_numbers_with_units() -> None:
    found = set(_with_units(table_schema(), ""))
    assert {"ttl", "keep", "budget", "publish_period", "max_rate", "receive_buffer"} <= found


@dataclass(frozen=True, slots=True)
class Delayed(Destination):
    """A destination with a key of its own."""

    delay: Annotated[int | None, DURATION, Words("{} later")] = None


def test_a_field_of_the_model_is_all_that_a_key_needs_to_be_read_and_shown(tmp_path: Path) -> None:
    path = tmp_path / "destination.yaml"
    path.write_text("{endpoint: arm, delay: 1500ms, max_rate: 20}")
    settings = compose(read_source(path), {}, [])
    assert isinstance(settings, MappingNode)
    found = structure(Delayed, settings, span=settings.span)
    assert (found.delay, found.max_rate, found.keep) == (1_500_000_000, 20.0, Keep.FIRST)
    assert flat(found) == {"max_rate": "20 Hz", "keep": "first", "endpoint": "arm", "delay": "1.5 s"}
    assert phrases(found) == {"max_rate": "at most 20 Hz", "keep": "keeping the first", "delay": "1.5 s later"}
