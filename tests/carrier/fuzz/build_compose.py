"""Build the libFuzzer target for the messages of topics, and seeds for it.

    python -m tests.carrier.fuzz.build_compose /tmp/fuzz_compose
    cd /tmp/fuzz_compose && ./compose_fuzz -runs=100000000 -max_len=400 corpus

Takes clang with its sanitizers. The folder is made; `corpus` in it grows while the target runs.
"""

from __future__ import annotations

import argparse
import random
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from router.carrier.build import NATIVE
from router.compiler import check_table
from router.compiler.checked import CheckedRoute, CheckedTarget
from router.compiler.expressions import ParsedReads, Scope, check
from router.compiler.lowering import LoweredRoute, lower
from router.compiler.lowering.operations import Code
from router.compiler.mapping import build as build_mapping
from router.table.model import FieldMap
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.protobuf import Envelope
from tests.carrier.datagrams import Maker
from tests.carrier.fuzz.compiling import HERE, Compile, for_libfuzzer
from tests.compiler.compiling import AUTO, SPAN, field_map, written
from tests.compiler.payloads import made_wire
from tests.tables import ROUTES

SEEDS = 40

U8, I32, U32, I64, U64, F32, F64 = (
    Int(8, False), Int(32, True), Int(32, False), Int(64, True), Int(64, False), Float(32), Float(64)
)  # fmt: skip


def _type(**fields: Type) -> MessageType:
    return MessageType("made/msg/Fuzzed", tuple(Field(name, type_) for name, type_ in fields.items()))


_POINT = _type(x=F32, y=F64)
_INNER = _type(numbers=List(I32), texts=List(String()), points=List(_POINT))

COMPOSITIONS: list[tuple[str, FieldMap, MessageType, str]] = [
    ("scalars", AUTO, _type(i32=I32, s32=I32, sf32=I32, u32=U32, f32=U32, i64=I64, s64=I64, sf64=I64, u64=U64, f64=U64,
                            single=F32, real=F64, flag=Bool(), text=String(), data=List(U8)), ""),
    ("scalars", field_map(a="i32 // 7 + i64 % -3", b="round(real * single)", c="source + text + str(u64)",
                          d="hypot(real, single) ** 2", e="clamp(round(real), -5, 5)",
                          f="clamp(len(text) - len(data), -9, 9)", g='text if flag and text < "m" else source'),
     _type(a=I64, b=I64, c=String(), d=F64, e=I32, f=I32, g=String()), 'flag or real > 0.5 or text == "a"'),
    ("scalars", field_map(a="i32 // s32 + i64 % u32", b="real / single", c="sqrt(real) + sin(single)"),
     _type(a=I64, b=F64, c=F64), "s32 != 0 and not (u32 < 2)"),
    ("scalars", field_map(a="wrap(i32, -7, 9)", b="abs(real) % 1.5 + min(single, 2.0) // 0.25",
                          c="clamp(floor(real), -9, 9) + clamp(ceil(single), 0, 7)",
                          d="atan2(real, single) - max(real, -single)", e="degrees(single)"),
     _type(a=I32, b=F64, c=I64, d=F64, e=F64), ""),
    ("optional", AUTO, _type(number=I32, single=F32, flag=Bool(), text=String(), data=List(U8), point=_POINT), ""),
    ("many", AUTO, _type(numbers=List(I64), singles=List(F32), texts=List(String()), flags=List(Bool()),
                         points=List(_POINT), many=List(_INNER)), ""),
    ("many", field_map(a="numbers[0] + len(points)", b="points[0].x", c="texts[0] + texts[0]"),
     _type(a=I64, b=F64, c=String()), "len(many) < 3"),
    ("choice", AUTO, _type(number=I32, point=_POINT, text=String(), flag=Bool()), ""),
    ("choice", field_map(a="number", b="text"), _type(a=I32, b=String()), ""),
    ("stamped", field_map(a="stamp.seconds", b="stamp.nanos"), _type(a=I64, b=I32), ""),
    ("bounded", AUTO, _type(text=String(), data=List(U8), few=List(I32), two=List(_POINT)), ""),
    ("names", AUTO, _type(self=I32, it=_POINT), ""),
]  # fmt: skip
"""Payload case, mapping, target and condition of each program, beside those of the rover's table."""

Composition = tuple[LoweredRoute, str, Envelope, str]
"""A route with one of its topics, the envelope and the case that it gets."""


