"""What a running router answers over HTTP, to whom, and what it does when it is told to."""

from __future__ import annotations

import errno
import gzip
import http.client
import json
import re
import select
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from http import HTTPStatus
from ipaddress import IPv4Network
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from router.errors import Code, Diagnostic, RouterError
from router.log import logger
from router.net import control, doors
from router.observe import http as server_module
from router.observe import responses, status
from router.observe.http import MAX_ANSWERING, MAX_FROM_OTHERS, MAX_PER_HOST, MAX_TAPS, HttpServer, is_own_page
from router.observe.responses import plain
from router.observe.route_map import Edge, Node, nodes_and_edges
from router.observe.running import ReloadResult
from router.table.addresses import Address
from router.table.model import RouteTable
from tests.acceptance.site import wait_until
from tests.observe.fake_running import SPAN, FakeRunning, served, sim_program


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

    with closing(served(running, save)) as opened:
        yield opened


class Answer:
    """`data` as it was sent; `text` and `json` of what is not compressed."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status = response.status
        self.headers = response.headers
        self.data = response.read()

    @property
    def text(self) -> str:
        return self.data.decode()

    @property
    def json(self) -> Any:
        return json.loads(self.data)


def connected(server: HttpServer, *, is_owner: bool = False) -> http.client.HTTPConnection:
    connection = http.client.HTTPConnection(*server.address, timeout=10)
    if is_owner:
        connection.sock = control.connect(*server.address, 10)
    return connection


@contextmanager
def asking(
    server: HttpServer, path: str, method: str = "GET", *, is_owner: bool = True
) -> Iterator[http.client.HTTPConnection]:
    """A connection that has asked, and whose answer is not read yet."""
    with closing(connected(server, is_owner=is_owner)) as connection:
        connection.request(method, path)
        yield connection


def ask(server: HttpServer, path: str, method: str = "GET", headers: Mapping[str, str] | None = None) -> Answer:
    with closing(connected(server)) as connection:
        connection.request(method, path, headers=dict(headers or {}))
        return Answer(connection.getresponse())


def order(server: HttpServer, path: str) -> Answer:
    """Post as the router's user does, at the control socket."""
    with asking(server, path, "POST") as connection:
        return Answer(connection.getresponse())


def test_it_serves_at_an_ipv6_address(running: FakeRunning) -> None:
    networks = [IPv4Network("10.0.0.0/8")]  # and the own computer
    with closing(served(running, lambda _: Path("last.mcap"), Address("::1", 0), networks=networks)) as server:
        assert str(server.address).startswith("[::1]:")
        assert ask(server, "/status.json").status == 200
        assert ask(server, "/status.json", headers={"Host": "rover.example.org"}).status == 403
        own = {"Host": str(server.address), "Origin": f"http://{server.address}", "Sec-Fetch-Site": "same-origin"}
        assert ask(server, "/record/save", "POST", own).status == 200
        assert ask(server, "/record/save", "POST", {**own, "Origin": "http://[fd00::1]:9108"}).status == 403
        assert order(server, "/-/reload").status == 200
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", server.address.port), 10)


def test_target_may_be_a_whole_url_and_its_host_counts(server: HttpServer) -> None:
    for target, answer in (("http://rover:9108/status.json", 200), ("http://rover.example.org/status.json", 403)):
        with closing(connected(server)) as connection:
            connection.request("GET", target, headers={"Host": "rover"})
            assert connection.getresponse().status == answer


def test_health_is_that_the_receive_thread_gets_further(server: HttpServer, running: FakeRunning) -> None:
    assert ask(server, "/healthz").status == 200
    running.is_stuck = True
    stuck = ask(server, "/healthz")
    assert (stuck.status, stuck.text) == (503, "the receive thread is stuck\n")


