"""What rclpy has serialized is read as rclpy reads it, for every type of the packages in use."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
from hypothesis import HealthCheck, given, settings

from router.compiler.lookup import Definitions
from router.types.ros import ros_interfaces
from tests.compiler.comparing import same
from tests.compiler.generated_types import values
from tests.compiler.reading import WHOLE, at, field_values, plain, reader, wanted_paths

pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message, serialize_message

from tests.compiler.comparing import without_nul
from tests.compiler.ros_objects import message_class, to_object

PACKAGES = ("builtin_interfaces", "comms", "geometry_msgs", "sensor_msgs", "std_msgs")


def is_installed(name: str) -> bool:
    package, _, short = name.partition("/msg/")
    if package not in PACKAGES or find_spec(f"{package}.msg") is None:
        return False
    return hasattr(__import__(f"{package}.msg").msg, short)


INSTALLED = sorted(filter(is_installed, ros_interfaces().names()))


@pytest.mark.parametrize("name", INSTALLED)
def test_type_is_read_as_rclpy_does(definitions: Definitions, name: str) -> None:
    declared = definitions.interfaces.get(name)
    assert declared is not None

    @settings(max_examples=8, suppress_health_check=list(HealthCheck))
    @given(values(declared), wanted_paths(declared))
    def equal(message: object, wanted: list[tuple[str, ...]]) -> None:
        value = without_nul(field_values(message, declared))
        assert isinstance(value, dict)
        data = bytes(serialize_message(to_object(message_class(name), value)))
        theirs = deserialize_message(data, message_class(name))
        _, read = reader(declared, [WHOLE, *wanted])
        for path, ours in zip([WHOLE, *wanted], read(data), strict=True):
            expected: object = theirs
            for part in path:
                expected = getattr(expected, part)
            assert same(plain(ours, at(declared, path)), plain(expected, at(declared, path)))

    equal()
