"""The HTTP server of a running router: metrics, health, status page; at the control socket also taps and actions.

    GET  /             the status page, which requests /status.json, /recent.json and /map.json
    GET  /metrics      for Prometheus
    GET  /health.json  problems, for `router status`, `top` and doctor
    GET  /healthz      200, or 503 while the receive thread is stuck
    GET  /ready        200 while everything is open
    POST /record/save  by the status page: {"ok", "file"} with the file's name: 200; {"ok", "text"}: 409 on failure, 404
                       if nothing is kept, 429 within 10 s

At the control socket, which only the router's user and root can use (`router.net.control`), also:

    GET  /tap          received datagrams (see tap): ?case=NAME&from=ENDPOINT&only=accepted, or rejected
    POST /-/reload     {"ok", "text", "findings"}: 200, or 422 if the reload was rejected
    POST /record/save  as above, with the path of the file and at any time

Each connection has a thread of low priority. Connections, sizes and times are bounded here; `requests` parses the
requests, `responses` makes the responses.
"""

from __future__ import annotations

import os
import pwd
import re
import socket
import struct
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from email.utils import formatdate
from functools import partial
from http import HTTPStatus
from pathlib import Path
from time import monotonic, sleep
from urllib.parse import parse_qs

from prometheus_client.exposition import gzip_accepted

from router.errors import SourceSpan, StartError
from router.log import FloodLog, fault
from router.net import control
from router.net.addresses import bound_address
from router.net.doors import Door, is_foreign, is_own_computer, listen
from router.observe.requests import BadRequestError, Request, parse
from router.observe.responses import PAGES, SAVE, Responder, Response, plain
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
LINGER_SECONDS, MAX_LINGER = 1.0, 1 << 16
"""Time and bytes until a connection with a rejected request is closed: closed earlier, it could lose the response."""
REST_SECONDS = 0.05
"""The pause between two requests on a connection, so that endless requests cost routing little."""
REFUSAL_SECONDS = 0.003
"""The pause after a rejected connection, so that endless connections cost routing little."""

OWN_COMPUTER, OWNER = "own", "owner"
"""The hosts of clients on the router's computer: those of its HTTP address, and those who control it."""

_END = re.compile(rb"\r?\n\r?\n")
_RESET = struct.pack("ii", 1, 0)
_FULL = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_STRANGER = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class HttpServer:
    """Serves at `address` until closed. `save` writes the last datagrams to a file; None if none are kept.

    Raises StartError if the address cannot be opened.
    """

    def __init__(
        self,
        address: Address,
        span: SourceSpan,
        door: Door,
        running: Running,
        health: Health,
        save: Callable[[str], Path] | None,
    ) -> None:
        self._status = Status(running, health, save is not None)
        self._door = door
        self._connections = connections = Connections()
        responder = Responder(running, health, self._status, save)
        with ExitStack() as opening:
            listening = opening.enter_context(listen(address, span, "HTTP", "http.address"))
            self.address = Address(*bound_address(listening))
            controlled = opening.enter_context(_control(self.address, span))
            self._servers = [_Server("http", listening, door, connections, responder)]
            opening.callback(self._servers[0].end)
            self._servers.append(_Server("control", controlled, door, connections, responder))
            opening.pop_all()

    def close(self) -> None:
        for server in self._servers:
            server.end()
        self._connections.end_all()
        for server in self._servers:
            server.socket.close()
        self._status.close()
        self._door.close()


def _control(address: Address, span: SourceSpan) -> socket.socket:
    try:
        return control.listen(*address)
    except OSError as error:
        what = f"{span}: cannot open the control socket of {address}: {error.strerror}"
        raise StartError(what, "end the program that has it: find it with `ss -xlp`") from error


