"""Live view in Foxglove: a websocket server with a channel for each payload case, named as in recordings.

Only accepted datagrams are shown. Foxglove decodes payloads with the descriptors in the channels. The mirror is
attached while a client subscribes. Speaks version 1 of Foxglove's protocol, without what clients could send:
https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md.
"""

from __future__ import annotations

import asyncio
import base64
import json
import socket
import struct
from collections import Counter, deque
from collections.abc import Callable, Collection, Coroutine, Mapping, Sequence
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import Any, NamedTuple, TypeVar

from google.protobuf.descriptor import Descriptor
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from router.clock import wall_ns
from router.compiler.compiled_table import CompiledTable
from router.log import FloodLog, fault, logger_of_library
from router.net.addresses import bound_address
from router.net.doors import Door, is_foreign, listen
from router.observe.running import Running
from router.recording.channels import descriptor_set
from router.recording.mirror import Classifier, Mirrored
from router.table.addresses import Address
from router.table.model.settings import ServerSettings
from router.threads import ACCEPTED_AFTER_CLOSING, Thread, background_threads, join_or_abandon
from router.types.protobuf import PayloadCase

T = TypeVar("T")

LOOK_SECONDS = 1.0
"""The longest time until a reload is detected, s."""

MAX_CLIENTS, MAX_CLIENTS_PER_HOST = 32, 16
BACKLOG = 1024
"""Messages that wait for a slow client; it loses the oldest."""
MAX_REQUEST = 1 << 16
HANDSHAKE_SECONDS, PING_SECONDS, CLOSING_SECONDS = 10.0, 20.0, 1.0
PATIENCE_S = 5.0
"""Seconds for the server to open or close."""

APPS = ("https://app.foxglove.dev", "file://")
"""Origins of the Foxglove app: in a browser, and installed."""