def test_what_is_wrong_is_told_in_words_and_for_programs(
    server: HttpServer, running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(responses, "KEPT_SECONDS", 0)
    running.count("config_last_reload_successful", to=1)
    running.count("datagrams_received", "rover", to=7)
    sound = ask(server, "/health.json").json
    assert sound == {
        "name": "sim.yaml",
        "table": running.program.table.sha256,
        "received": 7,
        "states": [],
        "services": [],
        "learned": {},
        "problems": [],
    }
    running.count("deadman_active", "manual_drive", to=1)
    [problem] = ask(server, "/health.json").json["problems"]
    assert (problem["kind"], problem["level"]) == ("DeadmanActive", "warning")
    assert (problem["labels"], problem["routes"]) == ({"route": "manual_drive"}, ["manual_drive"])
    assert problem["words"] == "manual_drive is stopped by its deadman: no commands get through"
    assert problem["remedy"].startswith("Check that they are sent, and more often than")


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


def test_a_head_without_a_body_tells_how_long_it_would_be(server: HttpServer) -> None:
    for path in ("/metrics", "/ready", "/", "/status.json", "/nothing"):
        head = ask(server, path, "HEAD")
        assert (head.data, int(head.headers["Content-Length"]) > 0) == (b"", True), path


def test_a_connection_serves_one_question_after_the_other(server: HttpServer) -> None:
    with closing(http.client.HTTPConnection(*server.address, timeout=10)) as connection:
        for path in ("/status.json", "/nothing", "/ready"):
            connection.request("GET", path)
            connection.getresponse().read()
            assert connection.sock is not None


def test_what_there_is_not_is_said(server: HttpServer) -> None:
    assert ask(server, "/nothing").status == 404
    assert order(server, "/-/nothing").status == 404
    assert ask(server, "/-/reload").status == 405
    assert ask(server, "/map.json?" + "width=wide&" * 1000).status == 400


def test_no_page_says_where_the_table_is(server: HttpServer, running: FakeRunning) -> None:
    path = running.program.table.path
    for page in ("/", "/status.json", "/recent.json", "/map.json", "/metrics", "/healthz", "/ready", "/nothing"):
        assert f"{path.parent.name}/{path.name}" not in ask(server, page).text, page
    assert ask(server, "/map.json").json["name"] == path.name


def test_an_order_to_reload_says_what_came_of_it(server: HttpServer, running: FakeRunning) -> None:
    answer = order(server, "/-/reload")
    assert (answer.status, answer.json) == (200, {"ok": True, "text": "nothing has changed", "findings": []})
    finding = Diagnostic(SPAN, Code.UNKNOWN_FIELD, "there is no 'x'", "did you mean 'y'?")
    running.reloads = ReloadResult(False, (finding,), "nothing was changed: 1 error")
    answer = order(server, "/-/reload")
    assert answer.status == 422
    assert answer.json["findings"] == ["routes/sim.yaml:8:20: error[unknown-field]: there is no 'x'; did you mean 'y'?"]


def test_an_order_to_save_gives_the_file(server: HttpServer, saved: list[Path | RouterError]) -> None:
    assert order(server, "/record/save").json == {"ok": True, "file": "recordings/last.mcap"}
    saved[0] = RouterError("the disk is full")
    answer = order(server, "/record/save")
    assert (answer.status, answer.json) == (409, {"ok": False, "text": "the disk is full"})


def test_what_is_not_kept_cannot_be_saved(running: FakeRunning) -> None:
    with closing(served(running)) as server:
        answer = order(server, "/record/save")
    assert answer.status == 404
    assert "`last: 60s`" in answer.json["text"]


@pytest.mark.parametrize(("method", "path"), [("POST", "/-/reload"), ("POST", "/record/save"), ("GET", "/tap")])
def test_nobody_can_order_or_tap_over_tcp_whatever_a_proxy_sends(server: HttpServer, method: str, path: str) -> None:
    """The router's own computer neither: a proxy on it passes on what strangers ask."""
    for headers in ({}, {"Forwarded": "for=127.0.0.1"}, {"X-Forwarded-For": "127.0.0.1"}, {"Origin": ""}):
        answer = ask(server, path, method, headers)
        assert answer.status == 403, headers
        assert re.fullmatch(r"only for user \w+ and root, with the command line on .*\n", answer.text)


def test_another_user_of_the_computer_can_neither_order_nor_tap(
    server: HttpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "_owners", lambda: (12345,))
    assert order(server, "/-/reload").status == 403
    with asking(server, "/tap") as connection:
        assert connection.getresponse().status == 403


def test_a_router_at_all_addresses_is_controlled_by_each_of_them(running: FakeRunning) -> None:
    with closing(served(running, address=Address("0.0.0.0", 0))) as server:
        connection = control.connect("127.0.0.1", server.address.port, 10)
        connection.close()
        with pytest.raises(OSError, match="Cannot assign requested address"):
            control.connect("203.0.113.1", server.address.port, 10)


def test_two_routers_never_share_a_control_socket(server: HttpServer) -> None:
    with pytest.raises(OSError, match="Address already in use"):
        control.listen(*server.address)


def own_page(server: HttpServer, **others: str) -> dict[str, str]:
    """What a browser sends of itself for the status page, with the headers of `others` in place of its own."""
    host = str(server.address)
    own = {"Host": host, "Origin": f"http://{host}", "Sec-Fetch-Site": "same-origin"}
    return {**own, **{name.replace("_", "-"): value for name, value in others.items()}}


def test_the_own_page_can_save_and_learns_no_path(server: HttpServer, saved: list[Path | RouterError]) -> None:
    answer = ask(server, "/record/save", "POST", own_page(server))
    assert (answer.status, answer.json) == (200, {"ok": True, "file": "last.mcap"})


def test_why_the_own_page_could_not_save_has_no_path(
    server: HttpServer, running: FakeRunning, saved: list[Path | RouterError]
) -> None:
    record = running.program.table.record
    assert record is not None
    saved[0] = RouterError(f"cannot write to {record.directory}: No space left on device")
    answer = ask(server, "/record/save", "POST", own_page(server))
    assert answer.status == 409
    assert answer.json["text"] == f"cannot write to {record.directory.name}: No space left on device"


def test_pages_save_once_in_ten_seconds_and_the_command_line_whenever_it_likes(
    server: HttpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ask(server, "/record/save", "POST", own_page(server)).status == 200
    refused = ask(server, "/record/save", "POST", own_page(server))
    assert refused.status == 429
    assert re.fullmatch(r"a recording has just been saved: try again in ([1-9]|10) s", refused.json["text"])
    assert order(server, "/record/save").status == 200
    monkeypatch.setattr(responses, "SAVE_SECONDS", 0)
    assert ask(server, "/record/save", "POST", own_page(server)).status == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://rover.example.org"},
        {"Origin": "http://127.0.0.1"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "null"},
        {"Origin": ""},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
        {"Host": "rover.example.org:{port}", "Origin": "http://rover.example.org:{port}"},
        {"Host": "127.0.0.1.example.org:{port}", "Origin": "http://127.0.0.1.example.org:{port}"},
    ],
    ids=str,
)
def test_a_page_from_elsewhere_cannot_save(server: HttpServer, headers: dict[str, str]) -> None:
    host, port = str(server.address), str(server.address.port)
    sent = {name: value.replace("{host}", host).replace("{port}", port) for name, value in headers.items()}
    assert ask(server, "/record/save", "POST", own_page(server, **sent)).status == 403
    assert ask(server, "/record/save", "POST", own_page(server)).status == 200  # nothing was saved before


