"""One connection over HTTP: takes requests, turns away who may not ask, writes answers, feeds taps.

Knows the protocol; what is answered comes from `http_answers` and `http_tap`.
"""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from io import BytesIO
from time import monotonic, sleep
from typing import Any
from urllib.parse import parse_qs

from prometheus_client.exposition import gzip_accepted

from router.observe.http_answers import Answer, Answers, text
from router.observe.http_callers import refusal
from router.observe.http_places import MOST_TAPS, Places, reset
from router.observe.http_tap import Tap, TapRequestError, wanted
from router.observe.tap_stream import CONTENT_TYPE

IDLE_SECONDS = 30.0
"""A connection ends when there is no whole request for so long, or nothing is taken of a tap."""

ANSWER_SECONDS = 10.0
"""A connection ends when an answer is not taken as a whole within so long."""

REST_SECONDS = 0.05
"""Between two requests on a connection, so that who asks without end costs routing little."""

MOST_ANSWERING = 4
MOST_ORDERS = 4
LONGEST_REQUEST = 1 << 14
MOST_IN_QUERY = 200

MOST_IN_KERNEL = 1 << 17
"""Bytes that wait there for a slow other end."""

_END = re.compile(rb"\r?\n\r?\n")


class Connection(BaseHTTPRequestHandler):
    """Lives in a thread of its own until the other end goes.

    A request is read as a whole, then answered into memory, which at most MOST_ANSWERING threads do at a time, and then
    sent: a slow other end holds up its own connection only.
    """

    protocol_version = "HTTP/1.1"

    _answering = threading.BoundedSemaphore(MOST_ANSWERING)
    _ordering = threading.BoundedSemaphore(MOST_ORDERS)

    def __init__(self, answers: Answers, places: Places, *connection: Any) -> None:
        self._answers = answers
        self._places = places
        self._ahead = bytearray()
        self._out = BytesIO()
        self._takes_long: Callable[[], None] | None = None
        super().__init__(*connection)

    def setup(self) -> None:
        self.connection = self.request
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_IN_KERNEL)

    def finish(self) -> None:
        """There is nothing to flush."""

    def handle(self) -> None:
        self.close_connection = False
        while (request := self._request()) is not None:
            self.rfile = BytesIO(request)
            self.wfile = self._out = BytesIO()
            self._places.asks(self.connection)
            with self._answering:
                if not self._places.asks(self.connection):
                    return  # somebody else has its place, so nobody would take the answer
                self.handle_one_request()
            if (takes_long := self._takes_long) is not None:
                self._takes_long = None
                takes_long()
            self._send()
            if self.close_connection:
                return
            sleep(REST_SECONDS)

    def _request(self) -> bytes | None:
        """The lines of the next request; None where no whole one comes, or one beyond LONGEST_REQUEST."""
        deadline, looked_at = monotonic() + IDLE_SECONDS, 0
        while (end := _END.search(self._ahead, looked_at)) is None:
            if len(self._ahead) > LONGEST_REQUEST:
                return None
            looked_at = max(0, len(self._ahead) - 3)
            self.connection.settimeout(max(0.001, deadline - monotonic()))
            if not (piece := self.connection.recv(LONGEST_REQUEST)):
                return None
            self._ahead += piece
        request = bytes(self._ahead[: end.end()])
        del self._ahead[: end.end()]
        return request

    def _send(self) -> None:
        self.connection.settimeout(ANSWER_SECONDS)
        self._places.is_answered(self.connection)
        try:
            self.connection.sendall(self._out.getvalue())  # the timeout is that of the whole
        except TimeoutError:
            reset(self.connection)
            raise
        self._places.is_answered(self.connection)

    def do_GET(self) -> None:
        path, _, asked = self.path.partition("?")
        try:
            query = parse_qs(asked, max_num_fields=MOST_IN_QUERY)
        except ValueError:
            self._answer(text(HTTPStatus.BAD_REQUEST, f"at most {MOST_IN_QUERY} values can be asked for"))
            return
        if path == "/tap":
            self._for_programs_here(lambda: self._tap(query.get("case", []), query.get("from", [])))
        elif path == "/metrics":
            self._answer(self._answers.metrics(self.headers.get("Accept", "")))
        elif path == "/healthz":
            self._takes_long = lambda: self._answer(self._answers.healthz())
        else:
            self._answer(self._answers.get(path, query))

    do_HEAD = do_GET  # noqa: N815 - as http.server calls it

    def do_POST(self) -> None:
        self.close_connection = True  # what it may have brought along is not read
        self._for_programs_here(self._order)

    def _for_programs_here(self, serve: Callable[[], None]) -> None:
        why = refusal(self.client_address[0], self.connection.getsockname()[0], self.headers)
        if why is None:
            self._takes_long = serve
        else:
            self._answer(text(HTTPStatus.FORBIDDEN, why))

    def _order(self) -> None:
        with self._ordering, self._places.busy(self.connection):
            self._answer(self._answers.post(self.path.partition("?")[0]))

    def _answer(self, answer: Answer) -> None:
        if gzip_accepted(self.headers.get("Accept-Encoding", "")):
            answer = answer.zipped
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        for name, value in answer.headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)

    def _tap(self, cases: list[str], sources: list[str]) -> None:
        running = self._answers.running
        try:
            wants = wanted(running.program, cases, sources)
        except TapRequestError as error:
            self._answer(text(HTTPStatus.BAD_REQUEST, str(error)))
            return
        if not self._places.enter_tap(self.connection):
            self._answer(text(HTTPStatus.SERVICE_UNAVAILABLE, f"there are {MOST_TAPS} taps already: end one"))
            return
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command == "HEAD":
            return
        self._send()
        self._out = BytesIO()
        with closing(Tap(running.mirror, wants)) as tap:
            self._stream(tap.stream())

    def _stream(self, pieces: Iterator[bytes]) -> None:
        self.connection.settimeout(IDLE_SECONDS)
        for piece in pieces:
            left = memoryview(piece)
            while left:
                left = left[self.connection.send(left) :]
            self._places.is_answered(self.connection)

    def version_string(self) -> str:
        return "router"

    def log_message(self, *_: object) -> None:
        """Nobody wants a line a second of each page that is open."""
