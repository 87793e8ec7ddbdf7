"""Installed ROS message types, checked against the table's definitions: their Python classes, and their fields."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Mapping
from importlib.machinery import PathFinder
from itertools import zip_longest
from pathlib import Path
from types import ModuleType
from typing import Any

from rclpy.type_support import check_is_valid_msg_type
from rosidl_parser.definition import (  # type: ignore[import-untyped]
    AbstractGenericString,
    AbstractNestedType,
    AbstractWString,
    Array,
    NamespacedType,
)

from router.assets import asset
from router.errors import ConfigurationError, SourceSpan, StartError, shown_path
from router.lazy_import import lazy_import
from router.ros.environment import ros_package_remedy
from router.ros.type_support import Definition, class_for_cdr, library_of
from router.shortage import is_shortage
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.ros import IGNORED, msg_files

_NAME = re.compile(r"(?P<package>[A-Za-z]\w*)/(?P<kind>msg|srv|action)/(?P<short>[A-Z]\w*)", re.ASCII)

_BASIC: dict[str, Type] = {
    "boolean": Bool(),
    "octet": Int(8, signed=False, octet=True),
    "float": Float(32),
    "double": Float(64),
    **{str(it): it for it in (Int(bits, signed) for bits in (8, 16, 32, 64) for signed in (False, True))},
}


def checked_class(name: str, definitions: Mapping[str, Definition], span: SourceSpan) -> Any:
    """Like `usable_class`, with the position `span` in the StartError."""
    try:
        return usable_class(name, definitions)
    except StartError as error:
        raise type(error)(f"{span}: {error.what}", error.hint) from error


def usable_class(name: str, definitions: Mapping[str, Definition]) -> Any:
    """Return the class, or a stand-in, with which rclpy publishes and takes a type as CDR.

    Raises StartError unless the type and its nested types are installed as in `definitions`.
    """
    package, kind, short = _parts(name)
    message_class = None
    if _has_part(package, kind):
        with lazy_import("numpy"):
            message_class = class_for_cdr(package, kind, short, definitions)
        if message_class is not None and _other_library(package, message_class) is None:
            return message_class
    _require_same(definitions)
    if message_class is not None:
        return message_class
    message_class = loaded_class(name)
    if (library := _other_library(package, message_class)) is not None:
        is_ignored = (asset("schemas") / package / IGNORED).exists()
        raise ConfigurationError(
            f"the package '{package}' is installed twice: {_folder(package)} is used with {library}",
            "run 'make setup', which removes the ignored one" if is_ignored else "source only one of them",
        )
    return message_class


def service_class(name: str, definitions: Mapping[str, Definition], span: SourceSpan) -> Any:
    """Like `usable_service`, with the position `span` in the StartError."""
    try:
        return usable_service(name, definitions)
    except StartError as error:
        raise type(error)(f"{span}: {error.what}", error.hint) from error


def usable_service(name: str, definitions: Mapping[str, Definition]) -> Any:
    """Return the class of `std_srvs/srv/SetBool`. Raises StartError as `usable_class` does."""
    _require_same(definitions)
    package, kind, short = _parts(name)
    with lazy_import("numpy"):
        return getattr(importlib.import_module(f"{package}.{kind}"), short)


def _require_same(definitions: Mapping[str, Definition]) -> None:
    """Raise StartError unless these types are installed with such fields."""
    for part, compiled in definitions.items():
        installed = tuple(installed_class(part).get_fields_and_field_types().items())
        if installed != compiled:
            raise _mismatch(part, installed, compiled)


def _other_library(package: str, message_class: Any) -> Path | None:
    """Return the C library of a type if it is not of the same installation as the Python package.

    Two workspaces, or a workspace and Python's environment, may have a package of that name. The wheels of ROS 2 order
    LD_LIBRARY_PATH at random.
    """
    library = library_of(message_class)
    prefix = _folder(package).parents[3]  # above lib/python3.12/site-packages/PACKAGE
    return None if library is None or library.is_relative_to(prefix) else library


def _folder(package: str) -> Path:
    return Path(importlib.import_module(package).__path__[0])


def _mismatch(name: str, installed: Definition, compiled: Definition) -> ConfigurationError:
    """Return an error with the first field that differs, and where both definitions come from."""
    package = name.partition("/")[0]
    folder = _folder(package)
    definition = msg_files().find(name)
    file = definition.file if definition else "rosbags"
    pairs = enumerate(zip_longest(installed, compiled), 1)
    number, (there, here) = next((number, pair) for number, pair in pairs if pair[0] != pair[1])
    what = (
        f"the installed {name} is not the one the table was compiled for: "
        f"field {number} is {_field(there)} in {folder}, {_field(here)} in {file}"
    )
    ours = asset("schemas") / package
    if Path(file).absolute().parent != ours / "msg" or folder.is_relative_to(sys.prefix):
        return ConfigurationError(what, _remedy(name))
    ignored = shown_path(ours / IGNORED)
    remedy = f"to use the package of that workspace, create {ignored} and run 'make setup'; else do not source it"
    return ConfigurationError(what, remedy)


def _field(field: tuple[str, str] | None) -> str:
    return "missing" if field is None else f"'{field[1]} {field[0]}'"


def loaded_class(name: str) -> Any:
    """Like `installed_class`, with the type support loaded, which takes some 10 ms. Raises StartError."""
    message_class = installed_class(name)
    try:
        with lazy_import("numpy"):
            check_is_valid_msg_type(message_class)
    except Exception as error:  # a library that cannot be loaded, or anything else
        why = f"{error}: {error.__context__}" if error.__context__ else str(error)  # the latter names the library
        raise _kind(error)(f"{name} cannot be used: {why}", _remedy(name)) from error
    return message_class


def installed_class(name: str) -> Any:
    """Return the class of `std_msgs/msg/String`, `std_srvs/srv/Empty_Event`, `nav2_msgs/action/Wait_FeedbackMessage`.

    The name may come from a client: only Python packages with a submodule `msg`, `srv` or `action` are imported.
    Raises StartError.
    """
    package, kind, short = _parts(name)
    if not _has_part(package, kind):
        raise ConfigurationError(
            f"{name} is not installed (there is no Python package '{package}.{kind}')", _remedy(name)
        )
    try:
        with lazy_import("numpy"):
            message_class = _member(importlib.import_module(f"{package}.{kind}"), short)
    except Exception as error:  # a package may raise anything
        raise _kind(error)(f"{name} cannot be loaded: {error}") from error
    if not hasattr(message_class, "get_fields_and_field_types"):
        raise ConfigurationError(f"{name} is not installed ('{package}.{kind}' has no such message)", _remedy(name))
    return message_class


def _kind(error: Exception) -> type[StartError]:
    """Return the class of error for a type that cannot be loaded because of `error`."""
    causes = error, error.__context__  # rclpy's own error hides that of a library
    return StartError if any(cause is not None and is_shortage(cause) for cause in causes) else ConfigurationError


def _parts(name: str) -> tuple[str, ...]:
    """Return package, kind and short name. Raises StartError for any other name."""
    parts = _NAME.fullmatch(name)
    if parts is None:
        raise ConfigurationError(f"{name} is not installed (it is not the name of a ROS message)")
    return parts.groups()


def _has_part(package: str, kind: str) -> bool:
    """Return whether the package is installed, without importing it."""
    spec = PathFinder.find_spec(package)
    return bool(spec and PathFinder.find_spec(f"{package}.{kind}", spec.submodule_search_locations or []))


def _member(module: ModuleType, name: str) -> Any:
    """Return the member or None. A package exports only some messages of an action; the action's module has all."""
    interface = getattr(module, name.partition("_")[0], None)
    home = module if interface is None else sys.modules[interface.__module__]
    return getattr(module, name, None) or getattr(home, name, None)