class _Server:
    """Serves each admitted connection of a listening socket in a thread of its own; rejects others at once.

    If memory, threads or descriptors run out, the connection is closed, and the next one is accepted after a pause.
    """

    def __init__(
        self, name: str, listening: socket.socket, door: Door, connections: Connections, responder: Responder
    ) -> None:
        self.socket = listening
        self._door = door
        self._connections = connections
        self._responder = responder
        self._log = FloodLog()
        self._is_ending = False
        self._thread = Thread(self._accept_all, name)
        self._thread.start()

    def end(self) -> None:
        """Accept no more connections."""
        self._is_ending = True
        self.socket.shutdown(socket.SHUT_RDWR)  # wakes `accept`
        join_or_abandon(self._thread)
        self._log.flush(final=True)

    def _accept_all(self) -> None:
        while not self._is_ending:
            try:
                self._accept()
            except Exception as error:  # noqa: BLE001 reported; the next client is still served
                if not self._is_ending:
                    self._lost(error)
                    sleep(REST_S)

    def _accept(self) -> None:
        connection, peer = self.socket.accept()
        try:
            host = self._host(connection, peer)
            if host and self._connections.admit(connection, host):
                Thread(self._serve, "http connection", (connection, host == OWNER)).start()
            else:
                with suppress(OSError):  # the client has left already
                    connection.send(_FULL if host else _STRANGER)
                self._close(connection)
                sleep(REFUSAL_SECONDS)
        except BaseException:
            self._close(connection)
            raise

    def _host(self, connection: socket.socket, peer: tuple[str, int]) -> str:
        """Return the host of a client, or "" if it may not connect."""
        if connection.family == socket.AF_UNIX:
            return OWNER if control.is_by_owner(connection) else OWN_COMPUTER
        own = connection.getsockname()[0]
        if not self._door.admits(peer[0], own):
            return ""
        return OWN_COMPUTER if is_own_computer(peer[0], own) else peer[0]

    def _serve(self, connection: socket.socket, is_owner: bool) -> None:
        try:
            _Conversation(self._responder, self._connections, connection, is_owner=is_owner).serve()
        except ConnectionError:
            pass  # the client has left
        except TimeoutError:
            _reset(connection)  # drop unread data
        except Exception as error:  # noqa: BLE001 reported; affects only this client
            self._lost(error)
        finally:
            self._close(connection)

    def _close(self, connection: socket.socket) -> None:
        self._connections.remove(connection)
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
        """Return whether there is room. `host` is OWNER, OWN_COMPUTER or an IP address."""
        with self._lock:
            taken = Counter(self._hosts.values())
            from_others = taken.total() - taken[OWN_COMPUTER] - taken[OWNER]
            is_own = host in (OWN_COMPUTER, OWNER)
            has_room = taken[host] < MAX_PER_HOST and (is_own or from_others < MAX_FROM_OTHERS)
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