def compositions() -> Iterator[Composition]:
    schema, envelope = made_wire()
    for name, fields, target, when in COMPOSITIONS:
        case = envelope.cases[name]
        scope = Scope(case.type, tuple(schema.enums.values()), (), ParsedReads())
        condition = check(written(when), scope) if when else None
        mapping = build_mapping(fields, target, scope, SPAN)
        assert mapping.findings == [], mapping.findings
        declared = cast("Any", SimpleNamespace(when=when, span=SPAN, endpoint=SimpleNamespace(value="topic")))
        checked = CheckedTarget(declared, None, target, scope.reads, condition, mapping.plan, tuple(mapping.rows))
        route = CheckedRoute(cast("Any", SimpleNamespace(name="route")), case, (checked,))
        yield lower(route, [checked], envelope), "topic", envelope, name
    rover = check_table(ROUTES / "rover.yaml", {}).program
    assert rover is not None
    for handlers in rover.inbound.values():
        for handler in handlers:
            if lowered := rover.lowered.get(handler.route):
                for topic in lowered.targets:
                    yield lowered, topic, rover.envelope, handler.case.name


def build(folder: Path, compile_: Compile = for_libfuzzer) -> Path:
    """Return the program. `folder` gets it, `compositions.h` and `corpus`."""
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    noise, declarations, rows = random.Random(1), [_STRUCTURE], []
    for index, (lowered, topic, envelope, case) in enumerate(compositions()):
        target = lowered.targets[topic]
        literals = bytearray()
        declarations += _operations(f"condition_{index}", target.condition, literals)
        declarations += _operations(f"operations_{index}", target.operations, literals)
        declarations += _nodes(index, lowered)
        declarations.append(f"static const uint8_t literals_{index}[] = {{{', '.join(map(str, literals or b'0'))}}};")
        rows.append(
            f"{{nodes_{index}, defaults_{index}, literals_{index}, condition_{index}, operations_{index}, "
            f"{len(lowered.layout.defaults)}, {len(target.condition)}, {len(target.operations)}}}"
        )
        around, payload = (
            Maker(each.message_class.DESCRIPTOR, noise)  # type: ignore[arg-type]  # or upb's
            for each in (envelope, envelope.cases[case])
        )
        for seed in range(SEEDS):
            (corpus / f"{index}-{seed}").write_bytes(bytes([index, 0]) + payload.message())
            (corpus / f"{index}-{seed}-in").write_bytes(bytes([index, 1]) + around.datagram())
    declarations.append(f"enum {{ COMPOSITION_COUNT = {len(rows)} }};")
    declarations.append(f"static const struct composition compositions[] = {{{', '.join(rows)}}};")
    (folder / "compositions.h").write_text("\n".join(declarations) + "\n")
    program = folder / "compose_fuzz"
    compile_([HERE / "compose_fuzz.c", NATIVE / "compose.c", NATIVE / "fields.c"], program)
    return program


_STRUCTURE = (
    "struct composition { const struct node *nodes; const struct value *defaults; const uint8_t *literals; "
    "const struct operation *condition, *operations; uint32_t slot_count, condition_count, operation_count; };"
)


def _operations(name: str, code: Code, literals: bytearray) -> Iterator[str]:
    rows = []
    for kind, slot, flag, size, number, data in code:
        bits = _bits(len(literals) if data else number)
        literals += data
        at = slot if isinstance(slot, int) else slot.index
        rows.append(f"{{{int(kind)}, {int(flag)}, {at}, {size}, {{.bits = {bits}u}}}}")
    yield f"static const struct operation {name}[] = {{{', '.join(rows) or '{0}'}}};"


def _nodes(index: int, lowered: LoweredRoute) -> Iterator[str]:
    rows = []
    for number, (fields, first_slot, slot_count) in enumerate(lowered.layout.nodes):
        values = ", ".join(f"{{{', '.join(str(int(value)) for value in each)}}}" for each in fields)
        yield f"static const struct node_field fields_{index}_{number}[] = {{{values or '{0}'}}};"
        rows.append(f"{{fields_{index}_{number}, {len(fields)}, {first_slot}, {slot_count}}}")
    yield f"static const struct node nodes_{index}[] = {{{', '.join(rows)}}};"
    defaults = ", ".join(map(_value, lowered.layout.defaults))
    yield f"static const struct value defaults_{index}[] = {{{defaults}}};"


def _value(value: float | bytes | None) -> str:
    if isinstance(value, bytes):
        text = "".join(f"\\{byte:03o}" for byte in value)
        return f'{{.bytes = (const uint8_t *)"{text}", .size = {len(value)}}}'
    return f"{{.bits = {_bits(value or 0)}u}}"


def _bits(number: float) -> int:
    if isinstance(number, int):
        return number & 0xFFFF_FFFF_FFFF_FFFF
    (bits,) = struct.unpack("@Q", struct.pack("@d", number))
    return int(bits)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    print(build(parser.parse_args().folder))


if __name__ == "__main__":
    main()
