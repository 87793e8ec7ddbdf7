"""Messages of constants, which deadmen send in place of commands, and constants beside the payload.

They are lowered like any message, and if anything has to be computed, the machine does it once, when the table is
checked.
"""

from __future__ import annotations

import ctypes

from google.protobuf.descriptor import Descriptor

from router import declared as c
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.lowered import LoweredConstant
from router.compiler.lowering.routines import Routines
from router.compiler.lowering.sources import Constants
from router.compiler.plan import Record
from router.compiler.refusals import why_refused
from router.errors import Code, FindingError
from router.library import library
from router.types.protobuf import PayloadCase


def envelope_of(plan: Record, case: PayloadCase) -> bytes:
    """Write the envelope of a payload. Raises FindingError for a value that does not exist or does not fit."""
    return _written(Constants().envelope(plan, case))


def fields_of(plan: Record, descriptor: Descriptor) -> bytes:
    """Write the fields of a protobuf message. Raises FindingError likewise."""
    return _written(Constants().fields(plan, descriptor))


def cdr_of(plan: Record) -> bytes:
    """Write a ROS message as CDR. Raises FindingError likewise."""
    return _written(Constants().cdr(plan))


def _written(message: LoweredConstant) -> bytes:
    if all(operation.kind is c.Op.KNOWN for operation in message.routine):  # as nearly always
        return b"".join(operation.data for operation in message.routine)
    return _computed(message)


def _computed(message: LoweredConstant) -> bytes:
    """Execute the routine. Raises ConfigurationError without a library that was built from these sources."""
    routines, native = Routines(message.layout, Arrays()), library()
    routine, machine, at = routines.routine(message.routine), c.Machine(), ctypes.c_uint32()
    layout = routines.layout()
    try:
        if not native.machine_open(ctypes.byref(machine)):
            raise MemoryError("a machine cannot be opened")
        native.machine_begin(ctypes.byref(machine), layout)
        outcome = native.evaluate_message(ctypes.byref(machine), ctypes.byref(routine), ctypes.byref(at))
        if outcome == c.EVALUATED:
            output = ctypes.c_void_p.from_buffer(machine.output, c.Output.data.offset)
            return ctypes.string_at(output.value or 0, machine.output.size)
        why = why_refused(machine.refusal, ctypes.string_at(machine.refused.bits, machine.refused.size))
    finally:
        native.machine_close(ctypes.byref(machine))
    raise FindingError(message.places[at.value].span, Code.BAD_VALUE, f"this cannot be sent: {why}")
