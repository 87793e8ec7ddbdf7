"""The installed Python classes of ROS messages, which must be laid out as the table was compiled for."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Mapping
from importlib.machinery import PathFinder
from types import ModuleType
from typing import Any

from router.errors import SourceSpan, StartError
from router.ros.environment import ros_package_remedy

_NAME = re.compile(r"(?P<package>[A-Za-z]\w*)/(?P<kind>msg|srv|action)/(?P<short>[A-Z]\w*)", re.ASCII)

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
    """The class of `std_msgs/msg/String`, `std_srvs/srv/Empty_Event`, `nav2_msgs/action/Wait_FeedbackMessage`.

    The name may come from anybody: of Python's packages only those are imported that have a part `msg`, `srv` or
    `action`. Raises StartError.
    """
    parts = _NAME.fullmatch(name)
    if parts is None:
        raise StartError(f"{name} is not installed (it is no name of a ROS message)")
    package, kind, short = parts.groups()
    if not _has_part(package, kind):
        raise StartError(f"{name} is not installed (there is no Python package '{package}.{kind}'); {_remedy(name)}")
    try:
        found = _member(importlib.import_module(f"{package}.{kind}"), short)
    except Exception as error:  # what is in the package can be anything
        raise StartError(f"{name} cannot be loaded: {error}") from error
    if not hasattr(found, "get_fields_and_field_types"):
        raise StartError(f"{name} is not installed ('{package}.{kind}' has no such message); {_remedy(name)}")
    return found


def _has_part(package: str, kind: str) -> bool:
    """Looks at folders only."""
    found = PathFinder.find_spec(package)
    return bool(found and PathFinder.find_spec(f"{package}.{kind}", found.submodule_search_locations or []))


def _member(module: ModuleType, name: str) -> Any:
    """None if there is none. Of an action's messages a package shows some only; all are beside the action's class."""
    interface = getattr(module, name.partition("_")[0], None)
    home = module if interface is None else sys.modules[interface.__module__]
    return getattr(module, name, None) or getattr(home, name, None)


def _remedy(name: str) -> str:
    return ros_package_remedy(name.partition("/")[0])


def _fields(definition: Definition) -> str:
    return ", ".join(f"{kind} {name}" for name, kind in definition)