def test_the_own_page_can_save_behind_a_proxy_with_tls(server: HttpServer) -> None:
    headers = own_page(server, Host="rover.local:8443", Origin="https://rover.local:8443")
    assert ask(server, "/record/save", "POST", headers).status == 200


def test_the_own_page_can_save_and_nothing_else(server: HttpServer) -> None:
    assert ask(server, "/-/reload", "POST", own_page(server)).status == 403
    assert ask(server, "/tap", "GET", own_page(server)).status == 403


@pytest.mark.parametrize(
    ("host", "origins", "is_own"),
    [
        ("192.168.0.5:9108", ["http://192.168.0.5:9108"], True),
        ("localhost:9108", ["http://localhost:9108"], True),
        ("rover.lan", ["https://rover.lan"], True),
        ("rover.example.org", ["https://rover.example.org"], False),
        ("192.168.0.5:9108", ["http://192.168.0.6:9108"], False),
        ("192.168.0.5:9108", ["http://192.168.0.5:9108", "http://192.168.0.5:9108"], False),
        ("", ["http://192.168.0.5:9108"], False),
        ("192.168.0.5:9108", [], False),
    ],
)
def test_whose_page_asks_is_told_by_its_origin(host: str, origins: list[str], is_own: bool) -> None:
    assert is_own_page(host, {"origin": origins} if origins else {}) == is_own


