"""Messages of topics as Python and as the carrier make them: a payload in, CDR bytes or the reason of a refusal out."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import byref, c_bool, c_int64, c_size_t, c_uint32, c_void_p
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from router.carrier import structures as c
from router.carrier.build import NATIVE, compile_c
from router.carrier.publishing import native_route, native_values
from router.compiler.cdr import write_message
from router.compiler.checked import CheckedRoute, CheckedTarget
from router.compiler.expressions import ParsedReads, Scope, Typed, check
from router.compiler.lowering import LoweredRoute, lower
from router.compiler.mapping import build
from router.compiler.namespace import NAMESPACE
from router.compiler.source import Source
from router.engine.delivery import MAPPING_FAILURES
from router.errors import NonFiniteError
from router.table.model import FieldMap
from router.types.model import MessageType
from router.types.protobuf import PayloadCase
from tests.carrier.building import MEMORY, sanitizing
from tests.compiler.compiling import RECEIVED_AT, SOURCE, SPAN, written
from tests.compiler.payloads import Wire

TOPIC = "topic"
MAPPING_ERROR, NON_FINITE, FILTERED = "mapping_error", "non_finite", "filtered"
_COUNTED = ("", FILTERED, MAPPING_ERROR, NON_FINITE)

Compose = Callable[[bytes], "bytes | str"]
"""Returns the message that a payload gives, else FILTERED or why it is refused."""


def composing(output: Path, library: Path, *, is_sanitized: bool) -> ctypes.CDLL:
    """The functions of composing.c, in a library that is made as `output` and uses that of the carrier."""
    flags = [*(sanitizing(MEMORY) if is_sanitized else ["-O1"]), "-fPIC", "-shared", f"-I{NATIVE}"]
    files = [str(Path(__file__).parent / "composing.c"), str(library)]
    compile_c([*flags, *files, "-o", str(output)], "gcc" if is_sanitized else None)
    loaded = ctypes.CDLL(str(output))
    loaded.seam_composing_open.restype, loaded.seam_composing_open.argtypes = c_void_p, (c_void_p,)
    loaded.seam_composing_close.restype, loaded.seam_composing_close.argtypes = None, (c_void_p,)
    loaded.seam_compose.restype = c_bool
    loaded.seam_compose.argtypes = (
        c_void_p, c_void_p, c_uint32, ctypes.c_char_p, c_uint32, c_bool, c_int64, c_void_p, c_void_p
    )  # fmt: skip
    return loaded


class Composer:
    """Composes the messages of all topics of a route."""

    def __init__(self, library: ctypes.CDLL, lowered: LoweredRoute) -> None:
        self._library = library
        self._arrays: list[object] = []
        self._route = native_route(lowered, self._arrays)
        self._route.sources = native_values([SOURCE.encode()], self._arrays)
        topic = c.PublishTopic()
        for target in self._route.targets[: len(lowered.targets)]:
            target.topic = ctypes.pointer(topic)
            target.filtered, target.mapping_error, target.non_finite = 1, 2, 3
        self._arrays.append(topic)
        self._places = {label: index for index, label in enumerate(lowered.targets)}
        self._counters = (c_int64 * len(_COUNTED))()
        self._address = library.seam_composing_open(self._counters)

    def __del__(self) -> None:
        self._library.seam_composing_close(self._address)

    def __call__(self, data: bytes, topic: str = TOPIC, *, is_single: bool = True) -> bytes | str:
        """Without `is_single` the data are an envelope."""
        for index in range(len(_COUNTED)):
            self._counters[index] = 0
        message, size = c_void_p(), c_size_t()
        is_made = self._library.seam_compose(
            self._address, byref(self._route), self._places[topic], data, len(data), is_single, RECEIVED_AT,
            byref(message), byref(size),
        )  # fmt: skip
        if is_made:
            assert not any(self._counters)
            return ctypes.string_at(message.value or 0, size.value)
        (reason,) = [reason for reason, count in zip(_COUNTED, self._counters, strict=True) if count]
        return reason


class Misfit(Exception):
    """What is wrong with a mapping."""


def both(
    library: ctypes.CDLL,
    wire: Wire,
    case: PayloadCase,
    fields: FieldMap,
    target: MessageType,
    when: str = "",
    ros_types: tuple[MessageType, ...] = (),
) -> tuple[Compose, Compose]:
    """How Python and the carrier compose a mapping. Raises Unlowered, Misfit, or ExpressionError for `when`."""
    schema, envelope = wire
    scope = Scope(case.type, tuple(schema.enums.values()), ros_types, ParsedReads())
    condition = check(written(when), scope) if when else None
    mapping = build(fields, target, scope, SPAN)
    if mapping.findings:
        raise Misfit(mapping.findings)
    declared = cast("Any", SimpleNamespace(when=when, span=SPAN, endpoint=SimpleNamespace(value=TOPIC)))
    checked = CheckedTarget(declared, None, target, scope.reads, condition, mapping.plan, tuple(mapping.rows))
    route = CheckedRoute(cast("Any", SimpleNamespace(name="route")), case, (checked,))
    carrier = Composer(library, lower(route, [checked], envelope))
    return _in_python(case, checked, condition), carrier


def _in_python(case: PayloadCase, target: CheckedTarget, condition: Typed | None) -> Compose:
    assert target.plan is not None
    assert target.reads is not None
    out = Source()
    with out.block("def serialize(m, source, received_at):", SPAN):
        target.reads.write(out, SPAN)
        if condition is not None:
            with out.block(f"if not {out.expression(condition.node)}:", SPAN):
                out.line("return None", SPAN)
        out.line(f"return {write_message(out, target.plan, 'it')}", SPAN)
    namespace: dict[str, Any] = {**NAMESPACE, **out.constants}
    exec(out.compile("table.yaml"), namespace)  # noqa: S102 - what is tested
    parse, serialize = case.message_class.FromString, namespace["serialize"]

    def compose(payload: bytes) -> bytes | str:
        try:
            message = serialize(parse(payload), SOURCE, RECEIVED_AT)
        except MAPPING_FAILURES as error:
            return reason_of(error)
        return FILTERED if message is None else bytes(message)

    return compose


def reason_of(error: BaseException | None) -> str:
    return NON_FINITE if isinstance(error, NonFiniteError) else MAPPING_ERROR