class _Conversation:
    """One connection, in a thread of its own until the client leaves.

    Reads a whole request, makes the response in memory (at most MAX_ANSWERING threads at a time), then sends it: a slow
    client delays only its own connection. `is_owner`: see OWNER.
    """

    _answering = threading.BoundedSemaphore(MAX_ANSWERING)
    _ordering = threading.BoundedSemaphore(MAX_ORDERS)

    def __init__(
        self, responder: Responder, connections: Connections, connection: socket.socket, *, is_owner: bool
    ) -> None:
        self._responder = responder
        self._connections = connections
        self._connection = connection
        self._is_owner = is_owner
        self._ahead = bytearray()

    def serve(self) -> None:
        self._connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_IN_KERNEL)
        rested_at = monotonic()
        while (head := self._head()) is not None:
            sleep(max(0.0, rested_at - monotonic()))
            try:
                request = parse(head)
            except BadRequestError as error:
                self._send(_encoded(plain(error.status, str(error)), is_last=True))
                self._linger()
                return
            if self._is_owner and (request.method, request.path) == ("GET", "/tap"):
                self._tap(request)
                return
            self._send(self._answer(request))
            if request.is_last:
                return
            rested_at = monotonic() + REST_SECONDS

    def _head(self) -> bytes | None:
        """Return the lines of the next request; None if none is complete, or it exceeds MAX_REQUEST."""
        deadline, looked_at = monotonic() + IDLE_SECONDS, 0
        while (end := _END.search(self._ahead, looked_at)) is None:
            if len(self._ahead) > MAX_REQUEST:
                return None
            looked_at = max(0, len(self._ahead) - 3)
            self._connection.settimeout(max(0.001, deadline - monotonic()))
            try:
                piece = self._connection.recv(MAX_REQUEST)
            except TimeoutError:
                return None
            if not piece:
                return None
            self._ahead += piece
        request = bytes(self._ahead[: end.end()])
        del self._ahead[: end.end()]
        return request

    def _answer(self, request: Request) -> bytes:
        if request.method == "POST":
            response = self._ordered(request)
        else:
            with self._answering:
                response = self._got(request)
                if gzip_accepted(request.header("accept-encoding")):
                    response = response.zipped
        return _encoded(response, is_last=request.is_last, is_head=request.method == "HEAD")

    def _got(self, request: Request) -> Response:
        if request.method not in ("GET", "HEAD"):
            return plain(HTTPStatus.NOT_IMPLEMENTED, "there are GET, HEAD and POST")
        if request.path in PAGES and is_foreign([request.host], request.headers.get("origin", ())):
            return plain(HTTPStatus.FORBIDDEN, "open the page at this computer's address, or at a local name of it")
        if request.path == "/tap":
            return _for_owner()
        if request.path == "/metrics":
            return self._responder.metrics(request.header("accept"))
        try:
            query = parse_qs(request.query, max_num_fields=MAX_IN_QUERY)
        except ValueError:
            return plain(HTTPStatus.BAD_REQUEST, f"a query can have at most {MAX_IN_QUERY} values")
        return self._responder.get(request.path, query)

    def _ordered(self, request: Request) -> Response:
        order: Callable[[], Response]
        if self._is_owner:
            order = partial(self._responder.post, request.path)
        elif request.path == SAVE and is_own_page(request.host, request.headers):
            order = self._responder.save_for_page
        else:
            return _for_owner()
        with self._ordering:
            return order()

    def _tap(self, request: Request) -> None:
        running = self._responder.running
        try:
            query = parse_qs(request.query, max_num_fields=MAX_IN_QUERY)
            cases, sources, decisions = (query.get(key, []) for key in ("case", "from", "only"))
            is_wanted = wanted(running.program, cases, sources, decisions)
        except (TapRequestError, ValueError) as error:
            self._send(_encoded(plain(HTTPStatus.BAD_REQUEST, str(error)), is_last=True))
            return
        if not self._connections.admit_tap(self._connection):
            busy = plain(HTTPStatus.SERVICE_UNAVAILABLE, f"there are {MAX_TAPS} taps already: close one")
            self._send(_encoded(busy, is_last=True))
            return
        with closing(Tap(running.mirror, is_wanted, with_actions=not sources and not decisions)) as tap:
            headers = {"Content-Type": CONTENT_TYPE, "Connection": "close"}
            self._send(_head(HTTPStatus.OK, headers))  # at once: from the response on, the client misses nothing
            self._stream(tap.stream())

    def _stream(self, pieces: Iterator[bytes]) -> None:
        self._connection.settimeout(IDLE_SECONDS)
        for piece in pieces:
            left = memoryview(piece)
            while left:
                left = left[self._connection.send(left) :]

    def _send(self, data: bytes) -> None:
        self._connection.settimeout(RESPONSE_SECONDS)
        self._connection.sendall(data)  # the timeout is for all of it

    def _linger(self) -> None:
        """Read what still comes after a rejected request, for a while (RFC 9112, 9.6)."""
        with suppress(OSError):  # the client has left already
            self._connection.shutdown(socket.SHUT_WR)
        deadline, left = monotonic() + LINGER_SECONDS, MAX_LINGER
        while left > 0:
            self._connection.settimeout(max(0.001, deadline - monotonic()))
            if not (piece := self._connection.recv(MAX_REQUEST)):
                return
            left -= len(piece)


def _encoded(response: Response, *, is_last: bool, is_head: bool = False) -> bytes:
    """Return a response as bytes. With `is_head`, it has no body."""
    headers = {
        "Content-Type": response.kind,
        "Content-Length": str(len(response.body)),
        "X-Content-Type-Options": "nosniff",
        **({"Connection": "close"} if is_last else {}),
        **response.headers,
    }
    return _head(response.status, headers) + (b"" if is_head else response.body)


def _head(status: HTTPStatus, headers: Mapping[str, str]) -> bytes:
    lines = [f"HTTP/1.1 {status.value} {status.phrase}", f"Date: {formatdate(usegmt=True)}", "Cache-Control: no-store"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    return "\r\n".join([*lines, "", ""]).encode("latin-1")


def _for_owner() -> Response:
    try:
        user = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:  # without a name, as in a container
        user = str(os.geteuid())
    what = f"only for user {user} and root, with the command line on the router's own computer"
    return plain(HTTPStatus.FORBIDDEN, what)


def is_own_page(host: str, headers: Mapping[str, Sequence[str]]) -> bool:
    """Return whether a browser sends this from a page of this server. A proxy may serve the page over TLS."""
    origins = headers.get("origin", ())
    is_same = len(origins) == 1 and not is_foreign([host], origins)
    return is_same and headers.get("sec-fetch-site", ["same-origin"]) == ["same-origin"]
