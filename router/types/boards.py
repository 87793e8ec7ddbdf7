"""What a board can take: boards decode with nanopb into structures of a fixed size.

Knows payload cases; which of them go to a board is the table's business.
"""

from __future__ import annotations

from router.errors import Code, Diagnostic, SourceSpan
from router.types.descriptors import container
from router.types.protobuf import PayloadCase, ProtoSchema
from router.types.sizes import Unbounded, framed_size, unbounded_fields


def board_findings(case: PayloadCase, schema: ProtoSchema, limit: int, span: SourceSpan) -> list[Diagnostic]:
    """Why a board cannot take this payload case; empty when it can.

    `limit` is the largest envelope in bytes that boards accept (see `lock.locked_size`), `span` the place in
    the table that sends the case to a board.
    """
    unbounded = unbounded_fields(schema.descriptor(case.type.name), schema.board_options)
    findings = [_unbounded_finding(case, found, schema, span) for found in unbounded]
    if case.max_size is not None and (size := framed_size(case.number, case.max_size)) > limit:
        message = f"an envelope with {case.name} takes up to {size} bytes; boards reject more than {limit}"
        hint = f"see {schema.span(case.type.name)}; make it smaller, or flash the boards and record it in the lock"
        findings.append(Diagnostic(span, Code.BOARD_PAYLOAD, message, hint))
    return findings


def _unbounded_finding(case: PayloadCase, found: Unbounded, schema: ProtoSchema, span: SourceSpan) -> Diagnostic:
    field = found.path[-1]
    path = ".".join((case.name, *(step.name for step in found.path)))
    place = schema.span(container(field).full_name, field.name)
    hint = f"see {place}; bound it in an .options file beside the .proto, as nanopb does"
    return Diagnostic(span, Code.BOARD_PAYLOAD, f"a board cannot take {path}: it {found.why}", hint)
