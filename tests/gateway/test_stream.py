"""Limits of TCP and websocket clients: connections in all and of one host, and the time for one message."""

from __future__ import annotations

import asyncio
import socket
import struct
from contextlib import suppress

import pytest
from structlog.testing import capture_logs

from router.gateway.transport import stream as gateway_stream
from router.gateway.transport import websocket as gateway_websocket
from router.gateway.transport.stream import Limits, StreamTransport
from router.gateway.transport.tcp import TcpTransport
from router.gateway.transport.websocket import WebsocketTransport
from router.table.addresses import Address
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.transport_events import Events, opened

ANY = Address("127.0.0.1", 0)
MOST = 1000
GREETING = (
    b"GET / HTTP/1.1\r\nHost: rover\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
KINDS = pytest.mark.parametrize("kind", ["packets", "lines", "websocket"])


def transport_of(kind: str, events: Events, limits: Limits) -> StreamTransport:
    if kind == "websocket":
        return WebsocketTransport(ANY, events, limits, text=False, page=b"")
    return TcpTransport(ANY, events, limits, prefixed=kind == "packets")


async def connect(transport: StreamTransport, host: str = "127.0.0.1", greeting: bytes = b"") -> socket.socket:
    """Connect from a local address, and send a greeting."""
    assert transport.address is not None
    peer = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    peer.bind((host, 0))
    peer.setblocking(False)
    await asyncio.get_running_loop().sock_connect(peer, transport.address)
    await asyncio.get_running_loop().sock_sendall(peer, greeting)
    return peer


async def is_closed(peer: socket.socket) -> bool:
    """Whether the other side closes it before long, whatever it says before."""

    async def read_all() -> None:
        with suppress(ConnectionError):
            while await asyncio.get_running_loop().sock_recv(peer, 4096):
                pass

    try:
        await asyncio.wait_for(read_all(), 5.0)
    except asyncio.TimeoutError:
        return False
    return True


def label(peer: socket.socket) -> str:
    return "{}:{}".format(*peer.getsockname())


def frame(payload: bytes, opcode: int = 2, length: int | None = None, fin: bool = True) -> bytes:
    """Part of a websocket message, as a client sends it; the payload may end before its length does."""
    length = len(payload) if length is None else length
    return struct.pack(">BBH", opcode | fin << 7, 0x80 | 126, length) + bytes(4) + payload


@KINDS
@asynchronous
async def test_one_host_has_so_many_places_and_other_hosts_have_theirs(kind: str) -> None:
    greeting = GREETING if kind == "websocket" else b""
    events = Events()
    transport = transport_of(kind, events, Limits(100, 3, MOST))
    with capture_logs() as logs:
        async with opened(transport):
            greedy = [await connect(transport, "127.0.0.1", greeting) for _ in range(4)]
            await until(lambda: len(events.clients) == 3)
            assert await is_closed(greedy[3])
            other = await connect(transport, "127.0.0.2", greeting)
            await until(lambda: len(events.clients) == 4)
            assert events.clients[3].label == label(other)
            greedy[0].close()
            await until(lambda: len(events.gone) == 1)
            again = await connect(transport, "127.0.0.1", greeting)
            await until(lambda: len(events.clients) == 4)
            for peer in (*greedy, other, again):
                peer.close()
    [warning] = [log for log in logs if log["log_level"] == "warning"]
    assert warning["limit"] == "max_clients_per_host"


@asynchronous
async def test_connections_of_one_host_without_a_websocket_take_no_room_from_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gateway_websocket, "STRANGERS", 10)
    monkeypatch.setattr(gateway_websocket, "STRANGERS_PER_HOST", 2)
    events = Events()
    transport = transport_of("websocket", events, Limits(4, 2, MOST))
    async with opened(transport):
        first = await connect(transport, "127.0.0.1", GREETING)
        await until(lambda: len(events.clients) == 1)
        strangers = [await connect(transport, "127.0.0.2") for _ in range(20)]
        assert await is_closed(strangers[19])
        second = await connect(transport, "127.0.0.1", GREETING)
        await until(lambda: len(events.clients) == 2)
        assert events.gone == []
        for peer in (first, second, *strangers):
            peer.close()


BEGUN = {
    "packets": [b"\x05", b"\x00\x00\x00", *[b"x"] * 4],
    "lines": [b"x"] * 9,
    "websocket": [frame(b"x", length=9), *[b"x"] * 8],
}
UNFINISHED = [*BEGUN.items()]
UNFINISHED.append(("websocket", [frame(b"x", fin=False), *[frame(b"x", opcode=0, fin=False)] * 8]))


@pytest.mark.parametrize(("kind", "pieces"), UNFINISHED)
@asynchronous
async def test_a_message_has_to_end_in_time_although_a_byte_comes_now_and_then(
    kind: str, pieces: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gateway_stream, "WATCH_SECONDS", 0.02)
    monkeypatch.setattr(gateway_stream, "MESSAGE_SECONDS", 0.3)
    greeting = GREETING if kind == "websocket" else b""
    events = Events()
    transport = transport_of(kind, events, Limits(10, 10, MOST))
    with capture_logs() as logs:
        async with opened(transport):
            slow, silent = [await connect(transport, greeting=greeting) for _ in range(2)]
            await until(lambda: len(events.clients) == 2)
            for piece in pieces:
                if events.gone:
                    break
                await asyncio.get_running_loop().sock_sendall(slow, piece)
                await asyncio.sleep(0.1)
            assert [client.label for client in events.gone] == [label(slow)]
            assert [client.label for client in events.clients] == [label(silent)]
            assert events.said == []
            slow.close()
            silent.close()
    assert ["did not end" in log["event"] for log in logs if log["log_level"] == "warning"] == [True]


MESSAGES = {"packets": b"\x03\x00\x00\x00abc", "lines": b"abc\n", "websocket": frame(b"abc")}


@KINDS
@asynchronous
async def test_the_time_is_for_each_message_where_one_follows_the_other(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where what comes at a time always ends in the middle of a message."""
    monkeypatch.setattr(gateway_stream, "WATCH_SECONDS", 0.02)
    monkeypatch.setattr(gateway_stream, "MESSAGE_SECONDS", 0.3)
    message = MESSAGES[kind]
    events = Events()
    transport = transport_of(kind, events, Limits(10, 10, MOST))
    async with opened(transport):
        peer = await connect(transport, greeting=GREETING if kind == "websocket" else b"")
        await until(lambda: events.clients)
        stream = message * 12
        ends = range(len(message) - 2, len(stream), len(message))
        for begin, end in zip([0, *ends], ends, strict=False):
            await asyncio.get_running_loop().sock_sendall(peer, stream[begin:end])
            await asyncio.sleep(0.1)
        assert (events.gone, len(events.said)) == ([], 11)
        peer.close()


@asynchronous
async def test_a_handshake_has_to_end_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_websocket, "MESSAGE_SECONDS", 0.2)
    transport = transport_of("websocket", Events(), Limits(10, 10, MOST))
    async with opened(transport):
        peer = await connect(transport, greeting=b"GET / HTTP/1.1\r\n")
        assert await is_closed(peer)
        peer.close()
