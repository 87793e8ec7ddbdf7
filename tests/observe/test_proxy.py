"""The router's pages behind a real nginx with the guide's server block, and what strangers get through a proxy."""

from __future__ import annotations

import json
import re
import shutil
import socket
import ssl
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest
from websockets.sync.client import connect

from router.errors import Located
from router.net.doors import Door
from router.observe.foxglove import SUBPROTOCOLS, FoxgloveServer
from router.observe.http import HttpServer
from router.observe.running import ReloadResult
from router.table.addresses import Address
from router.table.model.settings import ServerSettings
from tests.acceptance.site import ROOT, wait_until
from tests.gateway.browser import Browser
from tests.gateway.fake_gateway import FakeGateway
from tests.observe.fake_running import SPAN, FakeRunning, served, sim_program
from tests.observe.test_requests import AMBIGUOUS
from tests.ports import free_port

NGINX = shutil.which("nginx", path="/usr/sbin:/usr/bin")
GUIDE = ROOT / "docs/guides/security.md"

pytestmark = pytest.mark.skipif(NGINX is None, reason="nginx is not installed; it is a package of Debian's")

MAIN = """\
daemon off;
master_process off;
pid {folder}/pid;
error_log {folder}/error.log;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
{server}
}}
"""

ONLY_METRICS = """\
server {
    listen 127.0.0.1:PROXY;
    proxy_http_version 1.1;
    proxy_set_header Connection "";
    location = /metrics { proxy_pass http://router; }
    location /all/      { proxy_pass http://router/; }
}
upstream router { server ROUTER; keepalive 1; }
"""
"""Connections to the router are kept, as a proxy for many clients does: what is left on one, the next client gets."""


@contextmanager
def nginx(folder: Path, server: str, port: int) -> Iterator[None]:
    """Run nginx until the block ends."""
    folder.mkdir()
    file = folder / "nginx.conf"
    file.write_text(MAIN.format(folder=folder, server=server))
    log = (folder / "error.log").open("wb")
    with log, subprocess.Popen([str(NGINX), "-p", folder, "-c", file], stdout=log, stderr=log) as process:
        try:
            wait_until(lambda: process.poll() is not None or is_open(port), "the start of nginx")
            assert process.poll() is None, (folder / "error.log").read_text()
            yield
        finally:
            process.terminate()


