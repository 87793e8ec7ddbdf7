"""What is sent in a run, planned from a seed, and what the logs of `send` and `receive` say of it. No processes."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Numbers: TypeAlias = NDArray[np.int64]

SECOND = 1_000_000_000
JITTER = 0.3
"""Of the time between two datagrams, by which each is early or late."""

FLOAT_AT = {0x6A: 3, 0x62: 21, 0x0A: 3, 0x5A: 8}
"""First byte of an envelope, which is the tag of its payload -> where the payload's first float begins.

`imu_info` and `ph_info` begin with one. Before that of `gps_info` are two doubles, before that of `sensor_diag`, which
is longer than 127 bytes, its state and the head of its `ph_sensor`.
"""

COMMAND_HZ = 50
COMMANDING = (0.3, 0.6)
"""Seconds for which commands come."""

SILENCE = 1.0
"""Seconds from the last command to the next one: the deadman's timeout, and as much again for a late brake."""

ARRIVAL = np.dtype([("at", "<i8"), ("port", "<u4"), ("length", "<u4"), ("head", "u1", (48,))])
"""As `carrier.c` writes it."""

TELEMETRY, BOARD = 0, 1
"""The sources, in the order of `send --from`: who sends telemetry, and who commands."""


class Payload(NamedTuple):
    """A datagram; `offset` is where `send` writes its number, 0 if nowhere."""

    source: int
    offset: int
    datagram: bytes


@dataclass(frozen=True)
class Plan:
    """What to send: for each datagram when (ns after the start, ascending) and which of the payloads."""

    payloads: Sequence[Payload]
    due: Numbers
    payload: Numbers

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write payloads and plan as `send.c` reads them."""
        payloads, plan = folder / "payloads", folder / "plan"
        payloads.write_text("".join(f"{one.source} {one.offset} {one.datagram.hex()}\n" for one in self.payloads))
        np.stack([self.due, self.payload], axis=1).astype("<i8").tofile(plan)
        return payloads, plan

    def of(self, source: int) -> Numbers:
        """The lines of the plan that are from one source."""
        return np.flatnonzero(np.array([one.source for one in self.payloads])[self.payload] == source)


def telemetry(datagrams: Sequence[bytes], rate: float, seconds: float, noise: random.Random) -> Plan:
    """Datagrams in random order, each a little early or late."""
    payloads = [Payload(TELEMETRY, FLOAT_AT[datagram[0]], datagram) for datagram in datagrams]
    count = int(rate * seconds)
    places = np.arange(count) + JITTER * (1 + np.array([noise.uniform(-1, 1) for _ in range(count)]))
    chosen = np.array([noise.randrange(len(payloads)) for _ in range(count)], dtype=np.int64)
    return Plan(payloads, (places / rate * SECOND).astype(np.int64), chosen)


def bursts(seconds: float, noise: random.Random) -> list[list[float]]:
    """When commands are sent: each list is seconds from the start, with a silence behind it, all within `seconds`."""
    found: list[list[float]] = []
    begin = noise.uniform(0, 0.2)
    while True:
        count = round(noise.uniform(*COMMANDING) * COMMAND_HZ)
        burst = [begin + number / COMMAND_HZ for number in range(count)]
        if burst[-1] + SILENCE > seconds:
            return found
        found.append(burst)
        begin = burst[-1] + SILENCE + noise.uniform(0, 0.1)


def with_commands(plan: Plan, times: Sequence[Sequence[float]], command: Callable[[int], bytes]) -> Plan:
    """The plan and the commands, which are numbered from 1 on."""
    flat = np.array([time for burst in times for time in burst])
    commands = [Payload(BOARD, 0, command(number + 1)) for number in range(len(flat))]
    due = np.concatenate([plan.due, (flat * SECOND).astype(np.int64)])
    payload = np.concatenate([plan.payload, len(plan.payloads) + np.arange(len(flat))])
    order = np.argsort(due, kind="stable")
    return Plan([*plan.payloads, *commands], due[order], payload[order])


def numbers(heads: NDArray[np.uint8]) -> Numbers:
    """What `send` wrote into datagrams that begin like this; -1 for those that it does not write into."""
    found: Numbers = np.full(len(heads), -1, dtype=np.int64)
    for first, at in FLOAT_AT.items():
        chosen = heads[:, 0] == first
        found[chosen] = np.ascontiguousarray(heads[chosen, at : at + 4]).view("<f4")[:, 0].astype(np.int64)
    return found


class Passage(NamedTuple):
    """What became of datagrams: latency of each that came, in ns, and how many came not, or twice."""

    latency: Numbers
    lost: int
    doubled: int


def passage(sent: Numbers, lines: Numbers, first: int, number: Numbers, at: Numbers) -> Passage:
    """Of these lines of the plan, of which the line 0 has the number `first`.

    `sent` is the log of `send`; `number` and `at` are of the datagrams that came.
    """
    line = number - first
    is_ours = np.isin(line, lines)
    line, at = line[is_ours], at[is_ours]
    _, once = np.unique(line, return_index=True)
    left = int(np.count_nonzero(sent[lines]))
    return Passage((at - sent[line])[once], left - len(once), len(line) - len(once))


class Command(NamedTuple):
    """What a board got at `at` (ns): a command's number, or None for a brake."""

    at: int
    number: int | None


class Braking(NamedTuple):
    """What a board saw. `late` is, for each silence, ns from `timeout` after the last command was sent to the brake.

    `missing` are silences without a brake, of which `late` has how long they were; `old` are commands that came later
    than they may; `lost` are those that never came.
    """

    late: list[int]
    missing: int
    old: int
    lost: int


def braking(
    sent: Sequence[Sequence[int]], arrived: Sequence[Command], timeout: int, most_age: int, end: int
) -> Braking:
    """`sent` is when each command was sent, burst by burst; `end` is when it was looked for the last time. All in ns.

    The brake that counts is the first one behind which no command of its burst comes.
    """
    late, missing = [], 0
    number = 0
    flat = [at for burst in sent for at in burst]
    seen = {one.number: one.at for one in reversed(arrived) if one.number is not None}
    ends = [burst[0] for burst in sent[1:]] + [end]
    for burst, until in zip(sent, ends, strict=True):
        ours = [seen[one] for one in range(number + 1, number + len(burst) + 1) if one in seen]
        number += len(burst)
        since = max([burst[-1], *(at for at in ours if at < until)])
        brake = next((one.at for one in arrived if one.number is None and since <= one.at < until), None)
        missing += brake is None
        late.append((until if brake is None else brake) - burst[-1] - timeout)
    ages = [one.at - flat[one.number - 1] for one in arrived if one.number is not None]
    return Braking(late, missing, sum(age > most_age for age in ages), len(flat) - len(seen))
