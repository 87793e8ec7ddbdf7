"""Byte streams by the million: the carrier finds the frames in them that the oracle finds.

    python -m benchmarks.fuzz_framings --count 1000000 --seed 1

Frames of all framings and checksums, with bits flipped, and bytes lost, doubled and cut off; and random bytes; each
stream in random pieces. Exits 1 for any difference, and prints the first ones in hexadecimal digits.
"""

from __future__ import annotations

import argparse
import random
import sys
from itertools import pairwise

from router.declared import MAX_DATAGRAM
from router.library import library
from tests.carrier.test_framing import FRAMINGS, read, written
from tests.oracles import framings as oracle

SHOWN = 20
SPECIAL = b"\x00\x01\x03\x5d\x5e\x7d\x7e\x7f\x80\xa5\xc0\xdb\xdc\xdd\xff"


def noise(source: random.Random, most: int) -> bytes:
    """Random bytes, many of them with a meaning in some framing."""
    size = source.randrange(most)
    return bytes(source.choice(SPECIAL) if source.random() < 0.3 else source.randrange(256) for _ in range(size))


def damaged(source: random.Random, stream: bytearray) -> bytes:
    for _ in range(source.randrange(4)):
        if not stream:
            break
        at, how = source.randrange(len(stream)), source.randrange(4)
        if how == 0:
            stream[at] ^= 1 << source.randrange(8)
        elif how == 1:
            del stream[at]
        elif how == 2:
            stream.insert(at, stream[at])
        else:
            del stream[at : at + source.randrange(1, 9)]
    return bytes(stream)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    source, native = random.Random(arguments.seed), library()
    frames = differences = 0
    for _ in range(arguments.count):
        framing = source.choice(FRAMINGS)
        if source.random() < 0.2:
            stream = noise(source, 120)
        else:
            payloads = [noise(source, 40) for _ in range(source.randrange(1, 5))]
            stream = damaged(source, bytearray(b"".join(written(native, framing, each) for each in payloads)))
        cuts = sorted(source.randrange(len(stream) + 1) for _ in range(source.randrange(4)))
        pieces = [stream[begin:end] for begin, end in pairwise([0, *cuts, len(stream)])]
        found, expected = read(native, framing, pieces), oracle.decoded(framing, stream, MAX_DATAGRAM)
        frames += len(expected[0])
        differences += found != expected
        if found != expected and differences <= SHOWN:
            print(f"{framing} {stream.hex()}: {found}, not {expected}", file=sys.stderr)
    print(f"{arguments.count} streams, {frames} frames, {differences} differences")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
