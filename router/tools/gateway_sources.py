"""Sources of a gateway's packets and documents: UDP, TCP, WebSocket; Zenoh is in `zenoh_source`."""

from __future__ import annotations

import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple, Protocol
from urllib.parse import parse_qs

from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from router.errors import Located, SourceSpan, UsageError, did_you_mean
from router.gateway.packets import Packet, PacketError, pack
from router.net.addresses import socket_address
from router.net.kernel import ask_for_receive_buffer, drops
from router.table.addresses import Address
from router.table.model.gateways import GatewayFormat, ZenohConfig, ZenohSettings
from router.table.units import LARGEST_DATAGRAM
from router.tools import udp

MOST_TEXT = 256 << 20
"""Bytes of the longest message that a gateway can be configured to send."""

Say = Callable[[str], None]


class Arrival(NamedTuple):
    """A datagram, packet or document. Schemas apply to the same `sender` only."""

    data: bytes
    sender: Hashable


class Source(Protocol):
    """A source of packets. `place` describes it; `lost` counts those known to be missing."""

    place: str

    @property
    def lost(self) -> int: ...

    def ask(self) -> None:
        """Request schemas and latest values from gateways that do not send them unasked."""

    def arrivals(self, timeout: float) -> Sequence[Arrival]:
        """Return what has arrived, after at most `timeout` seconds."""

    def close(self) -> None: ...


_LENGTH = struct.Struct("<I")

LONGEST = MOST_TEXT + (1 << 20)
"""Maximum bytes of a packet or document. Read as the length of a packet, the beginning of a document exceeds it."""


class Splitter:
    """Splits a TCP stream into packets or documents. If `form` is None, it is detected from the first bytes.

    `gateway_v1`: each packet after its length, u32 little-endian. `json_lines`: a document and a newline.
    """

    def __init__(self, form: GatewayFormat | None) -> None:
        self._form = form
        self._buffer = bytearray()
        self._searched = 0

    @property
    def unfinished(self) -> int:
        """Bytes of an incomplete packet or document."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield what is complete. Raises PacketError if the stream cannot be split."""
        self._buffer += data
        if self._form is None and len(self._buffer) >= _LENGTH.size:
            is_text = self._buffer.startswith(b"{") and self._length() > LONGEST
            self._form = GatewayFormat.JSON_LINES if is_text else GatewayFormat.GATEWAY_V1
        if self._form is GatewayFormat.JSON_LINES:
            yield from self._lines()
        elif self._form is GatewayFormat.GATEWAY_V1:
            yield from self._packets()

    def _length(self) -> int:
        [length] = _LENGTH.unpack_from(self._buffer)
        return int(length)

    def _packets(self) -> Iterator[bytes]:
        while len(self._buffer) >= _LENGTH.size:
            end = _LENGTH.size + self._length()
            if end > LONGEST:
                raise PacketError(f"a packet of {end - _LENGTH.size} bytes")
            if len(self._buffer) < end:
                return
            yield bytes(self._buffer[_LENGTH.size : end])
            del self._buffer[:end]

    def _lines(self) -> Iterator[bytes]:
        while (end := self._buffer.find(b"\n", self._searched)) >= 0:
            yield bytes(self._buffer[:end])
            del self._buffer[: end + 1]
            self._searched = 0
        self._searched = len(self._buffer)
        if self._searched > LONGEST:
            raise PacketError(f"a line of more than {LONGEST} bytes")


_TRY_AGAIN = 0.5
"""Seconds between two attempts to connect."""

CONNECT_TIMEOUT = 2.0


class ConnectedSource(ABC):
    """A source that reconnects after each failure. Each connection is another `sender`."""

    lost = 0
    """TCP loses nothing."""

    def __init__(self, protocol: str, address: Address, say: Say) -> None:
        self.place = f"{protocol} {address}"
        self._address = address
        self._say = say
        self._connected = ExitStack()
        self._number = 0  # of the connection
        self._is_connected = False
        self._is_reported = False
        self._next_attempt = 0.0

    def ask(self) -> None:  # noqa: B027 - there is nothing to request
        """Do nothing: a new client gets all schemas unasked."""

    def arrivals(self, timeout: float) -> Sequence[Arrival]:
        if not self._is_connected and not self._connect(timeout):
            return ()
        return [Arrival(data, self._number) for data in self._receive(timeout)]

    def close(self) -> None:
        self._connected.close()

    @abstractmethod
    def _open(self, opened: socket.socket, connected: ExitStack) -> None:
        """Start to receive. Resources entered into `connected` are closed with the connection. Raises OSError."""

    @abstractmethod
    def _receive(self, timeout: float) -> Sequence[bytes]:
        """Return what has arrived; call `_lose` if the connection has ended."""

    def _connect(self, timeout: float) -> bool:
        if (rest := self._next_attempt - time.monotonic()) > 0:
            time.sleep(min(rest, timeout))
            return False
        try:
            opened = socket.create_connection(self._address, CONNECT_TIMEOUT)
            self._connected.enter_context(opened)
            self._open(opened, self._connected)
        except OSError as error:
            self._lose(f"cannot be reached ({error.strerror or error})")
            return False
        if self._number or self._is_reported:
            self._say(f"{self.place} is connected")
        self._is_connected, self._is_reported = True, False
        self._number += 1
        return True

    def _lose(self, why: str) -> None:
        """Close the connection. Report that once, until there is a connection again."""
        self._connected.close()
        if not self._is_reported:
            self._say(f"{self.place} {why}; trying again")
        self._is_connected, self._is_reported = False, True
        self._next_attempt = time.monotonic() + _TRY_AGAIN


_READ_SIZE = 1 << 18