@pytest.mark.parametrize("path", ["/", "/status.json", "/recent.json", "/map.json"])
def test_pages_of_other_hosts_cannot_read_what_the_status_page_shows(server: HttpServer, path: str) -> None:
    for headers in (
        {"Host": "rover.example.org"},
        {"Host": f"127.0.0.1.example.org:{server.address.port}"},
        {"Origin": "http://rover.example.org"},
        {"Origin": "null"},
    ):
        assert ask(server, path, headers=headers).status == 403, headers
    for headers in ({}, {"Host": "rover"}, {"Host": "rover.local:8080"}, {"Origin": f"http://{server.address}"}):
        assert ask(server, path, headers=headers).status == 200, headers


def test_programs_can_read_numbers_by_any_name(server: HttpServer) -> None:
    for path in ("/metrics", "/healthz", "/ready", "/health.json"):
        assert ask(server, path, headers={"Host": "rover.example.org:9108"}).status == 200


def test_clients_outside_the_networks_are_refused_and_counted(
    running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doors, "is_own_computer", lambda *_: False)
    with capture_logs() as logs, closing(served(running, networks=[IPv4Network("127.0.1.0/24")])) as server:
        with ExitStack() as stack:
            assert opened(server, stack, 1, "127.0.2.1")[0].recv(100).startswith(b"HTTP/1.1 403 ")
            [admitted] = opened(server, stack, 1, "127.0.1.1")
            admitted.sendall(b"GET /ready HTTP/1.0\r\n\r\n")
            assert admitted.recv(100).startswith(b"HTTP/1.1 200 ")
        assert order(server, "/-/reload").status == 200
    assert [(each["event"], each["client"]) for each in logs] == [
        ("connection refused: the client's address is not in a network of 'from'", "127.0.2.1")
    ]


def opened(server: HttpServer, stack: ExitStack, count: int, host: str = "127.0.0.1") -> list[socket.socket]:
    """Connections that ask nothing, in the order in which the server took them."""
    return [
        stack.enter_context(socket.create_connection(server.address, 10, source_address=(host, 0)))
        for _ in range(count)
    ]