SUBPROTOCOLS = [Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1")]
_MESSAGE = struct.Struct("<BIQ")
"""Kind of a binary message, subscription, time (ns); the payload follows."""
_MESSAGE_DATA = 1
_NUMBERS = range(1 << 32)


class _ChannelKey(NamedTuple):
    """The identity of a channel: a payload case, the full name of its message, and a FileDescriptorSet."""

    case: str
    message: str
    descriptors: bytes


def _key(case: PayloadCase) -> _ChannelKey:
    payload: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's, which is the same
    return _ChannelKey(case.name, payload.full_name, descriptor_set(payload))


class _View(NamedTuple):
    """A program, and the numbers of its channels by payload case."""

    program: CompiledTable
    classifier: Classifier
    channels: Mapping[str, int]


class _Message(NamedTuple):
    channel: int
    at: int
    payload: bytes


class _Client:
    """A connection with its subscriptions, by channel. `orders` are JSON, and sent before messages."""

    def __init__(self, connection: ServerConnection) -> None:
        self.subscriptions: dict[int, int] = {}
        self._connection = connection
        self._orders: deque[str] = deque()
        self._messages: deque[_Message] = deque(maxlen=BACKLOG)
        self._has_more = asyncio.Event()

    def order(self, **order: object) -> None:
        self._orders.append(json.dumps(order))
        self._has_more.set()

    def show(self, messages: Sequence[_Message]) -> None:
        self._messages.extend(message for message in messages if message.channel in self.subscriptions)
        self._has_more.set()

    async def write(self) -> None:
        """Send until the connection ends."""
        with suppress(ConnectionClosed):
            while True:
                await self._has_more.wait()
                self._has_more.clear()
                while self._orders or self._messages:
                    if self._orders:
                        await self._connection.send(self._orders.popleft())
                    else:
                        await self._write(self._messages.popleft())

    async def _write(self, message: _Message) -> None:
        subscription = self.subscriptions.get(message.channel)
        if subscription is not None:  # otherwise it has unsubscribed meanwhile
            await self._connection.send(_MESSAGE.pack(_MESSAGE_DATA, subscription, message.at) + message.payload)


class FoxgloveServer:
    """Serves until it is closed, in an event loop of its own. Clients cannot send. Raises StartError."""

    def __init__(self, settings: ServerSettings, door: Door, running: Running) -> None:
        self._running = running
        self._door = door
        self._log = FloodLog()
        self._numbers: dict[_ChannelKey, int] = {}
        self._next_number = 1
        self._clients: dict[ServerConnection, _Client] = {}
        self._connections: dict[ServerConnection, str] = {}  # with their hosts, also before the handshake
        self._arrived: deque[_Message] = deque(maxlen=BACKLOG)
        self._is_showing = self._is_closing = False
        self._wanted: frozenset[int] = frozenset()
        self._detach: Callable[[], None] | None = None
        self._view = self._view_of(running.program)
        self._session = str(wall_ns())
        listening = listen(settings.address.value, settings.address.span, "Foxglove", "foxglove.address")
        self.address = Address(*bound_address(listening))
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._on_fault)
        self._changed = asyncio.Event()
        self._thread = Thread(self._loop.run_forever, "foxglove")
        try:
            with background_threads():
                self._thread.start()
            self._server, self._following = self._call(self._open(listening))
        except BaseException:
            listening.close()
            self._loop.call_soon_threadsafe(self._loop.stop)
            raise

    async def _open(self, listening: socket.socket) -> tuple[Server, asyncio.Task[None]]:
        server = await serve(
            self._serve_client,
            sock=listening,
            create_connection=partial(_Connection, owner=self),  # type: ignore[arg-type]  # a factory is accepted
            process_request=_rejection,
            subprotocols=SUBPROTOCOLS,
            compression=None,
            server_header=None,
            open_timeout=HANDSHAKE_SECONDS,
            ping_interval=PING_SECONDS,
            ping_timeout=PING_SECONDS,
            close_timeout=CLOSING_SECONDS,
            max_size=MAX_REQUEST,
            logger=_LOG,
        )
        return server, asyncio.get_running_loop().create_task(self._follow())

    def close(self) -> None:
        """Close the server and all connections. Idempotent."""
        if self._loop.is_closed():
            return
        self._call(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        if join_or_abandon(self._thread):
            self._loop.close()
        self._door.close()
        self._log.flush(final=True)

    async def _close(self) -> None:
        self._is_closing = True
        self._changed.set()
        await self._following  # before Python 3.12, `wait_for` may ignore that it is cancelled
        self._detach_from_mirror()
        self._server.close()
        await self._server.wait_closed()

    def _on_fault(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if not (isinstance(error, ValueError) and str(error) == ACCEPTED_AFTER_CLOSING):
            self._report(error if isinstance(error, Exception) else RuntimeError(context["message"]))

    def _report(self, error: Exception) -> None:
        found = fault(error, "disturbed the Foxglove server")
        self._log.note(type(error).__name__, found.emit, found.event, found.error)

    def _call(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE_S)

    # -- clients ---------------------------------------------------------------------------------------------------

    def connected(self, connection: ServerConnection) -> bool:
        """Return whether a new connection may stay."""
        peer, own = connection.transport.get_extra_info("peername"), connection.transport.get_extra_info("sockname")
        if peer is None or not self._door.admits(peer[0], own[0]):
            return False
        hosts = Counter(self._connections.values())
        if hosts.total() >= MAX_CLIENTS or hosts[peer[0]] >= MAX_CLIENTS_PER_HOST:
            return False
        self._connections[connection] = peer[0]
        return True

    def disconnected(self, connection: ServerConnection) -> None:
        self._connections.pop(connection, None)

    async def _serve_client(self, connection: ServerConnection) -> None:
        client = self._clients[connection] = _Client(connection)
        name = self._running.program.table.node.name
        client.order(
            op="serverInfo", name=name, capabilities=[], supportedEncodings=[], metadata={}, sessionId=self._session
        )
        client.order(op="advertise", channels=[_advertised(number, key) for key, number in self._numbers.items()])
        writing = asyncio.get_running_loop().create_task(client.write())
        try:
            async for message in connection:
                if isinstance(message, str):
                    self._follow_request(client, message)
        except _BadRequestError:
            await connection.close(CloseCode.INVALID_DATA, "not a request of the protocol")
        except ConnectionClosed:
            pass  # without a closing handshake
        except Exception as error:  # noqa: BLE001 a fault of the router, reported; it ends only this connection
            self._report(error)
        finally:
            writing.cancel()
            del self._clients[connection]
            self._changed.set()

    def _follow_request(self, client: _Client, text: str) -> None:
        added, gone = _subscriptions(text)
        channels = set(self._numbers.values())
        client.subscriptions = {channel: each for channel, each in client.subscriptions.items() if each not in gone}
        client.subscriptions |= {channel: each for channel, each in added.items() if channel in channels}
        self._changed.set()

    # -- channels and messages -------------------------------------------------------------------------------------

    async def _follow(self) -> None:
        """Follow reloads and subscriptions."""
        is_well = True
        while not self._is_closing:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._changed.wait(), LOOK_SECONDS)
            self._changed.clear()
            self._log.flush()
            try:
                self._update_channels()
                self._attach_while_subscribed()
            except Exception as error:  # noqa: BLE001 a fault of the router, reported once; retry
                if is_well:
                    fault(error, "stopped its updates", "the Foxglove server").log()
                is_well = False
            else:
                is_well = True

    def _attach_while_subscribed(self) -> None:
        self._wanted = frozenset(channel for client in self._clients.values() for channel in client.subscriptions)
        if not self._wanted:
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
        before = dict(self._numbers)
        self._view = self._view_of(program)
        current = set(map(_key, program.envelopes.cases.values()))
        gone = [self._numbers.pop(key) for key in before.keys() - current]
        added = [_advertised(number, key) for key, number in self._numbers.items() if key not in before]
        for client in self._clients.values():
            client.subscriptions = {each: sub for each, sub in client.subscriptions.items() if each not in gone}
            if gone:
                client.order(op="unadvertise", channelIds=gone)
            if added:
                client.order(op="advertise", channels=added)

    def _view_of(self, program: CompiledTable) -> _View:
        channels = {}
        for case in program.envelopes.cases.values():
            key = _key(case)
            if key not in self._numbers:
                self._numbers[key] = self._next_number
                self._next_number += 1
            channels[case.name] = self._numbers[key]
        return _View(program, Classifier(program.envelopes, program.table), channels)

    def _send(self, batch: Sequence[Mirrored]) -> None:
        """Send the accepted payloads of subscribed channels. Called by the mirror."""
        program, classifier, channels = self._view
        envelopes = program.envelopes
        messages = []
        for at, listener, _, _, reason, data in batch:
            if reason or self._wanted.isdisjoint(map(channels.get, envelopes.at(listener).cases_in(data))):
                continue
            for case, payload in classifier.encoded_payloads(listener, data):
                messages.append(_Message(channels[case.name], at, payload))
        self._arrived.extend(messages)
        if messages and not self._is_showing:
            self._is_showing = True
            self._loop.call_soon_threadsafe(self._show)

    def _show(self) -> None:
        self._is_showing = False  # before the rest: what arrives from here on needs another call
        messages = []
        while self._arrived:
            messages.append(self._arrived.popleft())
        for client in self._clients.values():
            client.show(messages)


class _BadRequestError(Exception):
    pass


def _subscriptions(text: str) -> tuple[Mapping[int, int], Collection[int]]:
    """Return the subscriptions that a client adds, by channel, and those that it ends. Raises _BadRequestError."""
    try:
        request = json.loads(text)
        added = request["subscriptions"] if request["op"] == "subscribe" else ()
        gone = request["subscriptionIds"] if request["op"] == "unsubscribe" else ()
        return {each["channelId"]: _number(each["id"]) for each in added}, set(gone)
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise _BadRequestError from error


def _number(value: object) -> int:
    """Return the number of a subscription. Raises ValueError."""
    if not isinstance(value, int) or value not in _NUMBERS:  # a range is searched for anything but an integer
        raise ValueError(value)
    return value


class _Connection(ServerConnection):
    """The library's connection, which is also checked before the handshake."""

    def __init__(self, *args: Any, owner: FoxgloveServer, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._owner = owner

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if not self._owner.connected(self):
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._owner.disconnected(self)


def _advertised(number: int, key: _ChannelKey) -> dict[str, object]:
    return {
        "id": number,
        "topic": key.case,
        "encoding": "protobuf",
        "schemaName": key.message,
        "schema": base64.b64encode(key.descriptors).decode(),
        "schemaEncoding": "protobuf",
    }


def _rejection(connection: ServerConnection, request: Request) -> Response | None:
    origins = request.headers.get_all("Origin")
    is_app = bool(origins) and all(origin in APPS for origin in origins)
    if not is_app and is_foreign(request.headers.get_all("Host"), origins):
        return connection.respond(HTTPStatus.FORBIDDEN, "pages of other hosts may not connect\n")
    return None


_LOG = logger_of_library("router.foxglove", "websockets")
