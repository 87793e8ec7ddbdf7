"""Clients that read nothing beside large latched topics: what a router keeps for them, and after them."""

from __future__ import annotations

import gc
import socket
import subprocess
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from time import sleep

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.app import Router
from router.gateway.transport.base import HIGH_WATER, Frame
from tests.acceptance.site import wait_until
from tests.app.conftest import Site
from tests.gateway.stream_peers import GREETING
from tests.ports import free_port
from tests.ros.opening import STRING, cdr
from tests.ros.peers import Publisher

ROUTES = "  ph_info: {source: sensor_board, destinations: [basestation]}\n"
MIB = 1 << 20
KEPT, SIZE, CLIENTS = 4, 3 * MIB, 10
CONTENTS = [f"{number:02}" + "x" * SIZE for number in range(KEPT)]


def gateways(kind: str, port: int) -> str:
    form = ", format: json_lines" if kind == "tcp" else ""
    topics = 'topics: {include: ["/map*"]}, discovery_period: 100ms'
    return f"gateways:\n  it: {{transport: {{{kind}: 127.0.0.1:{port}}}{form}, {topics}}}\n"


def idle_client(kind: str, port: int) -> socket.socket:
    """Joins, and reads nothing."""
    opened = socket.socket()
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    opened.connect(("127.0.0.1", port))
    if kind == "websocket":
        opened.sendall(GREETING)
    return opened


def large_frames() -> int:
    """The bytes of large frames, each counted once. Garbage counts, too."""
    frames = [each for each in gc.get_objects() if type(each) is Frame and len(each.data) > MIB]
    return sum({id(each.data): len(each.data) for each in frames}.values())


@pytest.mark.parametrize("kind", ["tcp", "websocket"])
def test_clients_that_read_nothing_cost_little_and_nothing_once_they_have_left(site: Site, kind: str) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with ExitStack() as opened:
        for number in range(2):
            options = "--transient-local", "--depth", str(KEPT)
            peer = opened.enter_context(closing(Publisher(f"map{number}", STRING, *options)))
            peer.publish(map(cdr, CONTENTS))
        router = opened.enter_context(site.router(ROUTES + gateways(kind, port)))
        thread = router._runtime.gateways.thread
        assert thread is not None
        fetches = thread._subscriptions.fetches
        for _ in range(2):
            with ExitStack() as joined:
                for _ in range(CLIENTS):
                    joined.enter_context(idle_client(kind, port))
                wait_until(lambda: router.total("gateway_clients") == CLIENTS)
                wait_until(lambda: sum(backlogs(router)) > CLIENTS * MIB)  # each gets one
                sleep(1.5)  # what they do not take is discarded now
                assert max(backlogs(router)) <= SIZE + HIGH_WATER
                assert fetches.reserved <= 2 * KEPT * (SIZE + MIB)
                gc.disable()
            wait_until(lambda: router.total("gateway_clients") == 0)
            wait_until(lambda: fetches.reserved == 0)
            wait_until(lambda: large_frames() == 0)
            gc.enable()


def backlogs(router: Router) -> list[float]:
    gateways = router._runtime.gateways.thread
    assert gateways is not None
    return [value for _, value in gateways.clients(lambda queue: queue.client.backlog())]


@pytest.mark.parametrize("kind", ["tcp", "websocket"])
def test_a_late_client_gets_all_large_messages_while_others_read_nothing(site: Site, kind: str) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with closing(Publisher("map", STRING, "--transient-local", "--depth", str(KEPT))) as peer, ExitStack() as joined:
        peer.publish(map(cdr, CONTENTS))
        with site.router(ROUTES + gateways(kind, port)):
            for _ in range(CLIENTS):
                joined.enter_context(idle_client(kind, port))
            late = joined.enter_context(idle_client(kind, port))
            late.settimeout(30)
            missing, tail = {b'"data":"%02d' % number for number in range(KEPT)}, b""
            while missing:
                data = tail + late.recv(MIB)
                missing -= {each for each in missing if each in data}
                tail = data[-16:]


def test_large_blocks_are_returned_when_they_are_freed() -> None:
    """Also those that are as large as one that was freed before."""
    script = """
from router.app.memory import return_large_blocks
from tests.gateway.transport_events import resident_kib
return_large_blocks()
before = resident_kib()
for _ in range(3):
    blocks = [b"x" * (5 << 20) for _ in range(40)]
    small = [object() for _ in range(1000)]
    del blocks
assert resident_kib() < before + 30_000, resident_kib() - before
"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(__file__).parents[2])
