"""What tools ask of a running router over HTTP, and what they say where there is none."""

from __future__ import annotations

import http.server
import socket
import threading
from collections.abc import Iterator

import pytest

from router.errors import TransportError, UsageError
from router.tools.running_router import metrics


@pytest.fixture
def url() -> Iterator[str]:
    """Of a server that has metrics and nothing else."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/metrics" else 404)
            self.send_header("X-Collected-At", "1500000000.25")
            self.end_headers()
            self.wfile.write(b"# nothing yet\n")

        def log_message(self, *args: object) -> None:
            """Quiet."""

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_metrics_are_asked_for_at_the_router_and_no_proxy(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    assert metrics(url) == metrics(url.removeprefix("http://")) == ("# nothing yet\n", 1500000000.25)


def test_where_nobody_answers_is_a_network_fault() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        with pytest.raises(
            TransportError,
            match=r"no router answers at .*; is it running\? another table, or --url, names another router",
        ):
            metrics(f"http://127.0.0.1:{nobody.getsockname()[1]}")


def test_what_is_no_router_is_told_by_its_answer() -> None:
    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(503, "starting")

        def log_message(self, *args: object) -> None:
            """Quiet."""

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        with pytest.raises(TransportError, match=r"/metrics: 503 "):
            metrics(f"http://127.0.0.1:{server.server_port}")
        thread.join()


@pytest.mark.parametrize(
    "url",
    [
        "https://127.0.0.1:9108",
        "http://",
        "ftp://rover",
        "http://a:99999",
        "http://a:b",
        "http://[::1",
        "http://rover..local",
        f"http://{'a' * 64}:9108",
    ],
)
def test_what_is_no_address_of_a_router_is_a_wrong_use(url: str) -> None:
    with pytest.raises(UsageError, match="is not like http://127"):
        metrics(url)
