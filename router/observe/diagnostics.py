"""/diagnostics, once per second: how routes and endpoints are, for the monitors that ROS has.

Knows when to look, and the bytes of a diagnostic_msgs/msg/DiagnosticArray; what is said is `diagnostics_status`'s.
"""

from __future__ import annotations

import platform
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

from router.clock import monotonic_ns, wall_ns
from router.compiler.cdr.primitives import HEADER, put_length, put_text
from router.compiler.metrics import metric
from router.log import logger
from router.observe.diagnostics_findings import Status
from router.observe.diagnostics_snapshot import METRICS, SEEN, Look, Situation
from router.observe.diagnostics_status import statuses
from router.observe.metrics import PREFIX
from router.observe.running import Running
from router.threads import background_threads

PERIOD = 1.0
"""Seconds."""
LOOKS = 6
"""What went wrong is told for so many periods, less one: a status that comes and goes would be overlooked."""


class Diagnostics:
    """A thread that calls `publish` with the CDR bytes of a DiagnosticArray each PERIOD until it is closed."""

    def __init__(self, running: Running, node: str, publish: Callable[[bytes], None]) -> None:
        """`node` is how the statuses call the router."""
        self._node = node
        self._watch = Watch(running)
        self._publish = publish
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="diagnostics")
        with background_threads():
            self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        is_well = True
        while not self._stopping.wait(PERIOD):
            try:
                told = self._watch.look(monotonic_ns(), wall_ns())
                self._publish(diagnostic_array(wall_ns(), self._node, told))
            except Exception as error:  # noqa: BLE001 a router that cannot tell how it is routes all the same
                if is_well:
                    logger.error("diagnostics cannot be published", problem=repr(error))
                is_well = False
            else:
                is_well = True


class Watch:
    """Compares what a router counts with what it had counted some looks ago, and keeps time on silent endpoints."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._host = platform.node()
        self._looks: deque[tuple[int, Look]] = deque(maxlen=LOOKS)
        self._last_seen: dict[str, tuple[float, int]] = {}  # by endpoint: the stamp, and when that was (monotonic)

    def look(self, now: int, wall: int) -> list[Status]:
        """How everything is at `now`, of a monotonic clock, and `wall`, in ns."""
        program, look = self._running.program, Look(_samples(self._running))
        earlier = self._looks[-1][0] if self._looks else now
        silent = {name: now - self._seen(name, look, earlier, now, wall) for name in program.table.endpoints}
        self._looks.append((now, look))
        since, before = self._looks[0]
        seconds = max(now - since, 1) / 1e9
        return [*statuses(Situation(program, look, before, seconds, silent, self._host))]

    def _seen(self, endpoint: str, look: Look, earlier: int, now: int, wall: int) -> int:
        """When it was heard of, or was first looked for. Stamps are of the wall clock, which jumps."""
        stamp = look.of(SEEN, endpoint).get((), 0.0)
        if endpoint not in self._last_seen or self._last_seen[endpoint][0] != stamp:
            age = min(max(0, wall - int(stamp * 1e9)), now - earlier)
            self._last_seen[endpoint] = stamp, now - age
        return self._last_seen[endpoint][1]


def _samples(running: Running) -> Iterator[tuple[str, Sequence[str], float]]:
    """Of histograms, which are most of what is counted, nothing is asked."""
    for family in running.collect():
        name = family.name.removeprefix(PREFIX)
        if name in METRICS:
            labels = metric(name).labels
            for sample in family.samples:
                yield name, [sample.labels[label] for label in labels], sample.value


def diagnostic_array(stamp: int, node: str, told: Iterable[Status]) -> bytes:
    """CDR, with its header. `stamp` in ns of the wall clock."""
    every = list(told)
    data = bytearray(struct.pack("<iI", stamp // 10**9, stamp % 10**9))
    put_text(data, "")
    put_length(data, len(every), None)
    for status in every:
        data.append(status.level)
        for text in (f"{node}: {status.name}", status.message, status.hardware_id):
            put_text(data, text)
        put_length(data, len(status.values), None)
        for pair in status.values:
            for text in pair:
                put_text(data, text)
    return HEADER + data
