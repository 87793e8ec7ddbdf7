"""Damaged datagrams by the million into an engine of the rover's table: no exception, counters that balance, no growth.

    python -m benchmarks.fuzz_engine --count 10000000 --seed 1

No sockets: the engine alone, every topic wanted, all 26 payload cases as seeds. Exits 1 for any finding.
"""

from __future__ import annotations

import argparse
import errno
import json
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from router.compiler import check_table
from router.compiler.metrics import Report
from router.compiler.program import Program
from router.types.framing import MAX_DATAGRAM
from tests.engine.rig import Ledger, Rig
from tests.oracles.python_engine import InboundEngine
from tests.oracles.python_engine.freshness import Freshness
from tests.tables import ROUTES

ROOT = Path(__file__).parent.parent
SAMPLE = 500_000
"""Datagrams between two looks at the memory."""

TOLERATED_GROWTH_KIB = 1024
"""What allocators come and go by; a leak of one byte per datagram is ten times this in 10 million."""

Peer = tuple[str, int]
Mutation = Callable[[random.Random, bytes, bytes], bytes]


def flip(noise: random.Random, data: bytes, other: bytes) -> bytes:
    flipped = int.from_bytes(data, "big") ^ 1 << noise.randrange(8 * len(data))
    return flipped.to_bytes(len(data), "big")


def cut(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data[: noise.randrange(len(data))]


def splice(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data[: noise.randrange(len(data))] + other[noise.randrange(len(other)) :]


def join(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data + other


def pad(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data + bytes(noise.randrange(64))


def trim(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data.rstrip(b"\0")


def relength(noise: random.Random, data: bytes, other: bytes) -> bytes:
    """Another byte among the first three: the tag, the length."""
    at = noise.randrange(min(3, len(data)))
    return data[:at] + bytes((noise.randrange(256),)) + data[at + 1 :]


def insert(noise: random.Random, data: bytes, other: bytes) -> bytes:
    at = noise.randrange(len(data))
    return data[:at] + noise.randbytes(noise.randrange(1, 9)) + data[at:]


def garbage(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return noise.randbytes(noise.randrange(128))


def same(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data


MUTATIONS: tuple[Mutation, ...] = (flip, flip, cut, splice, join, pad, trim, relength, insert, garbage, same)


@dataclass(frozen=True)
class Seed:
    """A sound envelope and the addresses of who may send it."""

    data: bytes
    senders: Sequence[Peer]


def datagrams(seeds: Sequence[Seed], strangers: Sequence[Peer], noise: random.Random) -> Iterator[tuple[bytes, Peer]]:
    """Without end: a seed with one or two mutations; now and then one as long as any may be, or longer."""
    while True:
        for seed in noise.sample(seeds, len(seeds)):
            other = noise.choice(seeds).data
            data = noise.choice(MUTATIONS)(noise, seed.data, other)
            if data and noise.random() < 0.3:
                data = noise.choice(MUTATIONS)(noise, data, other)
            yield data, noise.choice(strangers if noise.random() < 0.2 else seed.senders)
        yield seed.data.ljust(MAX_DATAGRAM + noise.randrange(-2, 3), b"\0"), noise.choice(seed.senders)


@dataclass
class Outcome:
    """What a run showed. `memory` are resident KiB, one for each sample; `findings` should be empty."""

    count: int = 0
    seconds: float = 0.0
    memory: list[int] = field(default_factory=list)
    fates: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


def fuzz(count: int, seed: int) -> Outcome:
    program = check_table(ROUTES / "rover.yaml", {}).program
    if program is None:
        raise SystemExit(f"{ROUTES}/rover.yaml has errors; see `router validate`")
    counts = program.counters.fresh_counts()
    noise = random.Random(seed)
    receive = _receiver(program, counts, noise)
    seeds, everybody = _seeds(program)
    outcome = Outcome()
    for data, peer in datagrams(seeds, everybody, noise):
        if outcome.count % SAMPLE == 0 or outcome.count == count:
            outcome.memory.append(_resident_kib())
        if outcome.count == count:
            break
        outcome.count += 1
        started = time.perf_counter_ns()
        try:
            receive(data, peer)
        except Exception as error:  # noqa: BLE001 - any is a finding
            outcome.findings.append(f"{error!r} for {data.hex()} from {peer}")
        outcome.seconds += (time.perf_counter_ns() - started) / 1e9
    ledger = Ledger(program, counts)
    outcome.fates = _fates(ledger)
    outcome.findings += ledger.imbalances()
    if (grown := outcome.memory[-1] - outcome.memory[len(outcome.memory) // 4]) > TOLERATED_GROWTH_KIB:
        outcome.findings.append(f"memory grew by {grown} KiB in the last three quarters")
    return outcome


def _seeds(program: Program) -> tuple[list[Seed], list[Peer]]:
    """The golden envelopes, and the addresses of all endpoints and of somebody else."""
    addresses = {
        name: (one.address.value.host, one.address.value.port) for name, one in program.table.endpoints.items()
    }
    everybody = [*addresses.values(), ("192.168.0.99", 1)]
    golden = json.loads((ROOT / "tests" / "wire" / "golden_envelopes.json").read_text())
    seeds = []
    for entry in golden:
        handlers = program.inbound.get(entry["field_number"], ())
        senders = [addresses[name] for handler in handlers for name in handler.sources if name is not None]
        seeds.append(Seed(bytes.fromhex(entry["hex"]), senders or everybody))
    return seeds, everybody


def _receiver(program: Program, counts: list[int], noise: random.Random) -> Callable[[bytes, Peer], None]:
    """An engine whose outlets fail for one message in a hundred."""

    def send(datagram: bytes) -> int:
        if noise.random() < 0.01:
            raise noise.choice(
                (BlockingIOError(errno.EAGAIN, "full"), ConnectionRefusedError(errno.ECONNREFUSED, "gone"))
            )
        return len(datagram)

    def publish(message: bytes) -> None:
        if noise.random() < 0.01:
            raise PublishError

    context = Rig(program).context
    timed = replace(
        context,
        counts=counts,
        send=dict.fromkeys(context.send, send),
        publish=dict.fromkeys(context.publish, publish),
        report=_forget,
        publish_errors=(PublishError,),
        clock_ns=time.monotonic_ns,
        wall_ns=time.time_ns,
    )
    listener = program.listeners[0].name
    return InboundEngine(program, timed, {listener: time.time_ns}, Freshness()).receiver(listener)


def _forget(report: Report) -> None:
    """A run loses millions on purpose."""


class PublishError(Exception):
    """Stands for what the middleware raises."""


def _fates(ledger: Ledger) -> Counter[str]:
    fates = Counter({"accepted": ledger.total("messages_received"), "padded": ledger.total("datagrams_padded")})
    for key, number in ledger.counted("datagrams_rejected", "messages_dropped").items():
        fates[f"{key[0].partition('_')[2]} {key[-1]}"] += number
    return fates


def _resident_kib() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 1024


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    outcome = fuzz(arguments.count, arguments.seed)
    print(f"{outcome.count} datagrams, seed {arguments.seed}, {1e6 * outcome.seconds / outcome.count:.2f} us each")
    for fate, number in sorted(outcome.fates.items()):
        if number:
            print(f"  {fate:24} {number:>10}")
    memory = outcome.memory
    print(f"resident: {memory[0]} KiB at first, {memory[-1]} at last, {max(memory)} at most, {len(memory)} samples")
    for finding in outcome.findings[:20]:
        print(finding, file=sys.stderr)
    print(f"{len(outcome.findings)} findings")
    return 1 if outcome.findings else 0


if __name__ == "__main__":
    sys.exit(main())
