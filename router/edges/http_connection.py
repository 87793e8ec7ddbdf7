"""One connection over HTTP: takes requests, turns away who may not ask, writes answers, feeds taps.

Knows the protocol; what is answered comes from `http_answers` and `http_tap`.
"""

from __future__ import annotations

import gzip
import socket
from collections.abc import Callable
from contextlib import closing
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any
from urllib.parse import parse_qs

from prometheus_client.exposition import gzip_accepted

from router.edges.http_answers import Answer, Answers, text
from router.edges.http_callers import refusal
from router.edges.http_tap import Tap, TapRequestError, wanted
from router.edges.tap_stream import CONTENT_TYPE

IDLE_SECONDS = 30.0
"""A connection ends when nothing is asked for so long, or nothing taken of an answer."""

GZIP_FROM = 1000
"""Bytes of an answer that are worth compressing."""


class Connection(BaseHTTPRequestHandler):
    """Lives in a thread of its own until the other end goes.

    `waits` and `asks` are called when it begins to wait for a request, and when there is a whole one.
    """

    protocol_version = "HTTP/1.1"
    timeout = IDLE_SECONDS
    wbufsize = -1
    """Head and body of an answer leave together."""

    def __init__(
        self,
        answers: Answers,
        waits: Callable[[socket.socket], None],
        asks: Callable[[socket.socket], None],
        *connection: Any,
    ) -> None:
        self._answers = answers
        self._waits = waits
        self._asks = asks
        super().__init__(*connection)

    def handle_one_request(self) -> None:
        self._waits(self.connection)
        super().handle_one_request()

    def parse_request(self) -> bool:
        is_whole = super().parse_request()
        self._asks(self.connection)
        return is_whole

    def do_GET(self) -> None:
        path, _, asked = self.path.partition("?")
        query = parse_qs(asked)
        if path == "/tap":
            self._for_programs_here(lambda: self._tap(query.get("case", []), query.get("from", [])))
        elif path == "/metrics":
            self._answer(self._answers.metrics(self.headers.get("Accept", "")))
        else:
            self._answer(self._answers.get(path, query))

    do_HEAD = do_GET  # noqa: N815 - as http.server calls it

    def do_POST(self) -> None:
        self.close_connection = True  # what it may have brought along is not read
        self._for_programs_here(lambda: self._answer(self._answers.post(self.path.partition("?")[0])))

    def _for_programs_here(self, serve: Callable[[], None]) -> None:
        why = refusal(self.client_address[0], self.connection.getsockname()[0], self.headers)
        if why is None:
            serve()
        else:
            self._answer(text(HTTPStatus.FORBIDDEN, why))

    def _answer(self, answer: Answer) -> None:
        body = answer.body
        zipped = len(body) >= GZIP_FROM and gzip_accepted(self.headers.get("Accept-Encoding", ""))
        if zipped:
            body = gzip.compress(body, compresslevel=1)
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        if zipped:
            self.send_header("Content-Encoding", "gzip")
        for name, value in answer.headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _tap(self, cases: list[str], sources: list[str]) -> None:
        running = self._answers.running
        try:
            wants = wanted(running.program, cases, sources)
        except TapRequestError as error:
            self._answer(text(HTTPStatus.BAD_REQUEST, str(error)))
            return
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command == "HEAD":
            return
        with closing(Tap(running.mirror, wants)) as tap:
            for piece in tap.stream():
                self.wfile.write(piece)
                self.wfile.flush()

    def version_string(self) -> str:
        return "router"

    def log_message(self, *_: object) -> None:
        """Nobody wants a line a second of each page that is open."""