def is_ended(connection: socket.socket) -> bool:
    """Whether the server has ended it; nothing is read."""
    poller = select.poll()
    poller.register(connection, select.POLLRDHUP)
    return bool(poller.poll(0))


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who comes from 127.0.1.0/24 is on another computer."""
    monkeypatch.setattr(server_module, "is_own_computer", lambda peer, _: not peer.startswith("127.0.1."))


def is_refused(connection: socket.socket) -> bool:
    return connection.recv(65536).startswith(b"HTTP/1.1 503 ")


def test_a_host_with_all_its_places_is_refused_until_one_is_free(server: HttpServer) -> None:
    with ExitStack() as stack:
        taken = opened(server, stack, MAX_PER_HOST)
        assert is_refused(opened(server, stack, 1)[0])
        assert not any(map(is_ended, taken))
        taken[0].close()
        wait_until(lambda: answers(server), "the place of the one that left")


def test_who_asks_nothing_loses_its_place(server: HttpServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "IDLE_SECONDS", 0.3)
    with ExitStack() as stack:
        opened(server, stack, MAX_PER_HOST)
        wait_until(lambda: answers(server), "the place of one that asked nothing")


def test_all_addresses_of_the_own_computer_are_one_host(server: HttpServer) -> None:
    with ExitStack() as stack:
        for number in range(1, MAX_PER_HOST + 1):
            opened(server, stack, 1, f"127.0.0.{number}")
        assert is_refused(opened(server, stack, 1, "127.0.0.99")[0])


@pytest.mark.usefixtures("others")
def test_other_computers_share_places_that_are_not_the_own_ones(server: HttpServer) -> None:
    with ExitStack() as stack:
        opened(server, stack, MAX_PER_HOST - 1)
        taken = opened(server, stack, MAX_PER_HOST, "127.0.1.1")
        assert is_refused(opened(server, stack, 1, "127.0.1.1")[0])
        for number in range(MAX_FROM_OTHERS - MAX_PER_HOST):
            taken += opened(server, stack, 1, f"127.0.1.{number + 2}")
        assert is_refused(opened(server, stack, 1, "127.0.1.99")[0])
        assert not any(map(is_ended, taken))
        assert answers(server)


def test_of_taps_there_are_a_few_only_and_one_that_is_not_read_goes(
    server: HttpServer, running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "IDLE_SECONDS", 0.3)
    with ExitStack() as stack:
        taps = [stack.enter_context(asking(server, "/tap")).getresponse() for _ in range(MAX_TAPS)]
        assert {tap.status for tap in taps} == {200}
        with asking(server, "/tap") as one_more:
            refused = one_more.getresponse()
            assert refused.status == 503
            assert refused.read() == b"there are 6 taps already: close one\n"

        def is_let_in() -> bool:
            for _ in range(0 if running.waiting else 50):  # a tap drops batches of many more
                running.receive(bytes(60_000), ("127.0.0.99", 1))
            with asking(server, "/tap") as another:
                return another.getresponse().status == 200

        wait_until(is_let_in, "a place of a tap that nobody reads")


@pytest.mark.parametrize("taken", [0, 500])
def test_an_answer_that_is_not_taken_as_a_whole_ends_its_connection(
    server: HttpServer, monkeypatch: pytest.MonkeyPatch, taken: int
) -> None:
    """Also where its reader takes a little now and then."""
    monkeypatch.setattr(server_module, "RESPONSE_SECONDS", 0.3)
    monkeypatch.setattr(server_module, "MAX_IN_KERNEL", 4096)
    with socket.socket() as caller:
        caller.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        caller.connect(server.address)
        caller.sendall(b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 20)

        def has_ended() -> bool:
            with suppress(ConnectionError):
                caller.recv(taken)
            return is_ended(caller)

        wait_until(has_ended, "the end of a connection whose answers nobody takes")
    assert answers(server)


@pytest.mark.parametrize(("idle", "piece"), [(0.3, b"x"), (3600, bytes(10_000))])
def test_a_request_that_does_not_come_to_its_end_ends_its_connection(
    server: HttpServer, monkeypatch: pytest.MonkeyPatch, idle: float, piece: bytes
) -> None:
    """It may take too long, or be too long."""
    monkeypatch.setattr(server_module, "IDLE_SECONDS", idle)
    with socket.create_connection(server.address, 10) as caller:

        def has_ended() -> bool:
            with suppress(ConnectionError):
                caller.send(piece)
            return is_ended(caller)

        wait_until(has_ended, "the end of a request without end")


def test_a_few_threads_answer_at_a_time(server: HttpServer, monkeypatch: pytest.MonkeyPatch) -> None:
    now, one_more, let_go = list[object](), threading.Event(), threading.Event()

    def get(self: object, *_: object) -> responses.Response:
        now.append(self)
        if len(now) > MAX_ANSWERING:
            one_more.set()
        let_go.wait(10)
        now.pop()
        return plain(HTTPStatus.OK, "got")

    monkeypatch.setattr(responses.Responder, "get", get)
    with ExitStack() as stack:
        callers = opened(server, stack, MAX_PER_HOST)
        for caller in callers:
            caller.sendall(b"GET /ready HTTP/1.0\r\n\r\n")
        wait_until(lambda: len(now) >= MAX_ANSWERING, "four that answer")
        is_one_more = one_more.wait(0.3)
        let_go.set()
        for caller in callers:
            while caller.recv(65536):
                pass
    assert not is_one_more


ACCEPTED = ["", "text/plain; version=0.0.4", "*/*", "application/json", "text/plain; version=x"]
OPEN_METRICS = [f"application/openmetrics-text; version={version}" for version in ("1.0.0", "1.0.1", "2.0.0", "x")]


def test_metrics_are_collected_once_for_all_that_ask_within_half_a_second(
    server: HttpServer, running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(responses, "KEPT_SECONDS", 3600)
    for accepted, total in ((ACCEPTED, 1), (OPEN_METRICS, 2)):
        answers = [ask(server, "/metrics", headers={"Accept": each}) for each in accepted]
        assert {(answer.status, answer.headers["Content-Encoding"]) for answer in answers} == {(200, None)}
        assert len({answer.text for answer in answers}) == len({*answers[0].headers.get_all("X-Collected-At", [])}) == 1
        for each in accepted:
            zipped = ask(server, "/metrics", headers={"Accept": each, "Accept-Encoding": "gzip"})
            assert gzip.decompress(zipped.data) == answers[0].data
            ask(server, "/metrics", "HEAD", {"Accept": each})
        assert running.collected == total
    monkeypatch.setattr(responses, "KEPT_SECONDS", 0)
    ask(server, "/metrics")
    assert running.collected == 3


def test_what_the_page_asks_for_is_made_once_for_all_that_look(
    server: HttpServer, running: FakeRunning, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped = list[RouteTable]()

    def mapping(table: RouteTable) -> tuple[list[Node], list[Edge]]:
        mapped.append(table)
        return nodes_and_edges(table)

    monkeypatch.setattr(status, "nodes_and_edges", mapping)
    monkeypatch.setattr(responses, "KEPT_SECONDS", 3600)
    assert len({ask(server, "/status.json").text for _ in range(5)}) == 1
    assert running.collected == 1
    assert len({ask(server, "/recent.json").text for _ in range(5)}) == 1
    assert len({ask(server, "/map.json").text for _ in range(5)}) == 1
    assert len(mapped) == 1


def answers(server: HttpServer) -> bool:
    try:
        return ask(server, "/ready").status == 200
    except (OSError, http.client.HTTPException):
        return False


@contextmanager
def ended_by_the_other_side() -> Iterator[None]:
    """Inside, a server that ends a connection before it has read everything may reset it, at any step."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.ECONNRESET, errno.ENOTCONN):
            raise


