"""Networks in `from`: strangers on a real network reach no server of the router, and its own user controls it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.acceptance.site import ROOT, wait_until
from tests.acceptance.two_networks import Rover, rover_with_networks
from tests.namespaces import Computer

PORTS = {"http": 9108, "foxglove": 8766, "gateways.dashboard": 8765, "gateways.logger": 8600}
TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 0.0.0.0:9108, from: &radio [10.78.2.0/24]}}
foxglove: {{address: 0.0.0.0:8766, from: *radio}}
listen: {{rover: {{address: 0.0.0.0:5000}}}}
endpoints: {{basestation: {{address: 10.78.2.10:9000, kind: basestation}}}}
routes: {{control_mode: {{ignore: only servers are wanted}}}}
gateways:
  dashboard: {{transport: {{websocket: 0.0.0.0:8765}}, from: *radio}}
  logger: {{transport: {{tcp: 0.0.0.0:8600}}, format: json_lines, from: *radio}}
"""
REFUSED = "connection refused: the client's address is not in a network of 'from'"
GET = b"GET / HTTP/1.1\r\nHost: 10.78.1.1\r\nConnection: close\r\n\r\n"


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Rover]:
    with rover_with_networks(tmp_path) as opened:
        yield opened


def answer(computer: Computer, host: str, port: int) -> bytes:
    """The beginning of what a server says to a client of this computer."""

    def ask() -> bytes:
        with socket.create_connection((host, port), 10) as connection:
            try:
                connection.sendall(GET)
                return connection.recv(1000)
            except ConnectionError:
                return b""

    return computer.inside(ask)


def counts(site: Rover) -> list[float]:
    return [site.count("connections_refused_total", server=server) for server in PORTS]


def test_clients_outside_the_networks_are_refused_counted_and_named(site: Rover) -> None:
    with site.router(TABLE) as router:
        wait_until(lambda: all(answer(site.rover, "127.0.0.1", port) for port in PORTS.values()), "the servers")
        assert counts(site) == [0, 0, 0, 0]
        assert all(answer(site.radio, "10.78.2.1", port) for port in PORTS.values())
        found = [answer(site.lan, "10.78.1.1", port) for port in PORTS.values() for _ in range(3)]
        assert {each.partition(b"\r\n")[0] for each in found} == {b"HTTP/1.1 403 Forbidden", b""}
        assert counts(site) == [3, 3, 3, 3]
        named = [(line["server"], line["client"]) for line in router.events(REFUSED)]
        assert sorted(named) == sorted((server, "10.78.1.222") for server in PORTS)
        said = site.rover.run(ROOT / ".venv/bin/router", "reload", "-t", site.folder / "table.yaml")
        assert said.startswith("nothing changed\n")
        refused = site.lan.run(ROOT / ".venv/bin/router", "reload", "--url", "http://10.78.1.1:9108", check=False)
        assert "http://10.78.1.1:9108 is another computer" in refused
