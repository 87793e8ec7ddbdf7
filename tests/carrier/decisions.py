"""The carrier's decisions about datagrams, for schemas with fields of every kind."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from pathlib import Path

from router.carrier.build import build, is_current
from router.compiler.compiled_table import CompiledTable
from router.compiler.lowering.arrays import Arrays
from router.compiler.metrics import REJECT_REASONS
from router.declared import MAX_DATAGRAM, Bytes, Envelope
from router.image.wire_schema import write_schema
from router.library import load
from tests.carrier.delivering import Payload
from tests.oracles.envelopes import Decision
from tests.small_tables import program
from tests.tables import PROTOS

TESTS = Path(__file__).parents[1]

HEAD = """version: 1
envelope: {protos: PROTOS, CHOICE}
listen:
  trimmed: {address: 127.0.0.1:5000, framing: zero_trimmed}
  exact: {address: 127.0.0.1:5001, framing: exact}
endpoints:
  board: {address: 192.168.0.30:8, kind: tool}
  tool: {address: 192.168.0.20:9000, kind: tool}
routes:
"""

ONEOF = "message: PBEnvelope, oneof: payload"
HARD = TESTS / "carrier" / "protos"
SCHEMAS = {
    "rover": (PROTOS, ONEOF, ["imu_info", "drive_diag", "gps_info", "arm_pos", "manual_drive"]),
    "every_kind": (TESTS / "protos", ONEOF, ["every_kind"]),
    "hard": (HARD, ONEOF, ["nothing", "tree", "texts", "scalars", "old", "maps", "far"]),
    "cases": (
        HARD,
        "message: Packet, cases: [nothing, tree, texts, old, unrouted]",
        ["nothing", "tree", "texts", "old"],
    ),
    "frame": (HARD, "message: PBEnvelope, case: frame", ["frame"]),
    "name": (HARD, "message: Wrapped, case: name, payload: data", ["Nothing", "Tree", "Texts", "Scalars", "Maps"]),
}
"""Folders of protos, how the envelope says which message it holds, and the payload cases with a route."""


def native_library() -> ctypes.CDLL:
    """The carrier's library, built first if it is not up to date."""
    if not is_current():
        build()
    return load()


def table(schema: str, folder: Path) -> CompiledTable:
    """A table for one of SCHEMAS, written to a new folder in `folder`, because the oracle reads the file again."""
    protos, choice, cases = SCHEMAS[schema]
    routes = "".join(f"  {case}: {{source: any, destinations: [tool]}}\n" for case in cases)
    own = folder / schema
    own.mkdir(exist_ok=True)
    return program(own, routes, HEAD.replace("CHOICE", choice), protos)


class CarrierSide:
    """`envelope_read` in the carrier's library."""

    def __init__(self, library: ctypes.CDLL, made: CompiledTable) -> None:
        self._memory = Arrays()
        self._schema = write_schema(made.envelopes.first, made.inbound, self._memory)
        self._read = library.envelope_read
        self._reasons = {-1: None, **dict(enumerate(REJECT_REASONS))}
        self._part = library.envelope_part
        self._buffer = (ctypes.c_char * (MAX_DATAGRAM + 8))()
        self._envelope = Envelope()

    def decide(self, data: bytes, repairs: bool) -> Decision:
        kept = data[:MAX_DATAGRAM]
        # Bytes of an earlier datagram behind this one must not count.
        ctypes.memmove(self._buffer, kept + b"\xa5" * 8, len(kept) + 8)
        schema, envelope = self._schema, self._envelope
        code = self._read(ctypes.byref(schema), self._buffer, len(data), repairs, ctypes.byref(envelope))
        return Decision(self._reasons[code], envelope.case_number, envelope.is_repaired, envelope.others)

    def whole(self) -> bytes:
        """The envelope read last, restored."""
        return self._buffer.raw[: self._envelope.size]

    def parts(self) -> Iterator[tuple[int, bytes]]:
        """The messages of the envelope read last: number and frame of each."""
        frame, room = self.whole(), (ctypes.c_char * MAX_DATAGRAM)()
        data = ctypes.create_string_buffer(frame, len(frame))  # of its own length, for the sanitizer
        begin = ctypes.addressof(data)
        envelope = Envelope()
        given = ctypes.byref(self._schema), Bytes(at=begin, end=begin + len(frame))
        while self._part(*given, envelope.case_number, room, ctypes.byref(envelope)):
            yield envelope.case_number, room.raw[: envelope.size]

    def payload(self) -> Payload:
        """The position of the payload read last."""
        return Payload(self._envelope.start, self._envelope.length, self._envelope.is_single)