@pytest.mark.parametrize(
    "nonsense",
    [
        b"",
        b"GET\r\n\r\n",
        b"\x16\x03\x01" + bytes(100),
        b"GET / HTTP/1.1\r\nA: " + b"x" * 99999,
        b"GET / HTTP/1.1\r\nA: " + b"x" * 65000 + b"\r\nB: " + b"x" * 65000 + b"\r\n\r\n",
        b"GET /metrics HTTP/1.1\r\nAccept: application/openmetrics-text;version=x\r\n\r\n",
        b"GET http://[::1 HTTP/1.1\r\n\r\n",
        b"GET /tap?case=%ff%00&&==;&from=[ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_nonsense_ends_its_own_connection_only(
    server: HttpServer, nonsense: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(logger, "critical", lambda event, **_: told.append(event))
    with socket.create_connection(server.address, 10) as caller, ended_by_the_other_side():
        caller.sendall(nonsense)
        caller.shutdown(socket.SHUT_WR)
        while caller.recv(65536):
            pass
    assert ask(server, "/ready").status == 200
    assert not told


def test_a_body_is_never_run_as_a_request(server: HttpServer, saved: list[Path | RouterError]) -> None:
    """Request smuggling: a proxy passes on one request, and the router would see two."""
    hidden = f"POST /record/save HTTP/1.1\r\nHost: {server.address}\r\nOrigin: http://{server.address}\r\n\r\n".encode()
    for head in (b"GET /metrics HTTP/1.1\r\n", b"POST /record/save HTTP/1.1\r\n", b"HEAD / HTTP/1.1\r\n"):
        for length in (b"Content-Length: %d\r\n" % len(hidden), b"Transfer-Encoding: chunked\r\n"):
            with socket.create_connection(server.address, 10) as caller:
                caller.sendall(head + b"Host: 127.0.0.1\r\n" + length + b"\r\n" + hidden)
                answer = b"".join(iter(lambda: caller.recv(65536), b""))
            assert answer.startswith(b"HTTP/1.1 400 Bad Request\r\n"), head
            assert answer.count(b"HTTP/1.1 ") == 1
            assert b"\r\nConnection: close\r\n" in answer
    assert ask(server, "/record/save", "POST", own_page(server)).status == 200  # nothing was saved within 10 s before


def test_closing_minds_nobody_who_has_gone(running: FakeRunning) -> None:
    """The thread that waits for the next question learns of it late."""
    for _ in range(20):
        server = served(running)
        callers = [control.connect(*server.address, 10) for _ in range(5)]
        for caller in callers:
            caller.sendall(b"GET /tap HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            caller.close()
        server.close()
    wait_until(lambda: not running.mirror.is_observed, "the end of the taps")


def test_closing_ends_what_is_open(running: FakeRunning) -> None:
    server = served(running)
    with asking(server, "/tap") as connection:
        response = connection.getresponse()
        server.close()
        response.read()
    running.mirror.close()
    assert running.failures == []


def test_a_connection_without_a_thread_is_closed_and_the_next_is_served(
    server: HttpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads are refused, or die before they run; it is no fault of the router, and a flood of it is one line."""

    class NoThread:
        def __init__(self, *_: object) -> None: ...

        def start(self) -> None:
            raise RuntimeError("can't start new thread")

    with capture_logs() as logs:
        with monkeypatch.context() as short:
            short.setattr(server_module, "REST_S", 0.0)
            short.setattr(server_module, "Thread", NoThread)
            for _ in range(2 * MAX_PER_HOST):
                with pytest.raises((ConnectionError, http.client.RemoteDisconnected)):
                    ask(server, "/ready")
        assert ask(server, "/ready").status == 200
    what = "memory, threads or descriptors have run out; this lost an HTTP response: can't start new thread"
    assert [(each["event"], each["log_level"]) for each in logs] == [(what, "error")]


@pytest.mark.parametrize(
    "error", [OSError(errno.EMFILE, "Too many open files"), MemoryError()], ids=["EMFILE", "memory"]
)
def test_accepting_goes_on_after_a_shortage(
    server: HttpServer, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    failed = threading.Event()

    def fail(_: object) -> None:
        failed.set()
        raise error

    assert ask(server, "/ready").status == 200  # the thread has started
    with monkeypatch.context() as short:
        short.setattr(server_module._Server, "_accept", fail)
        with suppress(ConnectionError, http.client.RemoteDisconnected, TimeoutError):
            ask(server, "/ready")  # the thread waits in the method that it had
        assert failed.wait(10)
    assert ask(server, "/ready").status == 200
