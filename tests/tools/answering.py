"""An HTTP server that has /metrics and /healthz, and nothing else."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer

COLLECTED_AT = 1_500_000_000.25
"""When its numbers were read, s."""


@contextmanager
def answering(
    text: str, address: tuple[str, int] = ("127.0.0.1", 0), status: int = 200, healthz: int = 200
) -> Iterator[str]:
    """Yield its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response({"/metrics": status, "/healthz": healthz}.get(self.path, 404))
            self.send_header("X-Collected-At", str(COLLECTED_AT))
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            """Quiet."""

    with HTTPServer(address, Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
