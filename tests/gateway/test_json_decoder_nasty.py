"""JSON becomes what rclpy writes also for messages that hold everything that CDR makes hard, wide text above all."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.gateway.json_codec import decoder
from router.gateway.json_types import Style, example
from tests.compiler.comparing import assert_same_message, same
from tests.compiler.interface_package import MESSAGES, InterfacePackage, built, declared_type, is_buildable
from tests.gateway.client_json import FORMS, tree, values, written

pytest.importorskip("rclpy")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not is_buildable(), reason="cmake and the ROS interface generators are needed"),
]


@pytest.fixture(scope="module")
def package() -> Iterator[InterfacePackage]:
    made = InterfacePackage(built())
    yield made
    made.close()


@pytest.mark.parametrize("name", MESSAGES)
def test_values_arrive_in_rclpy(package: InterfacePackage, name: str) -> None:
    declared = declared_type(package, name)
    decoders = {style: decoder(declared, style) for style in Style}

    @settings(max_examples=30, suppress_health_check=list(HealthCheck))
    @given(values(declared), st.sampled_from(FORMS), st.sampled_from(Style))
    def arrives(value: dict[str, Any], form: dict[str, Any], style: Style) -> None:
        data = decoders[style](written(tree(declared, value, is_wrapped=style is Style.WRAPPED), form))
        theirs, read = package.ask(name, value, data)
        assert_same_message(data, theirs, declared, value)
        assert same(read, value)

    arrives()


def test_example_has_the_defaults_of_rclpy(package: InterfacePackage) -> None:
    declared = declared_type(package, "Defaults")
    shown = example(declared)
    data = decoder(declared, Style.PLAIN)(json.dumps(shown).encode())
    theirs, read = package.ask("Defaults", {}, data)
    assert_same_message(data, theirs, declared, read)
    assert same(read, shown)
