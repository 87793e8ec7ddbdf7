"""The HTTP server of a running router: metrics, health, status page; for local programs also taps and actions.

    GET  /             the status page, which requests /status.json, /recent.json and /map.json
    GET  /metrics      for Prometheus
    GET  /health.json  problems, for `router status`, `top` and doctor
    GET  /healthz      200, or 503 while the receive thread is stuck
    GET  /ready        200 while everything is open
    GET  /tap          received datagrams (see tap): ?case=NAME&from=ENDPOINT&only=accepted, or rejected
    POST /-/reload     {"ok", "text", "findings"}: 200, or 422 if the reload was rejected
    POST /record/save  {"ok", "file"}: 200; {"ok", "text"}: 409 on failure, 404 if nothing is kept; the status page may
                       do this from any computer, but gets only the file's name, and 429 within 10 s

Each connection has a thread of low priority. Connections, sizes and times are bounded here; `responses` makes the
responses.
"""

from __future__ import annotations

import ipaddress
import re
import socket
import struct
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from email.message import Message
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from io import BytesIO
from pathlib import Path
from time import monotonic, sleep
from typing import Any
from urllib.parse import parse_qs

from prometheus_client.exposition import gzip_accepted

from router.errors import SourceSpan
from router.log import FloodLog, fault
from router.net.kernel import why_not_bound
from router.observe.responses import SAVE, Responder, Response, plain
from router.observe.running import Running
from router.observe.status import Status
from router.observe.tap import CONTENT_TYPE, Tap, TapRequestError, wanted
from router.observe.watch import Health
from router.table.addresses import Address
from router.threads import REST_S, Thread, join_or_abandon

MAX_PER_HOST = 16
"""Maximum connections. The router's own computer, with all its addresses, counts as one host."""
MAX_FROM_OTHERS = 48
"""Connections of all other computers together, so that they cannot exclude the router's own computer."""
MAX_TAPS = 6
MAX_ANSWERING = 4
MAX_ORDERS = 4
MAX_REQUEST = 1 << 14
MAX_IN_QUERY = 200
MAX_IN_KERNEL = 1 << 17
"""Bytes that wait in the kernel for a slow client."""

IDLE_SECONDS = 30.0
"""A connection ends if there is no complete request for this long, or a tap's client reads nothing."""
RESPONSE_SECONDS = 10.0
"""A connection ends if its client does not read a whole response within this time."""
REST_SECONDS = 0.05
"""The pause between two requests on a connection, so that endless requests cost routing little."""
REFUSAL_SECONDS = 0.003
"""The pause after a rejected connection, so that endless connections cost routing little."""

OWN_COMPUTER = "own"

_END = re.compile(rb"\r?\n\r?\n")
_RESET = struct.pack("ii", 1, 0)
_FULL = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_BY_BROWSERS = ("Origin", "Sec-Fetch-Site", "Sec-Fetch-Mode")


class HttpServer:
    """Serves at `address` until closed. `save` writes the last datagrams to a file; None if none are kept.

    Raises StartError if the address cannot be opened.
    """

    def __init__(
        self,
        address: Address,
        span: SourceSpan,
        running: Running,
        health: Health,
        save: Callable[[str], Path] | None,
    ) -> None:
        self._status = Status(running, health, save is not None)
        try:
            self._server = _Server(address, Responder(running, health, self._status, save))
        except OSError as error:
            kind, why, _ = why_not_bound("tcp", address.port, error)
            raise kind(f"{span}: cannot serve HTTP at {address}: {why}", "choose another http.address") from error
        self._thread = Thread(self._server.serve, "http")
        try:
            self._thread.start()
        except BaseException:
            self._server.socket.close()
            raise
        self.address = Address(*self._server.socket.getsockname())

    def close(self) -> None:
        self._server.end()
        join_or_abandon(self._thread)
        self._server.connections.end_all()
        self._server.socket.close()
        self._status.close()


