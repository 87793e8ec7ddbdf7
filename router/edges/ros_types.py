"""The installed Python classes of ROS messages, which must be laid out as the table was compiled for."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from router.errors import SourceSpan, StartError

Definition = tuple[tuple[str, str], ...]
"""The fields of a type, each as its name and its type in rclpy's spelling."""


def checked_class(name: str, definitions: Mapping[str, Definition], span: SourceSpan) -> Any:
    """The class `name` if it and all types in it are installed as `definitions` say.

    Raises StartError that blames `span`.
    """
    try:
        return matching_class(name, definitions)
    except StartError as error:
        raise StartError(f"{span}: {error}") from error


def matching_class(name: str, definitions: Mapping[str, Definition]) -> Any:
    """The same where no table names the type. Raises StartError."""
    for part, compiled in definitions.items():
        installed = tuple(installed_class(part).get_fields_and_field_types().items())
        if installed != compiled:
            raise StartError(
                f"{part} as installed is not what the table was compiled for; {_remedy(part)}\n"
                f"  installed: {_fields(installed)}\n  compiled:  {_fields(compiled)}"
            )
    return installed_class(name)


def installed_class(name: str) -> Any:
    """The class of `std_msgs/msg/String`. Raises StartError."""
    package, _, short = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), short)
    except (ImportError, AttributeError) as error:
        raise StartError(f"{name} is not installed ({error}); {_remedy(name)}") from error


def _remedy(name: str) -> str:
    return f"run 'make setup', or install the ROS package '{name.partition('/')[0]}'"


def _fields(definition: Definition) -> str:
    return ", ".join(f"{kind} {name}" for name, kind in definition)
