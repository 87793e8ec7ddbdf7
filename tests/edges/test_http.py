"""What a running router answers over HTTP, to whom, and what it does when it is told to."""

from __future__ import annotations

import http.client
import json
import socket
import struct
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from email.message import Message
from pathlib import Path
from typing import Any

import pytest

import router.edges.http
import router.edges.http_answers
from router.edges.http import MOST_CONNECTIONS, HttpServer
from router.edges.http_callers import refusal
from router.edges.log import logger
from router.edges.running import ReloadResult
from router.errors import Code, Diagnostic, RouterError, SourceSpan
from router.table.model import Address
from tests.acceptance.site import wait_until
from tests.edges.fake_running import FakeRunning, sim_program

SPAN = SourceSpan("routes/sim.yaml", 8, 20, 34)
LOOPBACK = Address("127.0.0.1", 0)


@pytest.fixture
def running() -> FakeRunning:
    return FakeRunning(sim_program())


@pytest.fixture
def saved() -> list[Path | RouterError]:
    """What the next order to save comes to."""
    return [Path("recordings/last.mcap")]


@pytest.fixture
def server(running: FakeRunning, saved: list[Path | RouterError]) -> Iterator[HttpServer]:
    def save(reason: str) -> Path:
        assert reason == "http"
        if isinstance(saved[0], RouterError):
            raise saved[0]
        return saved[0]

    with closing(HttpServer(LOOPBACK, SPAN, running, save)) as opened:
        yield opened


class Answer:
    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status = response.status
        self.headers = response.headers
        self.text = response.read().decode()

    @property
    def json(self) -> Any:
        return json.loads(self.text)


def ask(server: HttpServer, path: str, method: str = "GET", headers: Mapping[str, str] | None = None) -> Answer:
    with closing(http.client.HTTPConnection(*server.address, timeout=10)) as connection:
        connection.request(method, path, headers=dict(headers or {}))
        return Answer(connection.getresponse())


def test_health_is_that_the_receive_thread_gets_further(
    server: HttpServer, running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(router.edges.http_answers, "STUCK_SECONDS", 0.2)
    assert ask(server, "/healthz").status == 200
    running.is_stuck = True
    stuck = ask(server, "/healthz")
    assert (stuck.status, stuck.text) == (503, "the receive thread is stuck, for 0.2 s at least\n")


def test_ready_is_that_everything_is_open(server: HttpServer, running: FakeRunning) -> None:
    assert ask(server, "/ready").status == 200
    running.is_ready = False
    assert ask(server, "/ready").status == 503
    assert ask(server, "/healthz").status == 200


def test_the_page_may_load_nothing_from_elsewhere(server: HttpServer) -> None:
    page = ask(server, "/")
    assert page.headers["Content-Type"] == "text/html; charset=utf-8"
    policy = page.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "connect-src 'self'" in policy
    assert "unsafe" not in policy
    addresses = [word for word in page.text.split() if "://" in word]
    assert [address for address in addresses if "www.w3.org/2000/svg" not in address] == []


def test_what_is_long_is_compressed_for_who_takes_it(server: HttpServer) -> None:
    assert ask(server, "/metrics").headers["Content-Encoding"] is None
    assert ask_raw(server, "/metrics", {"Accept-Encoding": "gzip"})[:2] == b"\x1f\x8b"


def ask_raw(server: HttpServer, path: str, headers: Mapping[str, str]) -> bytes:
    with closing(http.client.HTTPConnection(*server.address, timeout=10)) as connection:
        connection.request("GET", path, headers=dict(headers))
        return connection.getresponse().read()


@pytest.mark.parametrize("path", ["/metrics", "/ready", "/", "/status.json", "/nothing"])
def test_a_head_without_a_body_tells_how_long_it_would_be(server: HttpServer, path: str) -> None:
    head = ask(server, path, "HEAD")
    assert head.text == ""
    assert int(head.headers["Content-Length"]) > 0


def test_the_head_of_a_tap_ends(server: HttpServer) -> None:
    head = ask(server, "/tap", "HEAD")
    assert (head.status, head.text) == (200, "")


def test_a_connection_serves_one_question_after_the_other(server: HttpServer) -> None:
    with closing(http.client.HTTPConnection(*server.address, timeout=10)) as connection:
        for path in ("/status.json", "/nothing", "/ready"):
            connection.request("GET", path)
            connection.getresponse().read()
            assert connection.sock is not None


def test_what_there_is_not_is_said(server: HttpServer) -> None:
    assert ask(server, "/nothing").status == 404
    assert ask(server, "/-/nothing", "POST").status == 404
    assert ask(server, "/-/reload").status == 405
    assert ask(server, "/map.json?width=huge").status == 400


def test_an_order_to_reload_says_what_came_of_it(server: HttpServer, running: FakeRunning) -> None:
    answer = ask(server, "/-/reload", "POST")
    assert (answer.status, answer.json) == (200, {"ok": True, "text": "nothing has changed", "findings": []})
    finding = Diagnostic(SPAN, Code.UNKNOWN_FIELD, "there is no 'x'", "did you mean 'y'?")
    running.reloads = ReloadResult(False, (finding,), "nothing was changed: 1 error")
    answer = ask(server, "/-/reload", "POST")
    assert answer.status == 422
    assert answer.json["findings"] == ["routes/sim.yaml:8:20: error[unknown-field]: there is no 'x'; did you mean 'y'?"]


def test_an_order_to_save_gives_the_file(server: HttpServer, saved: list[Path | RouterError]) -> None:
    assert ask(server, "/record/save", "POST").json == {"ok": True, "file": "recordings/last.mcap"}
    saved[0] = RouterError("the disk is full")
    answer = ask(server, "/record/save", "POST")
    assert (answer.status, answer.json) == (409, {"ok": False, "text": "the disk is full"})


def test_what_is_not_kept_cannot_be_saved(running: FakeRunning) -> None:
    with closing(HttpServer(LOOPBACK, SPAN, running, None)) as server:
        answer = ask(server, "/record/save", "POST")
    assert answer.status == 404
    assert "record: {last: 60s}" in answer.json["text"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://127.0.0.1:9108"},
        {"Origin": ""},
        {"Sec-Fetch-Site": "cross-site"},
        {"Host": "rover.example.org"},
        {"Host": "rover.example.org:9108"},
        {"Host": "127.0.0.1.example.org"},
    ],
)
@pytest.mark.parametrize(("method", "path"), [("POST", "/-/reload"), ("POST", "/record/save"), ("GET", "/tap")])
def test_a_page_in_a_browser_can_neither_order_nor_tap(
    server: HttpServer, method: str, path: str, headers: Mapping[str, str]
) -> None:
    assert ask(server, path, method, headers).status == 403


