"""JSON becomes what rclpy writes also for messages that hold everything that CDR makes hard, wide text above all."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.gateway.json_reading import cdr_builder, example, parse_json
from router.gateway.style import Style
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
    builders = {style: cdr_builder(declared, style) for style in Style}

    @settings(max_examples=30, suppress_health_check=list(HealthCheck))
    @given(values(declared), st.sampled_from(FORMS), st.sampled_from(Style))
    def arrives(value: dict[str, Any], form: dict[str, Any], style: Style) -> None:
        text = written(tree(declared, value, is_wrapped=style is Style.WRAPPED), form)
        data = builders[style](parse_json(text))
        theirs, read = package.ask(name, value, data)
        assert_same_message(data, theirs, declared, value)
        assert same(read, value)

    arrives()


def test_example_has_the_defaults_of_rclpy(package: InterfacePackage) -> None:
    declared = declared_type(package, "Defaults")
    shown = example(declared)
    data = cdr_builder(declared, Style.PLAIN)(shown)
    theirs, read = package.ask("Defaults", {}, data)
    assert_same_message(data, theirs, declared, read)
    assert same(read, shown)