class _Server:
    """Serves each admitted connection in a thread of its own; rejects others at once (503).

    If memory, threads or descriptors run out, the connection is closed, and the next one is accepted after a pause.
    """

    def __init__(self, address: Address, responder: Responder) -> None:
        self.connections = Connections()
        self._responder = responder
        self._log = FloodLog()
        self._is_ending = False
        self.socket = socket.create_server(address, backlog=256)

    def serve(self) -> None:
        """Accept until `end`."""
        while not self._is_ending:
            try:
                self._accept()
            except Exception as error:  # noqa: BLE001 reported; the next client is still served
                if not self._is_ending:
                    self._lost(error)
                    sleep(REST_S)

    def end(self) -> None:
        self._is_ending = True
        self.socket.shutdown(socket.SHUT_RDWR)  # wakes `accept`
        self._log.flush(final=True)

    def _accept(self) -> None:
        connection, peer = self.socket.accept()
        try:
            is_own = is_own_computer(peer[0], connection.getsockname()[0])
            if self.connections.admit(connection, OWN_COMPUTER if is_own else peer[0]):
                Thread(self._serve, "http connection", (connection, peer)).start()
            else:
                with suppress(OSError):  # the client has left already
                    connection.send(_FULL)
                self._close(connection)
                sleep(REFUSAL_SECONDS)
        except BaseException:
            self._close(connection)
            raise

    def _serve(self, connection: socket.socket, peer: object) -> None:
        try:
            _Handler(self._responder, self.connections, connection, peer, self)
        except ConnectionError:
            pass  # the client has left
        except TimeoutError:
            _reset(connection)  # drop unread data
        except Exception as error:  # noqa: BLE001 reported; affects only this client
            self._lost(error)
        finally:
            self._close(connection)

    def _close(self, connection: socket.socket) -> None:
        self.connections.remove(connection)
        with suppress(OSError):  # the client has left already
            connection.shutdown(socket.SHUT_WR)
        connection.close()

    def _lost(self, error: Exception) -> None:
        found = fault(error, "lost an HTTP response")
        self._log.note(type(error).__name__, found.emit, found.event, found.error)
        self._log.flush()


class Connections:
    """The open connections, with their hosts, and which of them are taps. Thread-safe.

    If there is no room, a new one is rejected. Timeouts close unused ones.
    """

    def __init__(self) -> None:
        self._hosts: dict[socket.socket, str] = {}
        self._taps: set[socket.socket] = set()
        self._lock = threading.Lock()

    def admit(self, connection: socket.socket, host: str) -> bool:
        """Return whether there is room. `host` is OWN_COMPUTER or an IP address."""
        with self._lock:
            taken = Counter(self._hosts.values())
            from_others = taken.total() - taken[OWN_COMPUTER]
            has_room = taken[host] < MAX_PER_HOST and (host == OWN_COMPUTER or from_others < MAX_FROM_OTHERS)
            if has_room:
                self._hosts[connection] = host
        return has_room

    def admit_tap(self, connection: socket.socket) -> bool:
        """Return whether a connection may become a tap."""
        with self._lock:
            has_room = len(self._taps) < MAX_TAPS
            if has_room:
                self._taps.add(connection)
        return has_room

    def remove(self, connection: socket.socket) -> None:
        with self._lock:
            self._hosts.pop(connection, None)
            self._taps.discard(connection)

    def end_all(self) -> None:
        with self._lock:
            for connection in self._hosts:
                with suppress(OSError):  # the client has left already
                    connection.shutdown(socket.SHUT_RDWR)


def _reset(connection: socket.socket) -> None:
    """Let the kernel drop data that the client has not read when the connection is closed."""
    with suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)


