"""The live view: each payload that arrives, for Foxglove, which decodes it by the descriptor that it is told.

Has a channel for each payload case, named as in recordings. While nobody has subscribed to one, nothing is looked at.
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
from google.protobuf.message import DecodeError as ProtobufError

from router.compiler.program import Program
from router.edges.background import background_threads
from router.edges.http_tap import first_field
from router.edges.log import logger
from router.edges.mirror import Seen, Shown
from router.edges.port_holder import port_holder
from router.edges.recorder_schemas import descriptor_set
from router.edges.running import Running
from router.engine import MAX_DATAGRAM
from router.engine.framing import restored
from router.errors import StartError
from router.table.model import Address, Framing, Located
from router.types.protobuf import PayloadCase

LOOK_SECONDS = 1.0
"""For how long a reload may go unnoticed."""

_OS_ERROR = re.compile(r"\(os error (\d+)\)")


class _Kind(NamedTuple):
    """What makes a channel: a payload case, the full name of its message, and a FileDescriptorSet."""

    case: str
    message: str
    descriptors: bytes


def _kind(case: PayloadCase) -> _Kind:
    payload: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's, which is the same
    return _Kind(case.name, payload.full_name, descriptor_set(payload))


class _Shown(NamedTuple):
    """What is shown of which program."""

    program: Program | None
    channels: Mapping[_Kind, Channel]
    by_case: Mapping[str, Channel]


class FoxgloveServer(ServerListener):
    """Serves at `address` until it is closed. Clients cannot send anything. Opening raises StartError.

    The library's threads tell who subscribes, and are not kept waiting: the thread `foxglove` acts on it.
    """

    def __init__(self, address: Located[Address], running: Running) -> None:
        self._running = running
        self._context = Context()
        self._shown = _Shown(None, {}, {})
        self._subscribed: set[tuple[int, int]] = set()  # client and channel
        self._detach: Callable[[], None] | None = None
        self._stirred, self._is_closing = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="foxglove")
        with background_threads():
            self._server = _started(address, running.program.table.node.name, self._context, self)
            self._follow_program()
            self._thread.start()
        self.address = Address(address.value.host, self._server.port)

    def close(self) -> None:
        self._is_closing = True
        self._stirred.set()
        self._thread.join()
        self._server.stop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._subscribed.add((client.id, channel.id))
        self._stirred.set()

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Also where the client has left, or the channel was closed."""
        self._subscribed.discard((client.id, channel.id))
        self._stirred.set()

    def _run(self) -> None:
        while not self._is_closing:
            self._stirred.wait(LOOK_SECONDS)
            self._stirred.clear()
            self._follow_program()
            self._follow_clients()
        self._ignore()

    def _follow_clients(self) -> None:
        if not self._subscribed:
            self._ignore()
        elif self._detach is None:
            self._detach = self._running.mirror.attach(self._show)

    def _ignore(self) -> None:
        if self._detach is not None:
            self._detach()
            self._detach = None

    def _follow_program(self) -> None:
        """Channels for the payload cases there are now. Those that are as they were stay, with who subscribed."""
        program, shown = self._running.program, self._shown
        if program is shown.program:
            return
        kinds = [_kind(case) for case in program.envelope.cases.values()]
        for kind in shown.channels.keys() - kinds:
            shown.channels[kind].close()
        channels = {kind: shown.channels.get(kind) or self._channel(kind) for kind in kinds}
        self._shown = _Shown(program, channels, {kind.case: channel for kind, channel in channels.items()})

    def _channel(self, kind: _Kind) -> Channel:
        schema = Schema(name=kind.message, encoding="protobuf", data=kind.descriptors)
        return Channel(kind.case, message_encoding="protobuf", schema=schema, context=self._context)

    def _show(self, batch: Sequence[Shown]) -> None:
        """Called by the mirror's thread. What is no payload for the router is not shown."""
        program, _, channels = self._shown
        assert program is not None  # noqa: S101 - there is one since the start
        wanted = {case.number for case in program.envelope.cases.values() if channels[case.name].has_sinks()}
        for shown in batch:
            if first_field(shown[3]) in wanted and (found := _payload(Seen(*shown), program)) is not None:
                case, payload = found
                channels[case].log(payload, log_time=shown[0])


def _payload(seen: Seen, program: Program) -> tuple[str, bytes] | None:
    """The payload case and the payload of a datagram, None where the router finds none in it."""
    listener, data = program.table.listeners.get(seen.listener), seen.data
    if len(data) > MAX_DATAGRAM:
        return None
    if listener is not None and listener.framing is Framing.ZERO_TRIMMED:
        data = restored(data, MAX_DATAGRAM)
    try:
        message = program.envelope.message_class.FromString(data)
    except ProtobufError:
        return None
    case = message.WhichOneof(program.envelope.oneof)
    return (case, getattr(message, case).SerializeToString()) if case else None


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
        raise StartError(
            f"{address.span}: Foxglove cannot be served at {address.value}: {why}; choose another foxglove.address"
        ) from error


class _DebugLog(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        logger.debug("foxglove says", what=record.getMessage())


_LOG = logging.getLogger("foxglove")
"""Where the library tells who broke the rules of websockets or was too slow: seldom of use to an operator."""
_LOG.propagate = False
_LOG.addHandler(_DebugLog())
