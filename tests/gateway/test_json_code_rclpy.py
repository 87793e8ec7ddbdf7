"""What rclpy has serialized becomes the text of the values that it was given.

For every message type of the packages in use, and every part of the services that are installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec

import pytest
from hypothesis import HealthCheck, given, settings

from router.gateway.json_code import json_writer
from router.gateway.style import Style
from router.types.model import MessageType
from router.types.ros import RosInterfaces, ros_interfaces
from tests.compiler.generated_types import values
from tests.compiler.reading import field_values
from tests.oracles.reference_json import reference_text

pytest.importorskip("rclpy")

from router.ros.types import installed_type
from tests.compiler.comparing import without_nul
from tests.compiler.ros_objects import serialized

PACKAGES = ("comms", "geometry_msgs", "sensor_msgs", "std_msgs")
WITH_SERVICES = ("action_msgs", "lifecycle_msgs", "rcl_interfaces", "sensor_msgs", "type_description_interfaces")


def is_installed(name: str) -> bool:
    package, _, short = name.partition("/msg/")
    if package not in PACKAGES or find_spec(f"{package}.msg") is None:
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


@pytest.fixture(scope="module")
def interfaces() -> RosInterfaces:
    return ros_interfaces()


@pytest.mark.parametrize("name", sorted(filter(is_installed, ros_interfaces().names())))
def test_type_is_written_as_the_oracle_does(interfaces: RosInterfaces, name: str) -> None:
    declared = interfaces.get(name)
    assert declared is not None
    assert_written_as_the_oracle_does(declared)


@pytest.mark.parametrize("name", sorted(service_parts()))
def test_part_of_a_service_is_written_as_the_oracle_does(name: str) -> None:
    assert_written_as_the_oracle_does(installed_type(name))


def assert_written_as_the_oracle_does(declared: MessageType) -> None:
    writers = {style: json_writer(declared, style) for style in Style}

    @settings(max_examples=5, suppress_health_check=list(HealthCheck))
    @given(values(declared))
    def equal(drawn: object) -> None:
        value = without_nul(field_values(drawn, declared))
        data = serialized(declared.name, value)
        for style, write in writers.items():
            assert write(data) == reference_text(declared, value, is_wrapped=style is Style.WRAPPED)

    equal()
