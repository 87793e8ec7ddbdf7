"""Commands as Python and as the carrier convert them: CDR bytes in, a datagram or a refusal out."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

from router.carrier.commands import native_reads, native_writes
from router.compiler.cdr import CdrReads
from router.compiler.checked import CheckedSubscription, CheckedTarget
from router.compiler.commands import MOST_SLOTS, Command, lower
from router.compiler.expressions import Scope
from router.compiler.mapping import build
from router.engine.delivery import MAPPING_FAILURES
from router.table.model import FieldMap, OnLimit
from router.types.model import MessageType
from router.types.protobuf import PayloadCase
from tests.compiler.compiling import SPAN
from tests.compiler.payloads import Wire

MOST_CONVERTED = 65536

Convert = Callable[[bytes], "bytes | None"]
"""Returns the datagram of a serialized message, None for a mapping_error."""


class Slot(ctypes.Structure):
    """`struct slot` in convert.h."""

    _fields_ = (("start", ctypes.c_size_t), ("count", ctypes.c_uint32))


def lowered(wire: Wire, case: PayloadCase, fields: FieldMap, source: MessageType) -> Command:
    """What the compiler makes of a mapping without findings. Raises NeedsPythonError."""
    schema, _ = wire
    reads = CdrReads(source)
    mapping = build(fields, case.type, Scope(source, tuple(schema.enums.values()), (), reads), SPAN)
    assert mapping.findings == []
    declared = cast(
        "Any", SimpleNamespace(on_limit=OnLimit.FIRST, when=None, span=SPAN, endpoint=SimpleNamespace(value="board"))
    )
    target = CheckedTarget(declared, plan=mapping.plan, rows=tuple(mapping.rows))
    topic = cast("Any", SimpleNamespace(span=SPAN))
    route = cast("Any", SimpleNamespace(name="route", ttl=None))
    return lower(route, case, CheckedSubscription(topic, source, reads, None, None, None, (target,)))


def in_python(convert: Callable[[Any], bytes]) -> Convert:
    """With failures as the engine counts them, and no more bytes than UDP takes."""

    def outcome(message: bytes) -> bytes | None:
        try:
            datagram = convert(message)
        except MAPPING_FAILURES:
            return None
        return datagram if len(datagram) < MOST_CONVERTED else b""

    return outcome


def by_carrier(functions: ctypes.CDLL, command: Command) -> Convert:
    """The datagram of its first target."""
    reads, writes = native_reads(command), native_writes(command.targets[0])
    slots = (Slot * MOST_SLOTS)()
    datagram = ctypes.create_string_buffer(MOST_CONVERTED)
    size = ctypes.c_size_t()

    def convert(message: bytes) -> bytes | None:
        # Of the exact size, so that a sanitizer sees what is read behind it.
        copy = (ctypes.c_char * len(message)).from_buffer_copy(message) if message else b""
        if not functions.message_read(reads.reads, reads.read_count, copy, len(message), slots):
            return None
        if not functions.datagram_write(
            writes.writes, writes.write_count, writes.literals, copy, slots, datagram, ctypes.byref(size)
        ):
            return None
        return datagram.raw[MOST_CONVERTED - size.value :] if size.value < MOST_CONVERTED else b""

    return convert
