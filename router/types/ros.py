"""The ROS side of the type model: message types by name, with or without ROS on the machine.

Knows definitions only. What an installed Python class says is compared with `definition` by whoever
publishes; rclpy is not imported here.
"""

from __future__ import annotations

from collections.abc import Collection

from router.errors import Code, Diagnostic, SourceSpan, TableError, did_you_mean
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.msg_text import MsgField, NamedType
from router.types.ros_sources import FoundDefinition, MsgFiles, RosbagsDefinitions, msg_files


class RosInterfaces:
    """Message types by full name (`sensor_msgs/msg/Imu`), each read when first asked for.

    A message without fields has none in the model either; on the wire ROS gives it one uint8.
    """

    def __init__(self, files: MsgFiles, rosbags: RosbagsDefinitions) -> None:
        self._files = files
        self._rosbags = rosbags
        self._known: dict[str, MessageType | None] = {}

    def get(self, name: str) -> MessageType | None:
        """The type with all types nested in it, None where no source has it.

        Raises TableError, blaming the `.msg` file, when a definition cannot be read, contains itself or
        names a type that does not exist.
        """
        return self._get(name, ())

    def names(self) -> Collection[str]:
        """Every name that `get` knows, for did-you-mean; reads folders, so ask when something is wrong."""
        return {*self._files.names(), *self._rosbags.names()}

    def _get(self, name: str, inside: tuple[str, ...]) -> MessageType | None:
        if name not in self._known:
            found = self._files.find(name) or self._rosbags.find(name)
            self._known[name] = self._resolved(name, found, inside) if found is not None else None
        return self._known[name]

    def _resolved(self, name: str, found: FoundDefinition, inside: tuple[str, ...]) -> MessageType:
        fields = tuple(
            Field(
                name=field.name,
                type=self._field_type(field, found.file, (*inside, name)),
                default=field.default,
                comment=field.comment,
            )
            for field in found.definition.fields
        )
        return MessageType(name, fields=fields, constants=found.definition.constants)

    def _field_type(self, field: MsgField, file: str, inside: tuple[str, ...]) -> Type:
        element = field.element
        if isinstance(element, NamedType):
            element = self._nested(element.name.replace("/", "/msg/"), SourceSpan(file, field.line), inside)
        if field.shape is None:
            return element
        return List(element, field.shape.length, field.shape.bound)

    def _nested(self, name: str, span: SourceSpan, inside: tuple[str, ...]) -> MessageType:
        if name in inside:
            chain = " > ".join([*inside[inside.index(name) :], name])
            raise TableError([Diagnostic(span, Code.BAD_FILE, f"{name} contains itself: {chain}")])
        nested = self._get(name, inside)
        if nested is None:
            message = f"there is no ROS message type '{name}'"
            raise TableError([Diagnostic(span, Code.UNKNOWN_ROS_TYPE, message, did_you_mean(name, self.names()))])
        return nested


def ros_interfaces() -> RosInterfaces:
    """The interfaces of this machine and this repository."""
    return RosInterfaces(msg_files(), RosbagsDefinitions())


def definition(message: MessageType) -> tuple[tuple[str, str], ...]:
    """Field names and types as rclpy's `get_fields_and_field_types()` spells them."""
    return tuple((field.name, _spelled(field.type)) for field in message.fields)


def _spelled(type_: Type) -> str:
    if isinstance(type_, List):
        element = _spelled(type_.element)
        if type_.length is not None:
            return f"{element}[{type_.length}]"
        return f"sequence<{element}{f', {type_.bound}' if type_.bound is not None else ''}>"
    if isinstance(type_, Bool):
        return "boolean"
    if isinstance(type_, Float):
        return "float" if type_.bits == 32 else "double"
    if isinstance(type_, Int):
        return "octet" if type_.octet else str(type_)
    if isinstance(type_, String):
        return ("wstring" if type_.wide else "string") + (f"<{type_.bound}>" if type_.bound is not None else "")
    if not isinstance(type_, MessageType):
        raise TypeError(f"ROS has no type {type_}")
    package, _, rest = type_.name.partition("/")
    return f"{package}/{rest.rpartition('/')[2]}"  # whether it belongs to a service or action is not told
