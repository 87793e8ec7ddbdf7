"""Build the libFuzzer target for the conversion of commands from ROS, and seeds for it.

    python -m tests.carrier.fuzz.build_convert /tmp/fuzz_convert
    cd /tmp/fuzz_convert && ./convert_fuzz -runs=100000000 -max_len=400 corpus

Takes clang with its sanitizers. The folder is made; `corpus` in it grows while the target runs.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from router.carrier.build import NATIVE
from router.carrier.commands import native_reads, native_writes
from router.compiler.commands import NO_SLOT, Command
from router.rehearsal.cdr import serialize
from router.table.model import FieldMap
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from tests.carrier.conversions import lowered
from tests.carrier.fuzz.compiling import HERE, Compile, for_libfuzzer
from tests.compiler.compiling import AUTO, field_map
from tests.compiler.payloads import made_wire

SEEDS = 100

U8, I32, I64, F32, F64 = Int(8, False), Int(32, True), Int(64, True), Float(32), Float(64)


def _type(**fields: Type) -> MessageType:
    return MessageType("made/msg/Fuzzed", tuple(Field(name, type_) for name, type_ in fields.items()))


_POINT = _type(name=String(), x=F64)
_LINE = _type(points=List(_POINT), ids=List(I64), triple=List(U8, 3))

CONVERSIONS: list[tuple[str, FieldMap, MessageType]] = [
    ("scalars", AUTO, _type(i32=I32, s32=I32, u32=U8, i64=I64, f64=Int(64, False), single=F32, real=F64, flag=Bool(),
                            text=String(), data=List(U8), rock=U8)),
    ("optional", AUTO, _type(number=I32, text=String(), data=List(U8, 5), point=_type(x=F32, y=F32))),
    ("many", AUTO, _type(numbers=List(I32), singles=List(F32, 3), flags=List(Bool()), rocks=List(Int(16, True)))),
    ("bounded", AUTO, _type(text=String(), data=List(U8), few=List(I32))),
    ("scalars", field_map(single="float32(last)", i32="-1"),
     _type(texts=List(String()), wide=String(wide=True), lines=List(_LINE), spans=List(_type(a=U8, b=F64)), last=F64)),
]  # fmt: skip
"""Payload case, mapping and source of each program."""


def build(folder: Path, compile_: Compile = for_libfuzzer) -> Path:
    """Return the program. `folder` gets it, `conversions.h` and `corpus`."""
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    wire, noise, declarations = made_wire(), random.Random(1), ["#include <stdint.h>", _STRUCTURE]
    for index, (case, fields, source) in enumerate(CONVERSIONS):
        declarations += _arrays(index, lowered(wire, wire[1].cases[case], fields, source))
        for number in range(SEEDS):
            seed = serialize(source, _values(source, noise))
            (corpus / f"{index}-{number}").write_bytes(bytes([index]) + seed)
    rows = ", ".join(
        f"{{reads_{index}, writes_{index}, literals_{index}, READS_{index}, WRITES_{index}, SLOTS_{index}}}"
        for index in range(len(CONVERSIONS))
    )
    declarations.append(f"enum {{ CONVERSION_COUNT = {len(CONVERSIONS)} }};")
    declarations.append(f"static const struct conversion conversions[] = {{{rows}}};")
    (folder / "conversions.h").write_text("\n".join(declarations) + "\n")
    program = folder / "convert_fuzz"
    compile_([HERE / "convert_fuzz.c", NATIVE / "convert.c"], program)
    return program


_STRUCTURE = (
    "struct conversion { const struct read_op *reads; const struct write_op *writes; const uint8_t *literals; "
    "size_t read_count, write_count, slot_count; };"
)


def _arrays(index: int, command: Command) -> Iterator[str]:
    reads, writes = native_reads(command), native_writes(command.targets[0])
    slots = sum(op.slot != NO_SLOT for op in command.reads)
    yield f"enum {{ READS_{index} = {reads.read_count}, WRITES_{index} = {writes.write_count} }};"
    yield f"enum {{ SLOTS_{index} = {slots} }};"
    yield from _array(f"read_op reads_{index}", reads.reads[: reads.read_count])
    yield from _array(f"write_op writes_{index}", writes.writes[: writes.write_count])
    literals = b"".join(op.literal for op in command.targets[0].writes) or b"\0"
    yield f"static const uint8_t literals_{index}[] = {{{', '.join(map(str, literals))}}};"


def _array(name: str, structures: list[Any]) -> Iterator[str]:
    rows = (", ".join(str(getattr(each, field)) for field, *_ in each._fields_) for each in structures)
    yield f"static const struct {name}[] = {{{', '.join(f'{{{row}}}' for row in rows)}}};"


def _values(declared: Type, noise: random.Random) -> Any:
    match declared:
        case MessageType():
            return {field.name: _values(field.type, noise) for field in declared.fields}
        case List():
            length = declared.length if declared.length is not None else noise.randrange(4)
            return [_values(declared.element, noise) for _ in range(length)]
        case String():
            return "".join(noise.choices("aä€😀", k=noise.randrange(4)))
        case Bool():
            return bool(noise.randrange(2))
        case Int():
            return noise.choice([0, 1, declared.low, declared.high, noise.randint(declared.low, declared.high)])
        case _:
            return noise.choice([0.0, -0.0, 1.5, float("nan"), float("inf")])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    print(build(parser.parse_args().folder))


if __name__ == "__main__":
    main()
