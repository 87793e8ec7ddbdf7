"""What surrounds a running router and does no routing: recordings, HTTP, diagnostics, Foxglove.

Opens what a table asks for. Knows what belongs together, and does no work itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import ExitStack
from typing import TYPE_CHECKING

from router.log import logger
from router.observe.metrics import Asked
from router.observe.running import Running
from router.table.addresses import Address
from router.threads import DaemonThread

if TYPE_CHECKING:
    from router.recording.recorder import Recorder


class Companions:
    """`open` opens them, before anything is received; each closes with what it was opened in. Raises StartError."""

    def __init__(self, running: Running) -> None:
        self.http_address: Address | None = None
        self._running = running
        self._recorder: Recorder | None = None
        self._saving = DaemonThread("saving")
        self._last_asked: Future[None] | None = None

    def open(self, opening: ExitStack, diagnostics: tuple[str, Callable[[bytes], None]] | None) -> None:
        """`diagnostics`: the node's name and what publishes CDR bytes; None where the table asks for none."""
        running, table = self._running, self._running.program.table
        if table.record is not None:
            from router.recording.recorder import Recorder

            self._recorder = Recorder(running.mirror, lambda: running.program, table.record)
            opening.callback(self._recorder.close)
            opening.callback(self._saving.shutdown)
        if table.foxglove is not None:
            from router.observe.foxglove import FoxgloveServer

            opening.callback(FoxgloveServer(table.foxglove, running).close)
        if diagnostics is not None:
            from router.observe.diagnostics import Diagnostics

            opening.callback(Diagnostics(running, *diagnostics).close)
        if table.metrics is not None:
            from router.observe.http import HttpServer

            save = self._recorder.save if self._recorder and table.record and table.record.last else None
            server = HttpServer(table.metrics.value, table.metrics.span, running, save)
            opening.callback(server.close)
            self.http_address = server.address

    def asked(self) -> Mapping[str, Asked]:
        """Series that nobody counts in the counters."""

        def recorded(metric: str) -> Asked:
            return lambda: self._recorder.samples()[metric] if self._recorder else ()

        own = {metric: recorded(metric) for metric in ("recorded_datagrams", "recorded_bytes", "record_dropped")}
        return {**own, "endpoint_stale_after_seconds": self._patience}

    def _patience(self) -> Iterator[tuple[tuple[str], float]]:
        for endpoint in self._running.program.table.endpoints.values():
            if endpoint.stale_after is not None:
                yield (endpoint.name,), endpoint.stale_after / 1e9

    def deadman_tripped(self, route: str) -> None:
        """Called where a deadman acts: what takes time is done elsewhere."""
        if self._recorder is not None:
            self._recorder.deadman_tripped(route)

    def save_recording(self, reason: str) -> None:
        """Returns at once; what comes of it is logged. To be called by one thread.

        Who asks again before it has begun has asked for the same.
        """
        if self._recorder is None:
            logger.warning("nothing to save: the table has no 'record: {last: ...}'")
            return
        asked = self._last_asked
        if asked is None or asked.running() or asked.done():
            self._last_asked = self._saving.submit(_save, self._recorder, reason)


def _save(recorder: Recorder, reason: str) -> None:
    from router.recording.recorder import RecordError

    try:
        recorder.save(reason)
    except RecordError as error:
        logger.error("the last datagrams could not be saved", problem=str(error))
