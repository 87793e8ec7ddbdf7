"""Datagrams by the million: the carrier decides about each as the oracle does.

    python -m benchmarks.fuzz_carrier --count 1000000 --seed 1

Made by the grammar in tests/carrier/datagrams.py, for the schemas of tests/carrier/decisions.py in equal parts. Exits 1
for any difference, and prints the first ones in hexadecimal digits.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from router.declared import MAX_DATAGRAM
from tests.carrier.datagrams import Maker
from tests.carrier.decisions import SCHEMAS, CarrierSide, native_library, table
from tests.oracles.envelopes import decide

SHOWN = 20


def fuzz(schema: str, count: int, seed: int, found: Callable[[str], None]) -> Counter[str]:
    """Compare `count` datagrams of a schema. Returns the number of each decision; `found` is called for differences."""
    with tempfile.TemporaryDirectory() as folder:
        made = table(schema, Path(folder))
        carrier = CarrierSide(native_library(), made)
    noise = random.Random(seed)
    maker = Maker(made.envelopes.first.message_class.DESCRIPTOR, noise)  # type: ignore[arg-type]  # or upb's
    decisions: Counter[str] = Counter()
    for _ in range(count):
        data, repairs = maker.datagram(), noise.random() < 0.7
        expected = decide(made.envelopes.first, made.inbound, data, MAX_DATAGRAM, repairs)
        decided = carrier.decide(data, repairs)
        decisions[expected.reason or "accepted"] += 1
        if decided != expected:
            found(f"{schema} {data.hex()} {repairs=}: {decided}, not {expected}")
    return decisions


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    differences: list[str] = []
    for schema in SCHEMAS:
        decisions = fuzz(schema, arguments.count // len(SCHEMAS), arguments.seed, differences.append)
        print(f"{schema}: {', '.join(f'{number} {reason}' for reason, number in decisions.most_common())}")
    for difference in differences[:SHOWN]:
        print(difference, file=sys.stderr)
    print(f"{len(differences)} differences")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
