"""The newest datagram of each payload case, while somebody looks: for a page, not for a record.

Knows the mirror and the envelope. Decodes when it is asked, and only what has come since.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Any

from google.protobuf.json_format import MessageToDict

from router.compiler.program import Program
from router.observe.running import Running
from router.recording.mirror import Classifier, Mirrored, first_field

LOOKED_AT_SECONDS = 5.0
"""For so long after it was asked last it watches on; a page asks every second."""

MOST_ELEMENTS = 24
MOST_CHARACTERS = 200

Value = dict[str, Any]


class LastValues:
    """Costs nothing while nobody asks."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._fresh: dict[int, Mirrored] = {}
        self._values: dict[str, Value] = {}
        self._detach: Callable[[], None] | None = None
        self._until = 0.0
        self._lock = threading.Lock()
        self._taking = threading.Lock()
        self._closing = threading.Event()

    def of(self, program: Program) -> Mapping[str, Value]:
        """By payload case: `at` (s), `source`, `bytes`, and its `fields`. Nothing comes before it was asked once."""
        with self._lock:
            self._until = monotonic() + LOOKED_AT_SECONDS
            if self._detach is None and not self._closing.is_set():
                self._values = {}
                self._detach = self._running.mirror.attach(self._take)
                threading.Thread(target=self._end_when_idle, name="last values", daemon=True).start()
            with self._taking:
                fresh, self._fresh = self._fresh, {}
            known = Classifier(program.envelope, program.table)
            for shown in fresh.values():
                self._keep(shown, known)
            return dict(self._values)

    def close(self) -> None:
        self._closing.set()
        with self._lock:
            self._end()

    def _take(self, batch: Sequence[Mirrored]) -> None:
        """Called by the mirror's thread."""
        with self._taking:
            for shown in batch:
                _, _, _, data = shown
                self._fresh[first_field(data)] = shown

    def _keep(self, shown: Mirrored, known: Classifier) -> None:
        at, listener, (host, port), data = shown
        if (found := known.payload(listener, data)) is None:
            return  # the page shows it among what was rejected
        case, payload = found
        fields = MessageToDict(payload, preserving_proto_field_name=True, always_print_fields_with_no_presence=True)
        self._values[case.name] = {
            "at": at / 1e9,
            "source": known.sender(listener, (host, port)) or f"{host}:{port}",
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
    """Without what nobody reads on a page: the rest of long lists and of long texts."""
    if isinstance(value, dict):
        return {key: shortened(inner) for key, inner in value.items()}
    if isinstance(value, list):
        left_out = len(value) - MOST_ELEMENTS
        return [*map(shortened, value[:MOST_ELEMENTS]), *([f"and {left_out} more"] if left_out > 0 else [])]
    if isinstance(value, str) and len(value) > MOST_CHARACTERS:
        return f"{value[:MOST_CHARACTERS]}… ({len(value)} characters)"
    return value