def _remedy(name: str) -> str:
    return ros_package_remedy(name.partition("/")[0])


def installed_type(name: str) -> MessageType:
    """Return a type with its nested types, as its Python class describes it: without defaults and constants.

    For types without a `.msg` file: those of services and actions, and those written in IDL. Raises StartError if a
    type cannot be loaded, or has a field that no `.msg` file could declare.
    """
    return _message(name, {})


def _message(name: str, known: dict[str, MessageType]) -> MessageType:
    if name not in known:
        message_class = installed_class(name)
        slots = zip(message_class.get_fields_and_field_types(), message_class.SLOT_TYPES, strict=True)
        known[name] = MessageType(
            name, tuple(Field(field, _type(slot, f"{name}.{field}", known)) for field, slot in slots)
        )
    return known[name]


def _type(slot: Any, place: str, known: dict[str, MessageType]) -> Type:
    if isinstance(slot, AbstractNestedType):
        element = _type(slot.value_type, place, known)
        if isinstance(slot, Array):
            return List(element, length=slot.size)
        return List(element, bound=getattr(slot, "maximum_size", None))
    if isinstance(slot, NamespacedType):
        return _message("/".join(slot.namespaced_name()), known)
    if isinstance(slot, AbstractGenericString):
        return String(getattr(slot, "maximum_size", None), wide=isinstance(slot, AbstractWString))
    if (basic := _BASIC.get(slot.typename)) is None:
        raise ConfigurationError(f"{place} is a {slot.typename}, which the router cannot read")
    return basic
