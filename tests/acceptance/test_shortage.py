"""Memory, threads and descriptors that run out while the router runs: what it still does, and how it is afterwards."""

from __future__ import annotations

import resource
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from time import monotonic

import pytest

from tests.acceptance.payloads import WIRE
from tests.acceptance.site import BARE, RouterProcess, Site, site, wait_until
from tests.acceptance.test_stop import KILLED_AFTER
from tests.ports import free_port

TABLE = (
    BARE
    + """\
node: {{name: short}}
foxglove: {{address: 127.0.0.1:FOXGLOVE}}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    deadman: {{timeout: 10s, send: {{manual_brake: {{brake: true}}}}, at_start: silent}}
gateways:
  operator: {{transport: {{tcp: 127.0.0.1:PORT}}, format: json_lines}}
"""
)
DRIVE = WIRE.envelopes.first.message_class(manual_drive={"forward_backward": 50}).SerializeToString()
BRAKE = WIRE.envelopes.first.message_class(manual_brake={"brake": True}).SerializeToString()
CLIENTS = 40


def descriptors(router: RouterProcess) -> int:
    return len(list(Path(f"/proc/{router.process.pid}/fd").iterdir()))


def mapped(router: RouterProcess) -> int:
    """Bytes of memory."""
    pages = Path(f"/proc/{router.process.pid}/statm").read_text().split()[0]
    return int(pages) * resource.getpagesize()


@contextmanager
def shortage(router: RouterProcess, limit: int, now: int) -> Iterator[None]:
    usual = resource.prlimit(router.process.pid, limit)
    resource.prlimit(router.process.pid, limit, (now, usual[1]))
    yield
    if router.process.poll() is None:
        resource.prlimit(router.process.pid, limit, usual)


def crowd(*ports: int) -> None:
    """Many clients at once; each leaves soon."""
    with ExitStack() as leaving:
        for port in ports * CLIENTS:
            with suppress(OSError):
                client = leaving.enter_context(socket.create_connection(("127.0.0.1", port), 0.2))
                client.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")


@pytest.mark.parametrize("ends_in_it", [False, True], ids=["and passes", "until the end"])
@pytest.mark.parametrize(
    ("limit", "use"), [(resource.RLIMIT_NOFILE, descriptors), (resource.RLIMIT_AS, mapped)], ids=["files", "memory"]
)
def test_a_shortage_ends_nothing_and_the_brake_of_the_stop_is_sent(
    tmp_path: Path, limit: int, use: Callable[[RouterProcess], int], ends_in_it: bool
) -> None:
    with site(tmp_path) as place:
        ports = gateway, foxglove = [free_port(kind=socket.SOCK_STREAM) for _ in range(2)]
        table = place.table(TABLE.replace("PORT", str(gateway)).replace("FOXGLOVE", str(foxglove)))
        with RouterProcess(tmp_path, table) as router:
            with shortage(router, limit, use(router)):
                crowd(place.metrics, *ports)
                place.send("basestation", DRIVE)
                assert place.receive("driving_board") == DRIVE
                if ends_in_it:
                    assert seconds_to_stop(router) < KILLED_AFTER
            if not ends_in_it:
                wait_until(lambda: serves(place), "the next answer")
                wait_until(lambda: all(map(is_open, ports)), "that others are served")
                assert seconds_to_stop(router) < KILLED_AFTER
            assert place.receive("driving_board") == BRAKE
            assert [line for line in router.log() if line["level"] == "critical"] == []


def seconds_to_stop(router: RouterProcess) -> float:
    begun = monotonic()
    assert router.stop(signal.SIGTERM) == 0, router.text()
    return monotonic() - begun


def is_open(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def serves(place: Site) -> bool:
    with suppress(OSError):
        return bool(place.samples())
    return False