def is_open(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def running() -> Iterator[FakeRunning]:
    opened = FakeRunning(sim_program())
    opened.reloads = ReloadResult(False, (), "nobody may reload")
    yield opened
    opened.mirror.close()


@pytest.fixture
def saved() -> list[str]:
    return []


@pytest.fixture
def server(running: FakeRunning, saved: list[str]) -> Iterator[HttpServer]:
    def save(reason: str) -> Path:
        saved.append(reason)
        return Path("/var/lib/recordings/last.mcap")

    with closing(served(running, save)) as opened:
        yield opened


@pytest.fixture
def proxy(server: HttpServer, tmp_path: Path) -> Iterator[Address]:
    """A proxy on the router's computer that adds no header."""
    port = free_port(kind=socket.SOCK_STREAM)
    block = ONLY_METRICS.replace("PROXY", str(port)).replace("ROUTER", str(server.address))
    with nginx(tmp_path / "nginx", block, port):
        yield Address("127.0.0.1", port)


def asked(proxy: Address, request: str) -> str:
    """All that the proxy answers."""
    with socket.create_connection(proxy, 10) as connection:
        connection.sendall(f"{request} HTTP/1.1\r\nHost: rover\r\nConnection: close\r\n\r\n".encode())
        return b"".join(iter(lambda: connection.recv(65536), b"")).decode()


def send(proxy: Address, data: bytes) -> None:
    """Send this, and leave after the first answer, or if there is none."""
    with socket.create_connection(proxy, 10) as connection, suppress(TimeoutError, ConnectionResetError):
        connection.sendall(data)
        connection.settimeout(0.5)
        connection.recv(65536)


def hidden(server: HttpServer) -> bytes:
    """A request that would save, and whose answer nothing else here has."""
    return (
        f"POST /record/save HTTP/1.1\r\nHost: {server.address}\r\nOrigin: http://{server.address}\r\n"
        "Content-Length: 0\r\n\r\n"
    ).encode()


def smuggled(head: bytes, body: bytes) -> bytes:
    """One of the AMBIGUOUS requests for /metrics, with `body` after it, in a chunk if it says so."""
    head = head.replace(b" / ", b" /metrics ", 1).replace(b"44", b"%d" % len(body))
    if b"chunked" in head.lower():
        body = b"%x\r\n%b\r\n0\r\n\r\n" % (len(body), body)
    return head + body


@pytest.mark.parametrize("form", AMBIGUOUS)
def test_no_form_of_smuggling_saves_or_gives_the_next_client_its_answer(
    proxy: Address, server: HttpServer, saved: list[str], form: str
) -> None:
    send(proxy, smuggled(AMBIGUOUS[form], hidden(server)))
    after = asked(proxy, "GET /metrics")
    assert after.startswith("HTTP/1.1 200 OK\r\n")
    assert "# HELP router_" in after
    assert not saved


@pytest.mark.parametrize("request_line", ["GET /all/tap", "POST /all/-/reload", "POST /all/record/save"])
def test_strangers_behind_a_proxy_that_adds_no_header_have_no_rights_of_its_computer(
    proxy: Address, saved: list[str], request_line: str
) -> None:
    assert asked(proxy, request_line).startswith("HTTP/1.1 403 Forbidden\r\n")
    assert not saved


def certificate(folder: Path) -> None:
    command = "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=rover.local -days 2"
    subprocess.run(
        [*command.split(), "-keyout", folder / "rover.key", "-out", folder / "rover.pem"],
        check=True,
        capture_output=True,
    )


@pytest.mark.slow
def test_pages_work_behind_the_proxy_of_the_guide(
    browser: Browser, server: HttpServer, running: FakeRunning, saved: list[str], tmp_path: Path
) -> None:
    """Below a prefix, with TLS: the numbers, saving, and a gateway's page with its websocket."""
    port = free_port(kind=socket.SOCK_STREAM)
    certificate(tmp_path)
    nowhere = ServerSettings(SPAN, Located(Address("127.0.0.1", 0), SPAN))
    door = Door("foxglove", (), Counter())
    with closing(FakeGateway()) as gateway, closing(FoxgloveServer(nowhere, door, running)) as foxglove:
        [block] = re.findall(r"^```nginx\n(.*?)^```$", GUIDE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        for old, new in (
            ("listen 443 ssl", f"listen 127.0.0.1:{port} ssl"),
            ("/etc/ssl/", f"{tmp_path}/"),
            ("127.0.0.1:9108", str(server.address)),
            ("127.0.0.1:8765", f"127.0.0.1:{gateway.port}"),
            ("127.0.0.1:8766", str(foxglove.address)),
        ):
            assert old in block
            block = block.replace(old, new)
        with nginx(tmp_path / "nginx", block, port):
            page = browser.open("about:blank")
            page.call("Security.enable")
            page.call("Security.setIgnoreCertificateErrors", ignore=True)
            page.go(f"https://127.0.0.1:{port}/rover/")
            page.until("document.querySelector('#state').textContent === 'running'")
            page.click("#save")
            page.until("document.querySelector('#saved').textContent.startsWith('✓')")
            assert saved == ["http"]
            links = page.evaluate("[...document.querySelectorAll('nav a')].map((link) => link.href)")
            assert links == [f"https://127.0.0.1:{port}/rover/{name}" for name in ("dashboard/", "metrics")]
            assert page.complaints() == []
            page.go(links[0])
            gateway.list_topics(["/imu"])
            page.until("document.body.innerText.includes('/imu')")
            assert page.evaluate("socket.url") == f"wss://127.0.0.1:{port}/rover/dashboard/"
            assert page.complaints() == []
            page.close()
            trust = ssl.create_default_context(cafile=tmp_path / "rover.pem")
            trust.check_hostname = False
            with connect(f"wss://127.0.0.1:{port}/rover/foxglove/", ssl=trust, subprotocols=SUBPROTOCOLS) as viewer:
                assert json.loads(viewer.recv(10))["op"] == "serverInfo"
