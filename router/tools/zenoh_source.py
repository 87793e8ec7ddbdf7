"""What gateways put into a Zenoh network under one key expression."""

from __future__ import annotations

import json
import queue
from collections.abc import Sequence

import zenoh

from router.errors import TransportError, UsageError
from router.table.model import ZenohSettings
from router.tools.gateway_sources import Arrival, Say

_ANSWER_TIMEOUT = 1.0
"""Seconds in which gateways answer."""


class ZenohSource:
    """Subscribes to data and schemas below the key, and asks for what there is, which gateways answer.

    Live data waits until the first answers are in, for they hold the schemas. Raises UsageError for what Zenoh does
    not understand, TransportError when it cannot open.
    """

    lost = 0
    """Zenoh does not tell."""

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
        """Zenoh calls from threads of its own: `append` for each reply, and the function when there are no more."""
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
        """Schemas first."""
        for reply in replies:
            if reply.err is not None:
                self._say(f"a gateway could not answer: {reply.err.payload.to_string()}")
        schemas = f"{self._key}/schema/"
        samples = [reply.ok for reply in replies if reply.ok is not None]
        return sorted(samples, key=lambda sample: not str(sample.key_expr).startswith(schemas))

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]


def _arrival(sample: zenoh.Sample) -> Arrival:
    """What comes under one key expression counts as one sender's: an answer has the schema of what is published."""
    return Arrival(sample.payload.to_bytes(), None)


def _session(settings: ZenohSettings) -> zenoh.Session:
    """Where nothing is named to connect to or to listen on, Zenoh looks for others by multicast."""
    config = zenoh.Config()
    try:
        config.insert_json5("mode", json.dumps(settings.mode))
        if settings.connect or settings.listen:
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("connect/endpoints", json.dumps(settings.connect))
            config.insert_json5("listen/endpoints", json.dumps(settings.listen))
    except zenoh.ZError as error:
        raise UsageError(f"zenoh: {error}") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise TransportError(f"zenoh: {error}") from error
