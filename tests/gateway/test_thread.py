"""The thread of all gateways: what happens to it when one of them cannot begin or end as it should."""

from __future__ import annotations

import socket
import threading
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.compiler.compiled_table import CompiledTable
from router.errors import StartError
from router.gateway.thread import GatewayThread
from router.gateway.transport.tcp import TcpTransport
from router.library import load
from tests.gateway.stage import Graph, program
from tests.ports import free_port


def opened(made: CompiledTable) -> GatewayThread:
    ros = cast("Any", SimpleNamespace(topics=Graph({}), publish={}, publish_errors=(), open_client=None))
    thread = GatewayThread(ros, load(), made.counters.fresh_counts(), print, print, Counter(), lambda: None)
    try:
        thread.finish(thread.prepare(made, {}))
    except BaseException:
        thread.stop()
        raise
    return thread


def threads() -> set[str]:
    return {thread.name for thread in threading.enumerate()}


def tcp(name: str, port: int) -> str:
    return f"{name}: {{transport: {{tcp: 127.0.0.1:{port}}}}}"


def test_a_gateway_that_cannot_open_leaves_nothing_of_the_others(tmp_path: Path) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        table = f"{tcp('first', port)}, {tcp('second', taken.getsockname()[1])}"
        with pytest.raises(StartError, match=r"cannot open gateway 'second': .* has the port"):
            opened(program(tmp_path, table))
    assert "gateway" not in threads()
    socket.create_server(("127.0.0.1", port)).close()


def test_a_fault_in_closing_keeps_neither_the_other_gateways_nor_the_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = [free_port(kind=socket.SOCK_STREAM) for _ in range(2)]
    gateways = opened(program(tmp_path, f"{tcp('first', ports[0])}, {tcp('second', ports[1])}"))
    close, closed = TcpTransport.close, []

    async def closes(transport: TcpTransport) -> None:
        await close(transport)
        closed.append(transport)
        raise RuntimeError("no")

    monkeypatch.setattr(TcpTransport, "close", closes)
    with pytest.raises(RuntimeError, match="no"):
        gateways.stop()
    assert len(closed) == 2
    assert "gateway" not in threads()


def test_what_the_kernel_drops_is_known_of_gateways_that_receive_datagrams(tmp_path: Path) -> None:
    receiving = f"{{transport: {{udp: 127.0.0.1:9}}, receive: 127.0.0.1:{free_port()}}}"
    others = f"sender: {{transport: {{udp: 127.0.0.1:9}}}}, {tcp('stream', free_port(kind=socket.SOCK_STREAM))}"
    made = program(tmp_path, f"both: {receiving}, {others}")
    gateways = opened(made)
    assert {name: dropped() for name, dropped in gateways.kernel_drops.items()} == {"both": 0}
    gateways.stop()
    assert gateways.kernel_drops["both"]() == 0