@pytest.mark.parametrize(
    ("peer", "own", "is_refused"),
    [
        ("127.0.0.1", "127.0.0.1", False),
        ("127.0.7.1", "127.0.0.1", False),
        ("192.168.0.5", "192.168.0.5", False),
        ("192.168.0.6", "192.168.0.5", True),
    ],
)
def test_only_the_own_computer_can_order(peer: str, own: str, is_refused: bool) -> None:
    headers = Message()
    headers["Host"] = f"{own}:9108"
    assert (refusal(peer, own, headers) is not None) == is_refused


def test_who_names_two_hosts_can_order_nothing() -> None:
    headers = Message()
    headers["Host"], headers["host"] = "127.0.0.1:9108", "rover.example.org"
    assert refusal("127.0.0.1", "127.0.0.1", headers) is not None


def test_of_too_many_connections_the_last_are_closed(server: HttpServer) -> None:
    kept = [socket.create_connection(server.address, 10) for _ in range(MOST_CONNECTIONS)]
    try:
        with socket.create_connection(server.address, 10) as beyond:
            assert beyond.recv(1) == b""
    finally:
        for each in kept:
            each.close()
    wait_until(lambda: answers(server), "room for one more")


def test_who_does_not_come_to_an_end_makes_room_for_others(server: HttpServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(router.edges.http, "PATIENCE", 0.2)
    with ExitStack() as opened:
        slow = [opened.enter_context(socket.create_connection(server.address, 10)) for _ in range(MOST_CONNECTIONS)]
        for each in slow:
            each.sendall(b"GET /ready HTTP/1.1\r\nHost: 127")
        for _ in range(3):
            wait_until(lambda: answers(server), "room for one more")


def answers(server: HttpServer) -> bool:
    try:
        return ask(server, "/ready").status == 200
    except (OSError, http.client.HTTPException):
        return False


@pytest.mark.parametrize(
    "nonsense",
    [
        b"",
        b"GET\r\n\r\n",
        b"\x16\x03\x01" + bytes(100),
        b"GET / HTTP/1.1\r\nA: " + b"x" * 99999,
        b"GET http://[::1 HTTP/1.1\r\n\r\n",
        b"GET /tap?case=%ff%00&&==;&from=[ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_nonsense_ends_its_own_connection_only(
    server: HttpServer, nonsense: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(logger, "critical", lambda event, **_: told.append(event))
    with socket.create_connection(server.address, 10) as caller:
        caller.sendall(nonsense)
        caller.shutdown(socket.SHUT_WR)
        while caller.recv(65536):
            pass
    assert ask(server, "/ready").status == 200
    assert not told


def test_closing_minds_nobody_who_has_gone(running: FakeRunning) -> None:
    """His reset tells the kernel, but the thread that waits for his next question learns of it late."""
    for _ in range(20):
        server = HttpServer(LOOPBACK, SPAN, running, None)
        callers = [socket.create_connection(server.address, 10) for _ in range(5)]
        for caller in callers:
            caller.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            caller.sendall(b"GET /tap HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            caller.close()
        server.close()
    wait_until(lambda: not running.mirror._consumers, "the end of the taps")


def test_closing_ends_what_is_open(running: FakeRunning) -> None:
    server = HttpServer(LOOPBACK, SPAN, running, None)
    with closing(http.client.HTTPConnection(*server.address, timeout=10)) as connection:
        connection.request("GET", "/tap")
        response = connection.getresponse()
        server.close()
        response.read()
    running.mirror.close()
    assert running.failures == []
