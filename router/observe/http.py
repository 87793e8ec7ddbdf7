"""HTTP of a running router: metrics, health, the status page; and for programs on the same computer taps and orders.

    GET  /             the status page; /status.json and /map.json are what it asks for
    GET  /metrics      for Prometheus
    GET  /healthz      200 while datagrams are received or could be, 503 where the receive thread is stuck
    GET  /ready        200 while everything is open
    GET  /tap          what is received, before routing (see tap_stream): ?case=NAME&from=ENDPOINT, each several times
    POST /-/reload     {"ok", "text", "findings"}: 200, or 422 where nothing was changed
    POST /record/save  {"ok", "file"}: 200; {"ok", "text"}: 409 where it failed, 404 where nothing is kept

Each connection has a thread, which has no right to interrupt one that routes.
"""

from __future__ import annotations

import errno
import socket
import sys
import threading
from collections.abc import Callable
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

from router.errors import SourceSpan, StartError
from router.log import logger
from router.net.kernel import port_holder
from router.observe.http_answers import Answers
from router.observe.http_callers import is_own_computer
from router.observe.http_connection import Connection
from router.observe.http_places import OWN_COMPUTER, Places
from router.observe.running import Running
from router.observe.status import Status
from router.table.model import Address


class HttpServer:
    """Answers at `address` until closed. `save` writes the last datagrams to a file; None where none are kept.

    Raises StartError where it cannot be opened.
    """

    def __init__(
        self, address: Address, span: SourceSpan, running: Running, save: Callable[[str], Path] | None
    ) -> None:
        self._status = Status(running)
        try:
            self._server = _Server(address, Answers(running, self._status, save))
        except OSError as error:
            in_use = error.errno == errno.EADDRINUSE
            why = f"{port_holder('tcp', address.port)} has the port" if in_use else error.strerror
            raise StartError(
                f"{span}: metrics cannot be served at {address}: {why}; choose another metrics.address"
            ) from error
        self._thread = threading.Thread(target=self._server.serve_forever, name="http", daemon=True)
        self._thread.start()
        self.address = Address(address.host, self._server.server_port)

    def close(self) -> None:
        # The server looks every half second whether it is to stop, and whenever its socket stirs.
        self._server.socket.shutdown(socket.SHUT_RDWR)
        self._server.shutdown()
        self._thread.join()
        self._server.places.end_all()
        self._server.server_close()
        self._status.close()


class _Server(ThreadingHTTPServer):
    """A thread for each connection that has one of `Places`; others are closed at once."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 256

    def __init__(self, address: Address, answers: Answers) -> None:
        self.places = Places()
        super().__init__(address, partial(Connection, answers, self.places))

    def server_bind(self) -> None:
        """As HTTPServer does, but without asking the network for this computer's name."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def verify_request(self, request: Any, client_address: Any) -> bool:
        is_own = is_own_computer(client_address[0], request.getsockname()[0])
        return self.places.enter(request, OWN_COMPUTER if is_own else client_address[0])

    def shutdown_request(self, request: Any) -> None:
        self.places.leave(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Called in an except block. Callers come and go as they like; the rest is our own fault."""
        error = sys.exc_info()[1]
        if not isinstance(error, (ConnectionError, TimeoutError)):
            logger.critical("a fault in the router itself lost an answer over HTTP; please report it", exc_info=error)
