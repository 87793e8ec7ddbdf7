"""What clients send arrives in rclpy with the values they sent, for every message type that is installed."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.gateway.json_reading import cdr_builder, example, parse_json
from router.gateway.style import Style
from router.types.ros import RosInterfaces, ros_interfaces
from tests.compiler.comparing import assert_same_message, same
from tests.gateway.client_json import FORMS, tree, values, written

pytest.importorskip("rclpy")

from tests.compiler.ros_objects import deserialized, message_class, serialized, to_value


def is_installed(name: str) -> bool:
    package, _, short = name.partition("/msg/")
    if find_spec(package) is None or find_spec(f"{package}.msg") is None:
        return False
    return hasattr(__import__(f"{package}.msg").msg, short)


INTERFACES: RosInterfaces = ros_interfaces()
INSTALLED = sorted(filter(is_installed, INTERFACES.names()))


def test_the_usual_packages_are_installed() -> None:
    assert {"std_msgs", "geometry_msgs", "sensor_msgs"} <= {name.partition("/")[0] for name in INSTALLED}


@pytest.mark.parametrize("name", INSTALLED)
def test_values_arrive_in_rclpy(name: str) -> None:
    declared = INTERFACES.get(name)
    assert declared is not None
    builders = {style: cdr_builder(declared, style) for style in Style}

    @settings(max_examples=4, suppress_health_check=list(HealthCheck))
    @given(values(declared), st.sampled_from(FORMS), st.sampled_from(Style))
    def arrives(value: dict[str, Any], form: dict[str, Any], style: Style) -> None:
        text = written(tree(declared, value, is_wrapped=style is Style.WRAPPED), form)
        data = builders[style](parse_json(text))
        assert_same_message(data, serialized(name, value), declared, value)
        assert same(deserialized(name, data), value)

    arrives()
    defaults = deserialized(name, builders[Style.PLAIN](example(declared)))
    assert same(defaults, to_value(message_class(name)()))
