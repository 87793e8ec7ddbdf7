"""The newest accepted value of each payload case, for the status page.

The mirror is attached while a page requests values; a request decodes the newest datagrams.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from time import monotonic
from typing import Any

from router.clock import boottime_ns
from router.compiler.compiled_table import CompiledTable
from router.observe.running import Running
from router.recording.mirror import Classifier, Mirrored
from router.table.addresses import Address
from router.threads import Thread
from router.values.printing import protobuf_json

LOOKED_AT_SECONDS = 5.0
"""How long the mirror stays attached after a request; a page sends one every second."""

MOST_ELEMENTS = 24
MOST_CHARACTERS = 200

Value = dict[str, Any]


class LastValues:
    """The newest accepted datagram of each payload case since the first of a series of requests."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._newest: dict[str, tuple[int, Mirrored]] = {}
        """By the payload case, with the time of arrival here (boot clock, ns)."""
        self._values: dict[str, Value] = {}
        self._detach: Callable[[], None] | None = None
        self._until = 0.0
        self._lock = threading.Lock()
        self._newest_lock = threading.Lock()
        self._closing = threading.Event()

    def of(self, program: CompiledTable) -> Mapping[str, Value]:
        """Return `at` (boot clock, s), `source`, `bytes` and `fields` by payload case; nothing at the first request."""
        with self._lock:
            self._until = monotonic() + LOOKED_AT_SECONDS
            if self._detach is None and not self._closing.is_set():
                self._values = {}
                self._detach = self._running.mirror.attach(self._take)
                try:
                    Thread(self._end_when_idle, "last values").start()
                except BaseException:
                    self._end()
                    raise
            with self._newest_lock:
                newest, self._newest = self._newest, {}
            classifier = Classifier(program.envelopes, program.table)
            for at, datagram in sorted(newest.values(), key=itemgetter(0)):  # a datagram may have several values
                self._decode(at, datagram, classifier)
            return dict(self._values)

    def close(self) -> None:
        self._closing.set()
        with self._lock:
            self._end()

    def _take(self, batch: Sequence[Mirrored]) -> None:
        """Remember the newest datagrams. Called by the mirror."""
        now, envelopes = boottime_ns(), self._running.program.envelopes
        with self._newest_lock:
            for datagram in batch:
                _, listener, *_, reason, data = datagram
                if not reason:
                    for case in envelopes.at(listener).cases_in(data) or ("",):
                        self._newest[case] = now, datagram

    def _decode(self, at: int, datagram: Mirrored, classifier: Classifier) -> None:
        _, listener, peer, endpoint, _, data = datagram
        for case, payload in classifier.payloads(listener, data):  # none if a reload has changed the messages meanwhile
            fields = protobuf_json(payload, complete=True)
            self._values[case.name] = {
                "at": at / 1e9,
                "source": endpoint or str(Address(*peer)),
                "bytes": len(data),
                "fields": shortened(fields),
            }

    def _end_when_idle(self) -> None:
        while not self._closing.wait(max(0.0, self._until - monotonic())):
            with self._lock:
                if self._until <= monotonic():
                    self._end()
                    return

    def _end(self) -> None:
        if self._detach is not None:
            self._detach()
            self._detach = None


def shortened(value: Any) -> Any:
    """Return the value with long lists and texts truncated."""
    if isinstance(value, dict):
        return {key: shortened(inner) for key, inner in value.items()}
    if isinstance(value, list):
        left_out = len(value) - MOST_ELEMENTS
        return [*map(shortened, value[:MOST_ELEMENTS]), *([f"and {left_out} more"] if left_out > 0 else [])]
    if isinstance(value, str) and len(value) > MOST_CHARACTERS:
        return f"{value[:MOST_CHARACTERS]}… ({len(value)} characters)"
    return value