class _Handler(BaseHTTPRequestHandler):
    """One connection, in a thread of its own until the client leaves.

    Reads a whole request, makes the response in memory (at most MAX_ANSWERING threads at a time), then sends it: a slow
    client delays only its own connection.
    """

    protocol_version = "HTTP/1.1"

    _answering = threading.BoundedSemaphore(MAX_ANSWERING)
    _ordering = threading.BoundedSemaphore(MAX_ORDERS)

    def __init__(self, responder: Responder, connections: Connections, *connection: Any) -> None:
        self._responder = responder
        self._connections = connections
        self._ahead = bytearray()
        self._out = BytesIO()
        self._slow: Callable[[], None] | None = None  # called outside of `_answering`
        super().__init__(*connection)

    def setup(self) -> None:
        self.connection = self.request
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_IN_KERNEL)

    def finish(self) -> None:
        """Do nothing: there is nothing to flush."""

    def handle(self) -> None:
        self.close_connection = False
        rested_at = monotonic()
        while (request := self._request()) is not None:
            sleep(max(0.0, rested_at - monotonic()))
            self.rfile = BytesIO(request)
            self.wfile = self._out = BytesIO()
            with self._answering:
                self.handle_one_request()
            if (slow := self._slow) is not None:
                self._slow = None
                slow()
            self._send()
            if self.close_connection:
                return
            rested_at = monotonic() + REST_SECONDS

    def _request(self) -> bytes | None:
        """Return the lines of the next request; None if none is complete, or it exceeds MAX_REQUEST."""
        deadline, looked_at = monotonic() + IDLE_SECONDS, 0
        while (end := _END.search(self._ahead, looked_at)) is None:
            if len(self._ahead) > MAX_REQUEST:
                return None
            looked_at = max(0, len(self._ahead) - 3)
            self.connection.settimeout(max(0.001, deadline - monotonic()))
            try:
                piece = self.connection.recv(MAX_REQUEST)
            except TimeoutError:
                return None
            if not piece:
                return None
            self._ahead += piece
        request = bytes(self._ahead[: end.end()])
        del self._ahead[: end.end()]
        return request

    def _send(self) -> None:
        self.connection.settimeout(RESPONSE_SECONDS)
        self.connection.sendall(self._out.getvalue())  # the timeout is for all of it

    def do_GET(self) -> None:
        path, _, query_string = self.path.partition("?")
        try:
            query = parse_qs(query_string, max_num_fields=MAX_IN_QUERY)
        except ValueError:
            self._respond(plain(HTTPStatus.BAD_REQUEST, f"a query can have at most {MAX_IN_QUERY} values"))
            return
        if path == "/tap":
            asked_for = [query.get(key, []) for key in ("case", "from", "only")]
            self._for_own_computer(lambda: self._tap(*asked_for))
        elif path == "/metrics":
            self._respond(self._responder.metrics(self.headers.get("Accept", "")))
        else:
            self._respond(self._responder.get(path, query))

    do_HEAD = do_GET  # noqa: N815 - as http.server calls it

    def do_POST(self) -> None:
        self.close_connection = True  # a body is not read
        path = self.path.partition("?")[0]
        if path == SAVE and is_own_page(self.headers):
            self._slow = lambda: self._order(self._responder.save_for_page)
        else:
            self._for_own_computer(lambda: self._order(lambda: self._responder.post(path)))

    def _for_own_computer(self, serve: Callable[[], None]) -> None:
        why = refusal(self.client_address[0], self.connection.getsockname()[0], self.headers)
        if why is None:
            self._slow = serve
        else:
            self._respond(plain(HTTPStatus.FORBIDDEN, why))

    def _order(self, order: Callable[[], Response]) -> None:
        with self._ordering:
            self._respond(order())

    def _respond(self, response: Response) -> None:
        if gzip_accepted(self.headers.get("Accept-Encoding", "")):
            response = response.zipped
        self.send_response(response.status)
        self.send_header("Content-Type", response.kind)
        self.send_header("Content-Length", str(len(response.body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        for name, value in response.headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(response.body)

    def _tap(self, cases: list[str], sources: list[str], decisions: list[str]) -> None:
        running = self._responder.running
        try:
            is_wanted = wanted(running.program, cases, sources, decisions)
        except TapRequestError as error:
            self._respond(plain(HTTPStatus.BAD_REQUEST, str(error)))
            return
        if not self._connections.admit_tap(self.connection):
            self._respond(plain(HTTPStatus.SERVICE_UNAVAILABLE, f"there are {MAX_TAPS} taps already: close one"))
            return
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command == "HEAD":
            return
        with closing(Tap(running.mirror, is_wanted, with_actions=not sources and not decisions)) as tap:
            self._send()  # at once: from the response on, the client misses nothing
            self._out = BytesIO()
            self._stream(tap.stream())

    def _stream(self, pieces: Iterator[bytes]) -> None:
        self.connection.settimeout(IDLE_SECONDS)
        for piece in pieces:
            left = memoryview(piece)
            while left:
                left = left[self.connection.send(left) :]

    def version_string(self) -> str:
        return "router"

    def log_message(self, *_: object) -> None:
        """Do not log requests: each open page sends one per second."""


def refusal(peer: str, own: str, headers: Message) -> str | None:
    """Return why a client at IP address `peer`, connected to our address `own`, may not use taps and actions, or None.

    Any page in a browser could send such requests. So browsers are rejected, and host names too (DNS rebinding).
    """
    if not is_own_computer(peer, own):
        return f"only allowed from the router's own computer, not from {peer}"
    if any(name in headers for name in _BY_BROWSERS):
        return "not for browsers: use the command line"
    hosts = headers.get_all("Host", [])
    if len(hosts) != 1 or not _is_plain(hosts[0]):
        return "use an IP address or localhost, not a host name"
    return None


def is_own_page(headers: Message) -> bool:
    """Return whether a browser sends this from a page of this server, opened by IP address or as localhost.

    Host names are not trusted (DNS rebinding).
    """
    origins, hosts = headers.get_all("Origin", []), headers.get_all("Host", [])
    is_same = len(hosts) == 1 and _is_plain(hosts[0]) and origins == [f"http://{hosts[0]}"]
    return is_same and headers.get("Sec-Fetch-Site", "same-origin") == "same-origin"


def is_own_computer(peer: str, own: str) -> bool:
    """Return whether a client at IP address `peer`, connected to our address `own`, is on the router's computer."""
    return ipaddress.ip_address(peer).is_loopback or peer == own


def _is_plain(host: str) -> bool:
    name = host.rpartition(":")[0] if ":" in host else host
    try:
        ipaddress.IPv4Address(name)
    except ValueError:
        return name == "localhost"
    return True
