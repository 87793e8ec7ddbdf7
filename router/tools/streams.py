"""What the simulated endpoints send and how often, and when one of them falls silent. Knows no sockets."""

from __future__ import annotations

import random
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from router.engine.wire import Wire
from router.errors import UsageError, did_you_mean
from router.table.model import ANY, RouteTable
from router.tools.models import usual_rate
from router.types.protobuf import PayloadCase

STRANGER = "(anybody)"
"""Who sends the payload cases that the table takes from any source."""

_SILENCE = re.compile(r"(?P<name>\w+):(?P<start>\d+(\.\d+)?)-(?P<end>\d+(\.\d+)?)?")


@dataclass(frozen=True, slots=True)
class Stream:
    """One payload case that one endpoint sends, at `rate` Hz, the first after `offset` seconds."""

    endpoint: str
    case: PayloadCase
    rate: float
    offset: float


@dataclass(frozen=True, slots=True)
class Silence:
    """An endpoint, or whoever sends a payload case, says nothing from `start` to `end`, seconds since the start."""

    name: str
    start: float
    end: float

    def covers(self, stream: Stream, at: float) -> bool:
        return self.start <= at < self.end and self.name in (stream.endpoint, stream.case.name)


def parse_silence(text: str) -> Silence:
    """`basestation:5-8`, `manual_drive:5-` (for ever). Raises UsageError."""
    found = _SILENCE.fullmatch(text)
    if found is None:
        raise UsageError(f"'{text}' is not NAME:FROM-TO with seconds, such as basestation:5-8 or basestation:5-")
    return Silence(found["name"], float(found["start"]), float(found["end"] or "inf"))


def check_silences(silences: Collection[Silence], streams: Collection[Stream]) -> None:
    """Raises UsageError for one that silences nobody."""
    known = {name for stream in streams for name in (stream.endpoint, stream.case.name)} - {STRANGER}
    for silence in silences:
        if silence.name not in known:
            hint = did_you_mean(silence.name, known)
            raise UsageError(f"nothing is sent that '{silence.name}' could silence; {hint}")


def streams(wire: Wire, table: RouteTable, seed: int, rate_scale: float) -> Iterator[Stream]:
    """What the table's UDP sources send, in the order of the table. Raises UsageError for an unknown name."""
    for route in table.routes:
        if route.is_outbound:
            continue
        case = wire.case(route.case.value)
        rate = usual_rate(case.name) * rate_scale
        for source in route.sources:
            sender = STRANGER if source.value == ANY else source.value
            if sender != STRANGER and sender not in table.endpoints:
                hint = did_you_mean(sender, table.endpoints)
                raise UsageError(f"{source.span}: there is no endpoint '{sender}'; {hint}")
            offset = random.Random(f"{seed}/{case.name}/{sender}").uniform(0, 1 / rate)
            yield Stream(sender, case, rate, offset)
