"""Build the libFuzzer target for the machine that runs programs, and seeds for it.

    python -m tests.carrier.fuzz.build_machine /tmp/fuzz_machine
    cd /tmp/fuzz_machine && ./machine_fuzz -runs=100000000 -max_len=400 corpus

Takes clang with its sanitizers. The folder is made; `corpus` in it grows while the target runs. Other random programs
come of another `--first`.
"""

from __future__ import annotations

import argparse
import random
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

from router.carrier.build import NATIVE
from router.declared import NONE
from tests.carrier.evaluating import CDR_HEADER, SOURCES, Layout, Operation
from tests.carrier.fuzz.compiling import HERE, Compile, for_libfuzzer
from tests.carrier.fuzz.lowered_programs import Seeds, lowered_programs
from tests.carrier.fuzz.random_programs import ForEach, Program, random_program

RANDOM_PROGRAMS = 300
SEEDS = 10


def build(folder: Path, compile_: Compile = for_libfuzzer, first: int = 0, count: int = RANDOM_PROGRAMS) -> Path:
    """Return the program. `folder` gets it, `programs.h` and `corpus`."""
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    noise = random.Random(first)
    declarations = ['#include "operations.h"', _STRUCTURE]
    rows = []
    made = [(random_program(first + index), _random_seeds) for index in range(count)]
    for index, (program, seeds) in enumerate([*lowered_programs(), *made]):
        declarations += _arrays(index, program)
        rows.append(_row(index, program))
        for number, (is_in_pieces, message) in enumerate(_messages(program, seeds, noise)):
            (corpus / f"{index}-{number}").write_bytes(struct.pack("<HB", index, is_in_pieces) + message)
    declarations.append(f"enum {{ PROGRAM_COUNT = {len(rows)} }};")
    declarations.append(f"static const struct fuzzed programs[] = {{{', '.join(rows)}}};")
    (folder / "programs.h").write_text("\n".join(declarations) + "\n")
    target = folder / "machine_fuzz"
    compile_([HERE / "machine_fuzz.c", *(NATIVE / name for name in SOURCES)], target)
    return target


def _messages(program: Program, seeds: Seeds, noise: random.Random) -> Iterator[tuple[bool, bytes]]:
    """Seeds, and whether each is in pieces."""
    for _ in range(SEEDS):
        whole, pieces = seeds()
        yield from ((is_in_pieces, data) for is_in_pieces, data in ((False, whole), (True, pieces)) if data)
    if program.layout.is_cdr:
        for body in (bytes(380), b"\1\0\0\0" * 95, noise.randbytes(60)):
            yield False, CDR_HEADER + body
    else:
        yield from ((False, body) for body in (b"", noise.randbytes(40)))


def _random_seeds() -> tuple[bytes, bytes]:
    return b"", b""


_STRUCTURE = (
    "struct fuzzed { struct layout layout; struct routine condition, message, list; uint16_t stored, section, item; };"
)


def _arrays(index: int, program: Program) -> Iterator[str]:
    literals = bytearray()
    each = program.for_each.code if program.for_each else []
    for name, code in (("condition", program.condition), ("message", program.message), ("list", each)):
        yield _bytes(f"{name}_{index}", b"".join(operation.packed(literals) for operation in code))
    yield _bytes(f"literals_{index}", bytes(literals))
    yield from _layout(index, program.layout)


def _bytes(name: str, data: bytes) -> str:
    return f"static const _Alignas(8) uint8_t {name}[] = {{{', '.join(map(str, data or b'0'))}}};"


def _layout(index: int, layout: Layout) -> Iterator[str]:
    sections = []
    for number, section in enumerate(layout.sections):
        name = f"section_{index}_{number}"
        yield _bytes(name, b"".join(read.packed() for read in section.reads))
        sections.append(
            f"{{{{(const void *){name}}}, {len(section.reads)}, {section.first_slot}, {section.slot_count}}}"
        )
    yield f"static const struct section sections_{index}[] = {{{', '.join(sections)}}};"
    defaults = ", ".join(f"[{slot}] = {_value(value)}" for slot, value in layout.defaults.items())
    yield f"static const struct value defaults_{index}[{layout.slot_count}] = {{{defaults or '{.size = 0}'}}};"
    closed = []
    for number, numbers in enumerate(layout.closed):
        yield f"static const int32_t closed_{index}_{number}[] = {{{', '.join(map(str, numbers))}}};"
        closed.append(f"{{closed_{index}_{number}, {len(numbers)}, 0}}")
    yield f"static const struct closed_enum closed_{index}[] = {{{', '.join(closed) or '{.count = 0}'}}};"


def _value(value: float | bytes) -> str:
    if isinstance(value, bytes):
        text = "".join(f"\\{byte:03o}" for byte in value)
        return f'{{.bytes = (const uint8_t *)"{text}", .size = {len(value)}}}'
    if isinstance(value, float):
        (value,) = struct.unpack("<Q", struct.pack("<d", value))
    return f"{{.bits = {int(value) % (1 << 64)}u}}"


def _row(index: int, program: Program) -> str:
    layout, each = program.layout, program.for_each or ForEach([], 0, NONE, NONE)
    arrays = ", ".join(f"{name}_{index}" for name in ("sections", "defaults", "closed", "literals"))
    codes = {"condition": program.condition, "message": program.message, "list": each.code}
    code = ", ".join(_code(f"{name}_{index}", code) for name, code in codes.items())
    of_each = f"{int(each.stored)}, {each.section}, {each.item}"
    return f"{{{{{arrays}, {layout.slot_count}, {int(layout.is_cdr)}}}, {code}, {of_each}}}"


def _code(name: str, code: Sequence[Operation]) -> str:
    return f"{{(const void *){name}, {len(code)}, 0}}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    print(build(arguments.folder, first=arguments.first))


if __name__ == "__main__":
    main()
