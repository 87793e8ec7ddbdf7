"""The tools beside a running router, all at the IPv6 loopback address."""

from __future__ import annotations

import json
import socket
from contextlib import closing
from pathlib import Path

import pytest

from router.app import Router
from router.cli import main
from router.compiler import check_table
from router.recording.reader import Recording
from router.table.addresses import Address
from router.tools.running_router import health
from router.tools.udp import open_udp
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.tables import PROTOS
from tests.tools.test_links import verb


@pytest.fixture
def path(tmp_path: Path) -> Path:
    board, station = free_port("::1"), free_port("::1")
    path = tmp_path / "table.yaml"
    path.write_text(f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
http: {{address: "[::1]:{free_port("::1", socket.SOCK_STREAM)}"}}
listen:
  rover: {{address: "[::]:{free_port("::")}"}}
endpoints:
  board: {{address: "[::1]:{board}", source_port: {board}, kind: board}}
  station: {{address: "[::1]:{station}", source_port: {station}, kind: basestation}}
  tablet: {{address: learned, source_port: {free_port("::1")}, kind: tool}}
routes:
  ph_info: {{source: board, destinations: [station]}}
  imu_info: {{source: tablet, destinations: [station]}}
""")
    return path


def test_tools_find_the_router_send_to_it_and_show_what_it_receives(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = check_table(path, {}).program
    assert program is not None
    assert program.table.http is not None
    table, url = ("-t", str(path)), f"http://{program.table.http.address.value}"
    stranger = f"[::1]:{(port := free_port('::1'))}"
    addresses = {name: endpoint.address.value for name, endpoint in program.table.endpoints.items()}
    with Router(program), open_udp(addresses["station"], "station") as station:
        station.settimeout(5)
        with verb("record", "-o", path.with_suffix(".mcap"), "--for", "2s", *table) as record:
            assert record.stderr is not None
            assert record.stderr.readline().startswith(f"recording the router at {url} to ")
            with verb("tap", "--from", "0::1", "--count", "3", "--json", *table) as tap:
                assert tap.stderr is not None
                assert tap.stderr.readline().startswith(f"tapping the router at {url};")
                for case, origin in (("ph_info", "board"), ("imu_info", "tablet"), ("ph_info", stranger)):
                    assert main(["send", case, "--to", "rover", "--from", origin, *table]) == 0
                assert [station.recv(100).hex() for _ in range(2)] == ["0a00", "6a00"]
                lines = [json.loads(line) for line in tap.communicate(timeout=30)[0].splitlines()]
            assert [line["peer"] for line in lines] == ["board", "tablet", stranger]
            wait_until(lambda: record.poll() is not None)
        source_port = program.table.endpoints["tablet"].source_port
        assert source_port is not None
        assert health(url).learned == {"tablet": str(Address("::1", source_port.value))}
        capsys.readouterr()
        assert main(["reload", *table]) == 0
        assert "nothing changed" in capsys.readouterr().out
        said: list[str] = []

        def is_reported() -> bool:
            """The router reports what it rejects often."""
            assert main(["send", "ph_info", "--to", "rover", "--from", stranger, *table]) == 0
            capsys.readouterr()
            assert main(["doctor", *table]) in (0, 1)
            said[:] = [capsys.readouterr().out]
            return "rover rejects datagrams: source_mismatch" in said[0]

        wait_until(is_reported)
        assert "ports      the running router has them" in said[0]
        assert "(::1) uses another port or listener than the table says" in said[0]
    with closing(Recording(path.with_suffix(".mcap"))) as recording:
        assert [(each.endpoint, each.peer[0]) for each in recording.datagrams()] == [
            ("board", "::1"),
            ("tablet", "::1"),
            ("", "::1"),
        ]
    with open_udp(program.table.listeners["rover"].address.value, "rover") as rover:
        assert main(["replay", str(path.with_suffix(".mcap")), "--speed", "max", *table]) == 0
        assert {rover.recvfrom(100)[1][1] for _ in range(3)} == {addresses["board"].port, source_port.value, port}
