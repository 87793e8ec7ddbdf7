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
from tests.carrier.evaluating import CDR_HEADER, SOURCES, Layout, Operation
from tests.carrier.fuzz.compiling import HERE, Compile, for_libfuzzer
from tests.carrier.fuzz.random_programs import Program, random_program

PROGRAMS = 300


def build(folder: Path, compile_: Compile = for_libfuzzer, first: int = 0) -> Path:
    """Return the program. `folder` gets it, `programs.h` and `corpus`."""
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    noise = random.Random(first)
    declarations = ['#include "operations.h"', _STRUCTURE]
    rows = []
    for index in range(PROGRAMS):
        program = random_program(first + index)
        declarations += _arrays(index, program)
        rows.append(_row(index, program))
        messages = (
            [bytes(380), b"\1\0\0\0" * 95, noise.randbytes(60)] if program.layout.is_cdr else [b"", noise.randbytes(40)]
        )
        for number, message in enumerate(messages):
            head = struct.pack("<HB", index, 0) + (CDR_HEADER if program.layout.is_cdr else b"")
            (corpus / f"{index}-{number}").write_bytes(head + message)
    declarations.append(f"enum {{ PROGRAM_COUNT = {len(rows)} }};")
    declarations.append(f"static const struct fuzzed programs[] = {{{', '.join(rows)}}};")
    (folder / "programs.h").write_text("\n".join(declarations) + "\n")
    made = folder / "machine_fuzz"
    compile_([HERE / "machine_fuzz.c", *(NATIVE / name for name in SOURCES)], made)
    return made


_STRUCTURE = "struct fuzzed { struct layout layout; struct code condition, message; int has_envelope; };"


def _arrays(index: int, program: Program) -> Iterator[str]:
    literals = bytearray()
    for name, code in (("condition", program.condition), ("message", program.message)):
        yield _bytes(f"{name}_{index}", b"".join(operation.packed(literals) for operation in code))
    yield _bytes(f"literals_{index}", bytes(literals))
    yield from _layout(index, program.layout)


def _bytes(name: str, data: bytes) -> str:
    return f"static const _Alignas(8) uint8_t {name}[] = {{{', '.join(map(str, data or b'0'))}}};"


def _layout(index: int, layout: Layout) -> Iterator[str]:
    nodes = []
    for number, node in enumerate(layout.nodes):
        name = f"node_{index}_{number}"
        yield _bytes(name, b"".join(entry.packed() for entry in node.entries))
        nodes.append(f"{{{{(const void *){name}}}, {len(node.entries)}, {node.first_slot}, {node.slot_count}}}")
    yield f"static const struct node nodes_{index}[] = {{{', '.join(nodes)}}};"
    yield f"static const struct value defaults_{index}[{layout.slot_count}];"
    closed = []
    for number, numbers in enumerate(layout.closed):
        yield f"static const int32_t closed_{index}_{number}[] = {{{', '.join(map(str, numbers))}}};"
        closed.append(f"{{closed_{index}_{number}, {len(numbers)}, 0}}")
    yield f"static const struct closed_enum closed_{index}[] = {{{', '.join(closed)}}};"


def _row(index: int, program: Program) -> str:
    layout = f"{{nodes_{index}, defaults_{index}, closed_{index}, literals_{index}, {program.layout.slot_count}, {int(program.layout.is_cdr)}}}"
    return f"{{{layout}, {_code(f'condition_{index}', program.condition)}, {_code(f'message_{index}', program.message)}, 0}}"


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
