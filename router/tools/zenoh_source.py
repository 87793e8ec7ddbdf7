"""Data that gateways publish in a Zenoh network under one key expression."""

from __future__ import annotations

import queue
from collections.abc import Sequence

import zenoh

from router.compiler.zenoh_config import library_config, reason
from router.errors import StartError, TransportError, UsageError
from router.gateway.transport.zenoh_session import session_config
from router.table.model.gateways import ZenohSettings
from router.tools.gateway_sources import Arrival, Say

_ANSWER_TIMEOUT = 1.0
"""Seconds to wait for answers of gateways."""


class ZenohSource:
    """Subscribes to data and schemas below the key, and queries the latest ones.

    Live data waits for the first answers, which have the schemas. Raises UsageError for invalid settings and
    TransportError if no session can be opened.
    """

    lost = 0
    """Unknown with Zenoh."""

    def __init__(self, settings: ZenohSettings, say: Say) -> None:
        self._key = settings.key.value
        self._say = say
        self._is_answered = False
        self._answers: queue.SimpleQueue[list[zenoh.Reply]] = queue.SimpleQueue()
        self._live: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._session = _session(settings)
        self.place = f"zenoh {self._key}"
        try:
            for kind in ("data", "schema"):
                self._session.declare_subscriber(f"{self._key}/{kind}/**", self._live.put)
        except zenoh.ZError as error:
            self.close()
            raise UsageError(f"zenoh: {error}") from error

    def ask(self) -> None:
        """Query the latest data. Zenoh's threads call `append` for each reply, then the function."""
        replies: list[zenoh.Reply] = []
        handler = zenoh.handlers.Callback(replies.append, lambda: self._answers.put(replies))
        self._session.get(f"{self._key}/**", handler, timeout=_ANSWER_TIMEOUT)

    def arrivals(self, timeout: float) -> Sequence[Arrival]:
        try:
            if not self._is_answered or not self._answers.empty():
                replies = self._answers.get(timeout=timeout)
                self._is_answered = True
                return [_arrival(sample) for sample in self._in_order(replies)]
            return (_arrival(self._live.get(timeout=timeout)),)
        except queue.Empty:
            return ()

    def _in_order(self, replies: Sequence[zenoh.Reply]) -> Sequence[zenoh.Sample]:
        """Return the samples in the replies, schemas first."""
        for reply in replies:
            if reply.err is not None:
                self._say(f"a gateway could not answer: {reply.err.payload.to_string()}")
        schemas = f"{self._key}/schema/"
        samples = [reply.ok for reply in replies if reply.ok is not None]
        return sorted(samples, key=lambda sample: not str(sample.key_expr).startswith(schemas))

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]


def _arrival(sample: zenoh.Sample) -> Arrival:
    """Return a sample as an arrival. All have one sender, because a schema in an answer also describes live data."""
    return Arrival(sample.payload.to_bytes(), None)


def _session(settings: ZenohSettings) -> zenoh.Session:
    """Open a session as gateways do; without `connect` and `listen`, Zenoh discovers others by multicast."""
    try:
        config = session_config(settings) if settings.config is None else library_config(settings.config)
    except StartError as error:
        raise UsageError(f"zenoh: {error}") from error
    except zenoh.ZError as error:
        where = settings.config.path if settings.config is not None else None
        raise UsageError(f"zenoh: {where}: {reason(error)}") from None  # the library's error may quote passwords
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise TransportError(f"zenoh: {error}") from error
