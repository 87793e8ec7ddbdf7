"""A Python thread that serves one part of the routes: it takes messages from a ring and calls their functions.

Each message says of which program it is. So programs change in order: what the earlier one has received is served by
its functions, then the thread switches, and goes on with the next one's.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from struct import Struct
from time import sleep

from router.carrier.ring import Ring
from router.engine.dispatch import ServePart
from router.engine.freshness import Born
from router.threads import Thread

_TRIES, _TRY_S = 100, 0.0002

_RECORD = Struct("@IIQqqqqIIIIII")
"""`struct message_record`."""


@dataclass(frozen=True, slots=True)
class Stage:
    """What a worker calls while a program runs: functions by number of the handler, with the indexes of what waits.

    `switch` is called once, before the first message of this program.
    """

    generation: int
    functions: Mapping[int, tuple[ServePart, Sequence[int]]]
    sources: Sequence[str]
    switch: Callable[[], None]


class Worker:
    """Serves the messages of `ring` in a thread of its own. `failed` is called with what a function raises.

    `counts` belong to the thread, which takes off what waits what it has served.
    """

    def __init__(self, name: str, ring: Ring, failed: Callable[[Exception], None]) -> None:
        self.ring = ring
        self.counts: list[int] = []
        self._edition = 0  # odd while a message is served
        self._balanced: list[int] = []  # the last copy between two messages
        self._failed = failed
        self._stages: dict[int, Stage] = {}
        self._stage: Stage | None = None
        self._latest = 0
        self._switched = threading.Condition()
        self._stopping = False
        self._thread = Thread(self._run, name)

    @property
    def name(self) -> str:
        return self._thread.name

    def copy_counts(self, size: int) -> list[int]:
        """Return the first counts as they are between two messages: if the thread is stuck in one, as last copied."""
        for _ in range(_TRIES):
            edition = self._edition
            copy = self.counts[:size]
            if edition % 2 == 0 and edition == self._edition:
                self._balanced = copy
                return copy
            sleep(_TRY_S)
        balanced = self._balanced
        return balanced[:size] + copy[len(balanced) :]

    def forget_copy(self) -> None:
        """Copy anew from now on: counters were freed, and may stand for something else."""
        self._balanced = []

    def prepare(self, stage: Stage) -> None:
        """Have messages of the stage's generation served by it. To be called before there are any."""
        self._stages[stage.generation] = stage
        self.forget_copy()

    def abandon(self, stage: Stage) -> None:
        """Undo `prepare`, if nothing was received in that generation."""
        self._stages.pop(stage.generation, None)

    def start(self, generation: int) -> None:
        """Start the thread, with the first generation."""
        self._latest = generation
        self._thread.start()

    def advance(self, generation: int) -> None:
        """Switch to that generation once all earlier messages are served: none of them can come any more."""
        self._latest = generation
        self.ring.wake()

    def wait_for(self, generation: int, timeout: float) -> bool:
        """Wait until the thread serves that generation. Return False after `timeout` s: it is stuck, or behind."""

        def has_switched() -> bool:
            return self._stage is not None and self._stage.generation >= generation

        with self._switched:
            return self._switched.wait_for(has_switched, timeout)

    def stop(self, timeout: float) -> bool:
        """Serve what waits, and end. Return False if that takes longer than `timeout` s: the thread is left."""
        self._stopping = True
        self.ring.wake()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            # Read before the ring: what is put there later is of this generation, or a later one.
            latest, is_stopping = self._latest, self._stopping
            is_behind = self._stage is None or latest > self._stage.generation
            if records := self.ring.take(0 if is_behind or is_stopping else -1):
                self._serve(records)
            elif is_behind:
                self._switch(latest)
            elif is_stopping:
                return

    def _switch(self, generation: int) -> None:
        if (stage := self._stages.get(generation)) is None:
            return
        try:
            stage.switch()
        except Exception as error:  # noqa: BLE001 a bug of the router is reported, and serving goes on
            self._failed(error)
        with self._switched:
            self._stage = stage
            self._switched.notify_all()
        for earlier in [each for each in self._stages if each < generation]:
            del self._stages[earlier]

    def _serve(self, records: memoryview) -> None:
        counts, position, end, head = self.counts, 0, len(records), _RECORD.size
        stage = self._stage
        while position < end:
            (
                size,
                generation,
                _,
                received_at,
                now,
                oldest,
                youngest,
                column,
                is_single,
                length,
                start,
                payload_length,
                number,
            ) = _RECORD.unpack_from(records, position)
            if stage is None or generation != stage.generation:
                self._switch(generation)
                stage = self._stage
            assert stage is not None  # noqa: S101 - each generation is prepared before its first message
            function, waiting = stage.functions[number]
            data = position + head
            payload = bytes(records[data + start : data + start + payload_length]) if is_single else None
            datagram = bytes(records[data : data + length])
            self._edition += 1
            try:
                function(payload, datagram, received_at, now, stage.sources[column], Born(oldest, youngest))
            except Exception as error:  # noqa: BLE001 as above
                self._failed(error)
            for index in waiting:
                counts[index] -= 1
            self._edition += 1
            position += size
