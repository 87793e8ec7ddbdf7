"""Build the libFuzzer target for `envelope_read`, and seeds for it.

    python -m tests.carrier.fuzz.build /tmp/fuzz
    cd /tmp/fuzz && ./envelope_fuzz -runs=100000000 -max_len=400 corpus

Takes clang with its sanitizers. The folder is made; `corpus` in it grows while the target runs.
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Iterator
from pathlib import Path

from router.carrier.build import NATIVE, compile_c
from router.carrier.schema import WireSchema, wire_schema
from tests.carrier.datagrams import Maker
from tests.carrier.decisions import SCHEMAS, TESTS, table

HERE = Path(__file__).parent
GOLDEN = TESTS / "wire" / "golden_envelopes.json"
SEEDS_OF_A_SCHEMA = 300


def build(folder: Path) -> Path:
    """Return the program. `folder` gets it, `schemas.h` and `corpus`."""
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    declarations: list[str] = []
    noise = random.Random(1)
    for index, name in enumerate(SCHEMAS):
        made = table(name, folder)
        declarations += _arrays(index, wire_schema(made.envelope, made.inbound))
        maker = Maker(made.envelope.message_class.DESCRIPTOR, noise)  # type: ignore[arg-type]  # or upb's
        seeds = [maker.datagram() for _ in range(SEEDS_OF_A_SCHEMA)]
        if name == "rover":
            seeds += [bytes.fromhex(each["hex"]) for each in json.loads(GOLDEN.read_text())]
        for number, seed in enumerate(seeds):
            (corpus / f"{name}-{number}").write_bytes(seed)
    declarations.append(f"enum {{ SCHEMA_COUNT = {len(SCHEMAS)} }};")
    schemas = ", ".join(
        f"{{types_{index}, sizeof types_{index} / sizeof *types_{index}}}" for index in range(len(SCHEMAS))
    )
    declarations.append(f"static const struct wire_schema schemas[] = {{{schemas}}};")
    (folder / "schemas.h").write_text("\n".join(declarations) + "\n")
    flags = ["-O2", "-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]
    files = [HERE / "envelope_fuzz.c", NATIVE / "envelope.c"]
    program = folder / "envelope_fuzz"
    compile_c([*flags, f"-I{NATIVE}", f"-I{folder}", *map(str, files), "-o", str(program)], "clang")
    return program


def _arrays(index: int, lowered: WireSchema) -> Iterator[str]:
    """The types of a schema in C, as `types_INDEX`."""
    for number, fields in enumerate(lowered.fields):
        values = ", ".join(f"{{{field.number}, {field.kind}, {field.flags}, {field.type}}}" for field in fields)
        yield f"static const struct wire_field fields_{index}_{number}[] = {{{values or '{0, 0, 0, 0}'}}};"
    types = ", ".join(
        f"{{fields_{index}_{number}, {each.count}, {each.accepts_zero}}}" for number, each in enumerate(lowered.types)
    )
    yield f"static const struct wire_type types_{index}[] = {{{types}}};"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    print(build(parser.parse_args().folder))


if __name__ == "__main__":
    main()
