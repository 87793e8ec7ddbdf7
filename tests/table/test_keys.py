"""Keys are declared once: what a field of the model says is all that reads, shows and describes them."""

from __future__ import annotations

from dataclasses import dataclass, is_dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Annotated

from router.table import model
from router.table.build import structure
from router.table.compose import compose
from router.table.grammar.keys import properties, required
from router.table.keys import Listed, Range, Words, flat, keys_of, phrases
from router.table.model.targets import Destination, OnLimit
from router.table.nodes import MappingNode
from router.table.schema import table_schema
from router.table.source import read_source
from router.table.units import DURATION
from tests.table.tables import references

UNITS = ("duration", "size", "disk_size", "data_rate", "period", "rate")
"""The schema's definitions of numbers with a unit."""


def test_every_number_with_a_unit_is_shown_with_it() -> None:
    modules = [import_module(found.name) for found in iter_modules(model.__path__, "router.table.model.")]
    parts = [part for module in modules for part in vars(module).values()]
    models = [part for part in parts if is_dataclass(part) and isinstance(part, type)]
    shown = {key.name.rpartition(".")[2] for part in models for key in keys_of(part) if key.quantity is not None}
    in_schema = {path[-1] for path, definition in references(table_schema()) if definition in UNITS}
    assert in_schema >= {"ttl", "retention", "bandwidth", "publish_period", "max_rate", "receive_buffer"}
    assert in_schema - shown == set()


@dataclass(frozen=True, slots=True)
class Delayed(Destination):
    """A destination with a key of its own."""

    delay: Annotated[int | None, DURATION, Words("{} later")] = 1_500_000_000
    """How long a message waits
    before it is sent.

    In ns.

    Title: Largest delay
    Example: 1500ms
    Example: {a: [1,
    b]}
    """
    repeats: Annotated[tuple[int, ...], Range(1, 9), Listed(least=2, unique=True, alone=True)] = ()
    """How often."""
    hidden: bool = False


def test_a_field_of_the_model_is_all_that_a_key_needs_to_be_read_and_shown(tmp_path: Path) -> None:
    path = tmp_path / "destination.yaml"
    path.write_text("{endpoint: arm, delay: 1500ms, max_rate: 20}")
    settings = compose(read_source(path), {}, [])
    assert isinstance(settings, MappingNode)
    found = structure(Delayed, settings, span=settings.span)
    assert (found.delay, found.max_rate, found.on_limit) == (1_500_000_000, 20.0, OnLimit.FIRST)
    assert flat(found) == {
        "max_rate": "20 Hz", "on_limit": "first", "endpoint": "arm", "delay": "1.5 s", "hidden": "false",
    }  # fmt: skip
    assert phrases(found) == {"max_rate": "at most 20 Hz", "on_limit": "keeping the first", "delay": "1.5 s later"}


def test_it_is_all_that_the_schema_needs() -> None:
    found = properties(Delayed, when="If it is true.")
    number = {"if": {"$ref": "#/definitions/variable"}, "else": {"type": "integer", "minimum": 1, "maximum": 9}}
    assert found["delay"] == {
        "title": "Largest delay",
        "description": "How long a message waits before it is sent.",
        "examples": ["1500ms", {"a": [1, "b"]}],
        "default": "1.5s",
        "allOf": [{"$ref": "#/definitions/duration"}],
    }
    assert found["repeats"] == {
        "title": "Repeats",
        "description": "How often.",
        "if": {"type": "array"},
        "then": {"minItems": 2, "uniqueItems": True, "items": number},
        "else": number,
    }
    assert found["on_limit"]["enum"] == ["first", "latest"]
    assert found["when"]["description"] == "If it is true."
    assert [*found] == ["delay", "repeats", "when", "max_rate", "on_limit", "endpoint", "fields"]
    assert required(Delayed) == ["endpoint"]
