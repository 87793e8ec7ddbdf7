"""What rclpy has serialized becomes JSON of the values that it was given, and what clients send arrives in rclpy.

For every message type that is installed, and every part of some services.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from router.gateway.json_codec import decoder, encoder
from router.gateway.json_types import Style, example
from router.types.model import MessageType
from router.types.ros import RosInterfaces, ros_interfaces
from tests.compiler.comparing import assert_same_message, same, without_nul
from tests.compiler.generated_types import values as any_values
from tests.compiler.interface_package import MESSAGES, InterfacePackage, built, declared_type, is_buildable
from tests.compiler.reading import field_values
from tests.gateway.client_json import FORMS, tree, values, written
from tests.oracles.reference_json import reference_value

pytest.importorskip("rclpy")

from router.ros.types import installed_type
from tests.compiler.ros_objects import deserialized, message_class, serialized, to_value

pytestmark = pytest.mark.slow
PACKAGES = ("comms/", "geometry_msgs/", "sensor_msgs/", "std_msgs/")
WITH_SERVICES = ("action_msgs", "lifecycle_msgs", "rcl_interfaces", "sensor_msgs", "type_description_interfaces")


def is_installed(name: str) -> bool:
    package, _, short = name.partition("/msg/")
    if find_spec(package) is None or find_spec(f"{package}.msg") is None:
        return False
    return hasattr(__import__(f"{package}.msg").msg, short)


def service_parts() -> Iterator[str]:
    for package in filter(find_spec, WITH_SERVICES):
        services = f"{package}.srv"
        yield from (
            f"{package}/srv/{name}_{part}"
            for name, found in vars(import_module(services)).items()
            if hasattr(found, "Request")
            for part in ("Request", "Response", "Event")
        )


INTERFACES: RosInterfaces = ros_interfaces()
INSTALLED = sorted(filter(is_installed, INTERFACES.names()))


def test_the_usual_packages_are_installed() -> None:
    assert {"std_msgs", "geometry_msgs", "sensor_msgs"} <= {name.partition("/")[0] for name in INSTALLED}


@pytest.mark.parametrize("name", [name for name in INSTALLED if name.startswith(PACKAGES)])
def test_type_is_written_as_the_oracle_does(name: str) -> None:
    declared = INTERFACES.get(name)
    assert declared is not None
    assert_written_as_the_oracle_does(declared)


@pytest.mark.parametrize("name", sorted(service_parts()))
def test_part_of_a_service_is_written_as_the_oracle_does(name: str) -> None:
    assert_written_as_the_oracle_does(installed_type(name))


def assert_written_as_the_oracle_does(declared: MessageType) -> None:
    encoders = {style: encoder(declared, style) for style in Style}

    @settings(max_examples=5, suppress_health_check=list(HealthCheck))
    @given(any_values(declared))
    def equal(drawn: object) -> None:
        value = without_nul(field_values(drawn, declared))
        data = serialized(declared.name, value)
        for style, encode in encoders.items():
            expected = reference_value(declared, value, is_wrapped=style is Style.WRAPPED)
            assert repr(json.loads(encode(data))) == repr(expected)

    equal()


@pytest.mark.parametrize("name", INSTALLED)
def test_values_arrive_in_rclpy(name: str) -> None:
    declared = INTERFACES.get(name)
    assert declared is not None
    assert_arrives(declared, 4, lambda value, data: (serialized(name, value), deserialized(name, data)))
    defaults = deserialized(name, decoder(declared, Style.PLAIN)(json.dumps(example(declared)).encode()))
    assert same(defaults, to_value(message_class(name)()))


@pytest.fixture(scope="module")
def package() -> Iterator[InterfacePackage]:
    """Messages that hold everything that CDR makes hard, wide text above all."""
    if not is_buildable():
        pytest.skip("cmake and the ROS interface generators are needed")
    made = InterfacePackage(built())
    yield made
    made.close()


@pytest.mark.parametrize("name", MESSAGES)
def test_nasty_values_arrive_in_rclpy(package: InterfacePackage, name: str) -> None:
    assert_arrives(declared_type(package, name), 30, lambda value, data: package.ask(name, value, data))


def test_example_of_a_nasty_message_has_the_defaults_of_rclpy(package: InterfacePackage) -> None:
    declared = declared_type(package, "Defaults")
    shown = example(declared)
    data = decoder(declared, Style.PLAIN)(json.dumps(shown).encode())
    theirs, read = package.ask("Defaults", {}, data)
    assert_same_message(data, theirs, declared, read)
    assert same(read, shown)


def assert_arrives(
    declared: MessageType, examples: int, rclpy: Callable[[dict[str, Any], bytes], tuple[bytes, Any]]
) -> None:
    """`rclpy` gives its own bytes of a value, and the value that it reads from ours."""
    decoders = {style: decoder(declared, style) for style in Style}

    @settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    @given(values(declared), st.sampled_from(FORMS), st.sampled_from(Style))
    def arrives(value: dict[str, Any], form: dict[str, Any], style: Style) -> None:
        data = decoders[style](written(tree(declared, value, is_wrapped=style is Style.WRAPPED), form))
        theirs, read = rclpy(value, data)
        assert_same_message(data, theirs, declared, value)
        assert same(read, value)

    arrives()