class TcpSource(ConnectedSource):
    """`form` is gateway_v1 or json_lines; if None, it is detected."""

    def __init__(self, address: Address, form: GatewayFormat | None, say: Say) -> None:
        super().__init__("tcp", address, say)
        self._form = form

    def _open(self, opened: socket.socket, connected: ExitStack) -> None:
        self._socket = opened
        self._splitter = Splitter(self._form)

    def _receive(self, timeout: float) -> Sequence[bytes]:
        self._socket.settimeout(timeout)
        received: list[bytes] = []
        try:
            data = self._socket.recv(_READ_SIZE)
            for one in self._splitter.feed(data):
                received.append(one)  # noqa: PERF402 - keeps complete packets if the next one is invalid
        except TimeoutError:
            return ()
        except (OSError, PacketError) as error:
            self._lose(f"was disconnected ({error})")
        else:
            if not data:
                unfinished = self._splitter.unfinished
                self._lose(f"has closed, after {unfinished} bytes of a message" if unfinished else "has closed")
        return received


_CLOSE_TIMEOUT = 1.0


class WebsocketSource(ConnectedSource):
    """A text message holds documents, one a line; a binary message is a packet."""

    def __init__(self, address: Address, say: Say) -> None:
        super().__init__("websocket", address, say)

    def _open(self, opened: socket.socket, connected: ExitStack) -> None:
        host, _, _ = self._address.host.partition("%")  # a zone is only for this computer
        try:
            self._websocket: ClientConnection = connected.enter_context(
                connect(
                    f"ws://{self._address._replace(host=host)}/",
                    sock=opened,
                    compression=None,
                    max_size=LONGEST,
                    open_timeout=CONNECT_TIMEOUT,
                    close_timeout=_CLOSE_TIMEOUT,
                )
            )
        except InvalidHandshake as error:
            raise OSError(f"it is not a websocket: {error}") from error

    def _receive(self, timeout: float) -> Sequence[bytes]:
        try:
            message = self._websocket.recv(timeout)
        except TimeoutError:
            return ()
        except ConnectionClosed as error:
            self._lose(f"has closed ({error})")
            return ()
        return message.encode().split(b"\n") if isinstance(message, str) else (bytes(message),)


_RECEIVE_BUFFER = 4 << 20
"""Bytes of the receive buffer; the kernel may grant less."""

_MOST_AT_ONCE = 1000


class UdpSource:
    """A socket bound to `address`. `gateway` is the address to request schemas from, or None. Raises UsageError."""

    def __init__(self, address: Address, gateway: Address | None, say: Say) -> None:
        self._socket = udp.open_udp(address, "listen")
        ask_for_receive_buffer(self._socket, _RECEIVE_BUFFER)
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self._gateway = gateway
        self._say = say
        self.place = f"udp {udp.address_of(self._socket)}"

    @property
    def lost(self) -> int:
        """Datagrams that the kernel dropped."""
        return drops(self._socket)

    def ask(self) -> None:
        """Send an empty packet without a type, which requests all schemas, from the receiving port."""
        if self._gateway is None:
            return
        request = Packet(time.time(), is_compressed=False, topic="", type_name="", payload=b"")
        try:
            self._socket.sendto(pack(request), socket_address(*self._gateway))
        except OSError as error:
            self._say(f"cannot ask {self._gateway}: {error.strerror}")

    def arrivals(self, timeout: float) -> Sequence[Arrival]:
        """Return everything that has arrived, to empty the receive buffer quickly."""
        arrivals: list[Arrival] = []
        if self._readable.poll(timeout * 1000):
            with suppress(BlockingIOError):
                while len(arrivals) < _MOST_AT_ONCE:
                    arrivals.append(Arrival(*self._socket.recvfrom(LARGEST_DATAGRAM)))
        return arrivals

    def close(self) -> None:
        self._socket.close()


_SPAN = SourceSpan("command line", 1, 1)
_FORMS = "udp://[HOST:]PORT, tcp://HOST:PORT, ws://HOST:PORT or zenoh://KEY?connect=LOCATOR"


def open_source(text: str, form: GatewayFormat | None, gateway: Address | None, say: Say) -> Source:
    """Open the source that `text` names. `form` is for tcp, `gateway` (to request schemas) for udp.

    Raises UsageError and TransportError.
    """
    scheme, _, rest = text.partition("://")
    match scheme:
        case "udp":
            return UdpSource(udp.listening(rest, None), gateway, say)
        case "tcp":
            return TcpSource(udp.destination(rest, None), form, say)
        case "ws":
            return WebsocketSource(udp.destination(rest.removesuffix("/"), None), say)
        case "zenoh":
            from router.tools.zenoh_source import ZenohSource

            return ZenohSource(_zenoh(rest), say)
    raise UsageError(f"'{text}' is not {_FORMS}")


def _zenoh(text: str) -> ZenohSettings:
    """Parse a source in a Zenoh network.

    `rovers/loki_1?mode=client&connect=tcp/10.0.0.1:7447`, also with several `connect` and `listen`; or
    `rovers/loki_1?config=FILE`.
    """
    key, _, query = text.partition("?")
    options = parse_qs(query, keep_blank_values=True)
    known = ("mode", "connect", "listen", "config")
    if unknown := [name for name in options if name not in known]:
        raise UsageError(f"zenoh has no option '{unknown[0]}'", did_you_mean(unknown[0], known))
    file = options.get("config", [None])[-1]
    if file is not None and len(options) > 1:
        raise UsageError("zenoh takes 'config' alone", "write mode, connect and listen in that file")
    return ZenohSettings(
        key=Located(key, _SPAN),
        mode=options.get("mode", ["peer"])[-1],
        connect=tuple(options.get("connect", ())),
        listen=tuple(options.get("listen", ())),
        config=None if file is None else ZenohConfig(_SPAN, "", Path(file)),
    )
