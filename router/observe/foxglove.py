"""Live view in Foxglove: a WebSocket server with a channel for each payload case, named as in recordings.

Only accepted datagrams are shown. Foxglove decodes payloads with the descriptors in the channels. The mirror is
attached while a client subscribes.
"""

from __future__ import annotations

import errno
import logging
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from foxglove import Channel, Context, Schema, start_server
from foxglove.websocket import ChannelView, Client, ServerListener, WebSocketServer
from google.protobuf.descriptor import Descriptor

from router.compiler.program import Program
from router.errors import ConfigurationError, Located, StartError
from router.log import fault, logger
from router.net.kernel import is_listening, port_holder
from router.observe.running import Running
from router.recording.channels import descriptor_set
from router.recording.mirror import Classifier, Mirrored, payload_number
from router.table.addresses import Address
from router.threads import Thread, background_threads, join_or_abandon
from router.types.protobuf import PayloadCase

LOOK_SECONDS = 1.0
"""The longest time until a reload is detected, s."""

_OS_ERROR = re.compile(r"\(os error (\d+)\)")


class _ChannelKey(NamedTuple):
    """The identity of a channel: a payload case, the full name of its message, and a FileDescriptorSet."""

    case: str
    message: str
    descriptors: bytes


def _key(case: PayloadCase) -> _ChannelKey:
    payload: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's, which is the same
    return _ChannelKey(case.name, payload.full_name, descriptor_set(payload))


class _View(NamedTuple):
    """The channels of a program, by payload case."""

    program: Program
    classifier: Classifier
    channels: Mapping[str, Channel]


class FoxgloveServer(ServerListener):
    """Serves at `address` until it is closed. Clients cannot send. Raises StartError.

    The library's threads report subscriptions; the thread `foxglove` acts on them.
    """

    def __init__(self, address: Located[Address], running: Running) -> None:
        self._running = running
        self._context = Context()
        self._open: dict[_ChannelKey, Channel] = {}
        self._subscribed: set[tuple[int, int]] = set()  # client and channel
        self._detach: Callable[[], None] | None = None
        self._changed, self._is_closing = threading.Event(), False
        self._thread = Thread(self._run, "foxglove")
        with background_threads():
            self._server = _started(address, running.program.table.node.name, self._context, self)
            self._address = Located(Address(address.value.host, self._server.port), address.span)
            self._view = self._view_of(running.program)
            self._thread.start()

    @property
    def address(self) -> Address:
        return self._address.value

    def close(self) -> None:
        self._is_closing = True
        self._changed.set()
        join_or_abandon(self._thread)
        self._server.stop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._subscribed.add((client.id, channel.id))
        self._changed.set()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Also called when the client leaves or the channel is closed."""
        self._subscribed.discard((client.id, channel.id))
        self._changed.set()

    def _run(self) -> None:
        is_well = True
        while not self._is_closing:
            self._changed.wait(LOOK_SECONDS)
            self._changed.clear()
            try:
                self._listen_again()
                self._update_channels()
                self._attach_while_subscribed()
            except StartError as error:
                if is_well:
                    logger.error("Foxglove server is down; retrying", why=str(error))
                is_well = False
            except Exception as error:  # noqa: BLE001 a fault of the router, reported once; retry
                if is_well:
                    fault(error, "stopped its updates", "the Foxglove server").log()
                is_well = False
            else:
                is_well = True
        self._detach_from_mirror()

    def _listen_again(self) -> None:
        """Reopen the server: when descriptors run out, the library stops accepting for good. Raises StartError."""
        if not is_listening(self.address.port):
            self._server.stop()
            self._subscribed.clear()
            self._server = _started(self._address, self._running.program.table.node.name, self._context, self)
            logger.warning("Foxglove server is up again", address=str(self.address))

    def _attach_while_subscribed(self) -> None:
        if not self._subscribed:
            self._detach_from_mirror()
        elif self._detach is None:
            self._detach = self._running.mirror.attach(self._send)

    def _detach_from_mirror(self) -> None:
        if self._detach is not None:
            self._detach()
            self._detach = None

    def _update_channels(self) -> None:
        """After a reload, keep unchanged channels with their subscriptions, add new ones and close the others."""
        program = self._running.program
        if program is self._view.program:
            return
        self._view = self._view_of(program)
        for key in self._open.keys() - set(map(_key, program.envelope.cases.values())):
            self._open.pop(key).close()

    def _view_of(self, program: Program) -> _View:
        keys = {name: _key(case) for name, case in program.envelope.cases.items()}
        for key in keys.values():
            if key not in self._open:
                schema = Schema(name=key.message, encoding="protobuf", data=key.descriptors)
                self._open[key] = Channel(key.case, message_encoding="protobuf", schema=schema, context=self._context)
        channels = {name: self._open[key] for name, key in keys.items()}
        return _View(program, Classifier(program.envelope, program.table), channels)

    def _send(self, batch: Sequence[Mirrored]) -> None:
        """Send the accepted payloads of subscribed channels. Called by the mirror's thread."""
        program, classifier, channels = self._view
        numbers = {name: case.number for name, case in program.envelope.cases.items()}
        known = frozenset(numbers.values())
        wanted = {number for name, number in numbers.items() if channels[name].has_sinks()}
        for at, listener, _, _, reason, data in batch:
            if reason or payload_number(data, known) not in wanted:
                continue
            if (found := classifier.encoded_payload(listener, data)) is not None:
                case, payload = found
                channels[case.name].log(payload, log_time=at)


def _started(address: Located[Address], name: str, context: Context, listener: ServerListener) -> WebSocketServer:
    host, port = address.value
    try:
        return start_server(name=name, host=host, port=port, context=context, server_listener=listener)
    except RuntimeError as error:
        why = str(error)
        number = int(found[1]) if (found := _OS_ERROR.search(why)) else None
        if number == errno.EADDRINUSE:
            why = f"{port_holder('tcp', port)} has the port"
        elif number == errno.EADDRNOTAVAIL:
            why = "no network interface of this computer has that address"
        what = f"{address.span}: cannot serve Foxglove at {address.value}: {why}"
        kind = ConfigurationError if number == errno.EACCES else StartError
        raise kind(what, "choose another foxglove.address") from error


class _DebugLog(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        logger.debug("message of foxglove-sdk", message=record.getMessage())


_LOG = logging.getLogger("foxglove")
"""The library logs clients that violate the protocol or are too slow, which seldom helps an operator."""
_LOG.propagate = False
_LOG.addHandler(_DebugLog())
