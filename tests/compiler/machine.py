"""Runs plans on the machine in C, for payloads of any type, made from objects with their fields."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from types import SimpleNamespace
from typing import Any

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from router.carrier.build import LIBRARY, build, is_current
from router.compiler.checked import CheckedRoute, Target
from router.compiler.lowering import lower_table
from router.compiler.plan import Record
from router.errors import Located, MappingError, SourceSpan
from router.table.model.targets import Topic
from router.types.model import Bool, Bytes, Enum, Float, Int, List, MessageType, String, Type
from router.types.protobuf import PayloadCase
from tests.carrier.delivering import Delivering, delivering


class NonFiniteError(MappingError):
    """The carrier has dropped the message as `non_finite`."""


FAILURES = (ArithmeticError, ValueError, LookupError, struct.error, MappingError)
"""Exceptions for a message without a result, here and in the oracle."""

_ROUTE = "route"
_OF: dict[type, Callable[[Any], int]] = {
    Bool: lambda _: FieldDescriptorProto.TYPE_BOOL,
    Int: lambda declared: (
        (FieldDescriptorProto.TYPE_INT64 if declared.signed else FieldDescriptorProto.TYPE_UINT64)
        if declared.bits == 64
        else (FieldDescriptorProto.TYPE_INT32 if declared.signed else FieldDescriptorProto.TYPE_UINT32)
    ),
    Float: lambda declared: (
        FieldDescriptorProto.TYPE_FLOAT if declared.bits == 32 else FieldDescriptorProto.TYPE_DOUBLE
    ),
    String: lambda _: FieldDescriptorProto.TYPE_STRING,
    Bytes: lambda _: FieldDescriptorProto.TYPE_BYTES,
    Enum: lambda _: FieldDescriptorProto.TYPE_INT32,
}


def machine(
    plan: Record, source: MessageType, target: MessageType, received_at: int, sender: str
) -> Callable[[Any], bytes]:
    """A function from a message to the bytes that the plan gives. It raises one of FAILURES if there are none."""
    case = payload_of(source)
    span = SourceSpan("table.yaml", 7, 3, 9)
    checked = Target(Topic(Located("topic", span), span), type=target, plan=plan)
    route: Any = SimpleNamespace(name=_ROUTE, ttl=None, ignore=None, span=span)
    lowered, findings = lower_table([CheckedRoute(route, case, (checked,))])
    assert not findings, findings
    carrier = Delivering(functions(), lowered.to_topics[_ROUTE], received_at, sender)

    def make(message: Any) -> bytes:
        payload: Any = case.message_class()
        _fill(payload, source, message)
        (outcome,) = carrier.datagram(payload.SerializeToString())
        if isinstance(outcome.got, str):
            raise NonFiniteError(outcome.got) if outcome.got == "non_finite" else MappingError(outcome.got)
        return outcome.got

    return make


@cache
def functions() -> ctypes.CDLL:
    """The functions with which tests deliver messages on the machine in C."""
    folder = Path(mkdtemp())
    library = LIBRARY if is_current() else build(folder / LIBRARY.name)
    return delivering(folder / "delivering.so", library, is_sanitized=False)


# ---- payloads of any type


def payload_of(source: MessageType) -> PayloadCase:
    """A payload with the fields of a type. Its integers have protobuf's widths."""
    file = FileDescriptorProto(name="made.proto", package="made", syntax="proto2")
    names: list[tuple[MessageType, str]] = []
    payload = _declare(source, file, names)
    pool = DescriptorPool()
    pool.Add(file)
    return PayloadCase("payload", 1, source, GetMessageClass(pool.FindMessageTypeByName(f"made.{payload}")), None)


def _declare(declared: MessageType, file: FileDescriptorProto, names: list[tuple[MessageType, str]]) -> str:
    for known, name in names:
        if known is declared:
            return name
    name = f"M{len(names)}"
    names.append((declared, name))
    message: DescriptorProto = file.message_type.add(name=name)
    for number, field in enumerate(declared.fields, 1):
        of = field.type.element if isinstance(field.type, List) else field.type
        made = message.field.add(name=field.name, number=number, label=3 if isinstance(field.type, List) else 1)
        if isinstance(of, MessageType):
            made.type, made.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".made.{_declare(of, file, names)}"
        else:
            made.type = _OF[type(of)](of)  # type: ignore[assignment]
    return name


def _fill(payload: Any, declared: MessageType, value: Any) -> None:
    """Fill a payload; fields that the value lacks are left out."""
    for field in declared.fields:
        given = getattr(value, field.name, None)
        if given is None:
            continue
        if isinstance(field.type, MessageType):
            getattr(payload, field.name).SetInParent()
            _fill(getattr(payload, field.name), field.type, given)
        elif isinstance(field.type, List):
            for element in given:
                _add(getattr(payload, field.name), field.type.element, element)
        else:
            setattr(payload, field.name, given)


def _add(to: Any, declared: Type, element: Any) -> None:
    if isinstance(declared, MessageType):
        _fill(to.add(), declared, element)
    else:
        to.append(element)
