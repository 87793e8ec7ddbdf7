"""An HTTP server that has /metrics and /health.json, and nothing else."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from http.server import BaseHTTPRequestHandler, HTTPServer

from router.observe.problems import Problem
from router.observe.services import ServiceReading
from router.observe.states import StateReading

COLLECTED_AT = 1_500_000_000.25
"""The time at which the metrics were collected, in s."""


@contextmanager
def answering(
    text: str,
    address: tuple[str, int] = ("127.0.0.1", 0),
    status: int = 200,
    problems: Sequence[Problem] = (),
    states: Sequence[StateReading] = (),
    services: Sequence[ServiceReading] = (),
    learned: Mapping[str, str] | None = None,
    table: str = "",
    health: str | None = None,
) -> Iterator[str]:
    """Yield the server's URL. `text` is the text of /metrics, `table` the SHA-256 of the running table.

    `health` replaces the whole text of /health.json.
    """
    if health is None:
        listed = [problem.json() for problem in problems]
        shown = [asdict(state) for state in states]
        known = {"name": "rover.yaml", "table": table, "received": 7, "states": shown, "learned": learned or {}}
        known |= {"services": [asdict(service) for service in services]}
        health = json.dumps({**known, "problems": listed})
    answers = {"/metrics": text, "/health.json": health}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status if self.path in answers else 404)
            self.send_header("X-Collected-At", str(COLLECTED_AT))
            self.end_headers()
            self.wfile.write(answers.get(self.path, "").encode())

        def log_message(self, *_: object) -> None:
            """Log nothing."""

    with HTTPServer(address, Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
