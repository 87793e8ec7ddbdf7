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

from router.compiler.program import Program
from router.errors import Located, StartError
from router.log import logger
from router.net.kernel import port_holder
from router.observe.running import Running
from router.recording.channels import descriptor_set
from router.recording.mirror import Classifier, Mirrored, first_field
from router.table.addresses import Address
from router.threads import background_threads
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


class _View(NamedTuple):
    """What is shown of which program. `channels` by payload case."""

    program: Program
    known: Classifier
    channels: Mapping[str, Channel]


class FoxgloveServer(ServerListener):
    """Serves at `address` until it is closed. Clients cannot send anything. Opening raises StartError.

    The library's threads tell who subscribes, and are not kept waiting: the thread `foxglove` acts on it.
    """

    def __init__(self, address: Located[Address], running: Running) -> None:
        self._running = running
        self._context = Context()
        self._open: dict[_Kind, Channel] = {}
        self._subscribed: set[tuple[int, int]] = set()  # client and channel
        self._detach: Callable[[], None] | None = None
        self._stirred, self._is_closing = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="foxglove")
        with background_threads():
            self._server = _started(address, running.program.table.node.name, self._context, self)
            self._view = self._view_of(running.program)
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
        is_well = True
        while not self._is_closing:
            self._stirred.wait(LOOK_SECONDS)
            self._stirred.clear()
            try:
                self._follow_program()
                self._follow_clients()
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly; it may be over at the next look
                if is_well:
                    logger.critical("a fault in the view for Foxglove; please report it", exc_info=error)
                is_well = False
            else:
                is_well = True
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
        """Channels that are as they were stay, with who subscribed; others go when nothing is shown there any more."""
        program = self._running.program
        if program is self._view.program:
            return
        self._view = self._view_of(program)
        stay = set(map(_kind, program.envelope.cases.values()))
        for kind in self._open.keys() - stay:
            self._open.pop(kind).close()

    def _view_of(self, program: Program) -> _View:
        kinds = {name: _kind(case) for name, case in program.envelope.cases.items()}
        for kind in kinds.values():
            if kind not in self._open:
                self._open[kind] = self._channel(kind)
        channels = {name: self._open[kind] for name, kind in kinds.items()}
        return _View(program, Classifier(program.envelope, program.table), channels)

    def _channel(self, kind: _Kind) -> Channel:
        schema = Schema(name=kind.message, encoding="protobuf", data=kind.descriptors)
        return Channel(kind.case, message_encoding="protobuf", schema=schema, context=self._context)

    def _show(self, batch: Sequence[Mirrored]) -> None:
        """Called by the mirror's thread. What is no payload for the router is not shown."""
        program, known, channels = self._view
        wanted = {case.number for name, case in program.envelope.cases.items() if channels[name].has_sinks()}
        for at, listener, _, data in batch:
            if first_field(data) in wanted and (found := known.payload(listener, data)) is not None:
                case, payload = found
                channels[case.name].log(payload.SerializeToString(), log_time=at)


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
