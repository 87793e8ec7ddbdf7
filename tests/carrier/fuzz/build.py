"""Build the libFuzzer targets, and seeds for them: `envelope_read`, what becomes of a datagram, `collect`, framings.

    python -m tests.carrier.fuzz.build /tmp/fuzz
    cd /tmp/fuzz && ./envelope_fuzz -runs=100000000 -max_len=400 corpus
    cd /tmp/fuzz && ./handle_fuzz -runs=100000000 -max_len=400 corpus
    cd /tmp/fuzz && ./collect_fuzz -runs=1000000 -max_len=400 corpus
    cd /tmp/fuzz && ./framing_fuzz -runs=100000000 -max_len=400 corpus

Takes clang with its sanitizers. The folder is made; `corpus` in it grows while the target runs.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import random
from collections.abc import Iterator
from pathlib import Path

from router.carrier.build import sources
from router.compiler.lowering.arrays import Arrays
from router.declared import WireName, WireSchema
from router.image.wire_schema import write_schema
from tests.carrier.datagrams import maker_for
from tests.carrier.decisions import SCHEMAS, TESTS, table
from tests.carrier.fuzz.compiling import HERE, Compile, for_libfuzzer

GOLDEN = TESTS / "wire" / "golden_envelopes.json"
SEEDS_OF_A_SCHEMA = 300
TARGETS = ("envelope_fuzz", "handle_fuzz", "collect_fuzz", "framing_fuzz")
INCLUDED = {"handle_fuzz": "carrier.c", "collect_fuzz": "collect.c"}
"""What a target includes: it stands in the place of that source."""


def build(folder: Path, name: str = "envelope_fuzz", compile_: Compile = for_libfuzzer) -> Path:
    """Return the program. `folder` gets it, `schemas.h` and `corpus`."""
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    declarations: list[str] = []
    kinds: list[str] = []
    noise = random.Random(1)
    for index, schema in enumerate(SCHEMAS):
        made = table(schema, folder)
        memory = Arrays()
        lowered = write_schema(made.envelopes.first, made.inbound, memory)
        declarations += _arrays(index, lowered)
        names = f"names_{index}" if lowered.name_count else "NULL"
        numbers = lowered.case_by, names, lowered.name_count, lowered.name_field, lowered.payload_field
        kinds.append(", ".join(map(str, numbers)))
        maker = maker_for(made.envelopes.first, noise)
        seeds = [maker.datagram() for _ in range(SEEDS_OF_A_SCHEMA)]
        if schema == "rover":
            seeds += [bytes.fromhex(each["hex"]) for each in json.loads(GOLDEN.read_text())]
        for number, seed in enumerate(seeds):
            (corpus / f"{schema}-{number}").write_bytes(seed)
            (corpus / f"{schema}-{number}-sent").write_bytes(b"!" + seed)  # for handle_fuzz
    declarations.append(f"enum {{ SCHEMA_COUNT = {len(SCHEMAS)} }};")
    schemas = ", ".join(
        f"{{types_{index}, sizeof types_{index} / sizeof *types_{index}, {rest}}}" for index, rest in enumerate(kinds)
    )
    declarations.append(f"static const struct wire_schema schemas[] = {{{schemas}}};")
    (folder / "schemas.h").write_text("\n".join(declarations) + "\n")
    files = [HERE / f"{name}.c", *(path for path in sources() if path.name != INCLUDED.get(name))]
    program = folder / name
    compile_(files, program)
    return program


def _arrays(index: int, lowered: WireSchema) -> Iterator[str]:
    """The types of a schema in C, as `types_INDEX`."""
    all_types = lowered.types[: lowered.count]
    for number, each in enumerate(all_types):
        fields = each.fields[: each.count]
        values = ", ".join(f"{{{field.number}, {field.kind}, {field.flags}, {field.type}}}" for field in fields)
        yield f"static const struct wire_field fields_{index}_{number}[] = {{{values or '{0, 0, 0, 0}'}}};"
    types = ", ".join(
        f"{{fields_{index}_{number}, {each.count}, {each.accepts_zero}}}" for number, each in enumerate(all_types)
    )
    yield f"static const struct wire_type types_{index}[] = {{{types}}};"
    if names := lowered.names[: lowered.name_count]:
        texts = (f'{{(const uint8_t *)"{_text(name)}", {name.size}, {name.type}, 0}}' for name in names)
        yield f"static const struct wire_name names_{index}[] = {{{', '.join(texts)}}};"


def _text(name: WireName) -> str:
    return ctypes.string_at(name.text, name.size).decode()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    for name in TARGETS:
        print(build(folder, name))


if __name__ == "__main__":
    main()
