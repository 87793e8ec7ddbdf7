"""Clients that begin messages and do not end them: all of them together hold no more than they may, and not long."""

from __future__ import annotations

import asyncio
import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from router.gateway.transport import memory as gateway_memory
from router.gateway.transport import stream as gateway_stream
from router.gateway.transport import unfinished as gateway_unfinished
from router.gateway.transport import websocket as gateway_websocket
from router.gateway.transport.memory import LARGE, Trimmer
from router.gateway.transport.stream import StreamTransport
from router.gateway.transport.tcp import TcpTransport
from router.gateway.transport.unfinished import Unfinished
from router.gateway.transport.websocket import WebsocketTransport
from router.table.model import Address
from tests.gateway.gateway_ears import Ears, opened, resident_kib, until

ANY = Address("127.0.0.1", 0)
MOST = 1000
GREETING = (
    b"GET / HTTP/1.1\r\nHost: rover\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


@given(st.lists(st.tuples(st.sampled_from("abcd"), st.integers(0, 150))))
def test_all_together_never_hold_more_than_they_may_and_the_largest_goes(told: list[tuple[str, int]]) -> None:
    unfinished: Unfinished[str] = Unfinished(200)
    held: dict[str, int] = {}
    for client, size in told:
        held[client] = size
        largest = unfinished.holds(client, size, 0.0)
        assert (largest is not None) == (sum(held.values()) > 200)
        if largest is not None:
            assert held[largest] == max(held.values())
            del held[largest]
        assert unfinished.size == sum(held.values())
    assert sum(unfinished.forget(client) for client in "abcd") == sum(held.values())
    assert unfinished.size == 0


def test_who_says_nothing_more_is_found_and_who_goes_on_or_owes_nothing_is_not() -> None:
    unfinished: Unfinished[str] = Unfinished(200)
    unfinished.holds("silent", 1, 0.0)
    unfinished.holds("goes on", 1, 0.0)
    unfinished.holds("owes nothing", 1, 0.0)
    unfinished.holds("goes on", 2, 5.0)
    unfinished.holds("owes nothing", 0, 5.0)
    assert unfinished.silent(9.9) == []
    assert unfinished.silent(10.0) == ["silent"]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three thousand bytes may be unfinished."""
    monkeypatch.setattr(gateway_stream, "MOST_UNFINISHED", 3 * MOST)
    monkeypatch.setattr(gateway_stream, "OVERHEAD", 0)


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who says nothing more is closed soon."""
    monkeypatch.setattr(gateway_stream, "LOOK_SECONDS", 0.02)
    monkeypatch.setattr(gateway_unfinished, "UNFINISHED_SECONDS", 0.1)


async def join(transport: StreamTransport) -> socket.socket:
    assert transport.address is not None
    peer = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    peer.setblocking(False)
    await asyncio.get_running_loop().sock_connect(peer, transport.address)
    return peer


async def join_websocket(transport: StreamTransport, ears: Ears) -> socket.socket:
    before = len(ears.clients) + len(ears.gone)
    peer = await join(transport)
    await asyncio.get_running_loop().sock_sendall(peer, GREETING)
    await until(lambda: len(ears.clients) + len(ears.gone) > before)
    return peer


def tcp(ears: Ears, is_prefixed: bool) -> TcpTransport:
    return TcpTransport(ANY, ears, prefixed=is_prefixed, max_clients=10, most=MOST)


def websocket(ears: Ears, max_clients: int = 10, most: int = MOST) -> WebsocketTransport:
    return WebsocketTransport(ANY, ears, text=False, max_clients=max_clients, most=most, page=b"")


def part(payload: bytes, opcode: int = 2, length: int | None = None, fin: bool = True) -> bytes:
    """Of a websocket message, as a client sends it; the payload may end before its length does."""
    length = len(payload) if length is None else length
    return struct.pack(">BBH", opcode | fin << 7, 0x80 | 126, length) + bytes(4) + payload


async def tell(peer: socket.socket, data: bytes) -> None:
    await asyncio.get_running_loop().sock_sendall(peer, data)
    await asyncio.sleep(0.02)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("is_prefixed", [True, False])
def test_of_tcp_clients_that_leave_too_much_unfinished_the_largest_is_closed(is_prefixed: bool) -> None:
    head = struct.pack("<I", MOST) if is_prefixed else b""

    async def story() -> None:
        ears = Ears()
        transport = tcp(ears, is_prefixed)
        with capture_logs() as logs:
            async with opened(transport):
                peers = []
                for size in (800, 950, 900, 700):
                    peers.append(await join(transport))
                    await tell(peers[-1], head + b"x" * size)
                await until(lambda: ears.gone)
                assert ears.gone[0].label == "{}:{}".format(*peers[1].getsockname())
                assert (ears.refusals, len(ears.clients)) == (["too_large"], 3)
                await tell(peers[0], b"x" * 200 if is_prefixed else b"\n")
                await until(lambda: ears.said)  # it ends its message, and is served
                for peer in peers:
                    peer.close()
        assert ["too much" in log["event"] for log in logs if log["log_level"] == "warning"] == [True]

    asyncio.run(story())


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(
    "begun",
    [
        part(b"x" * 900, length=MOST),
        part(b"x" * 600, fin=False),
        part(b"x", fin=False) + part(b"", opcode=0, fin=False) * 2,  # whose bytes are few, and the parts are kept
    ],
)
def test_of_websocket_clients_that_leave_too_much_unfinished_one_is_closed(begun: bytes) -> None:
    async def story() -> None:
        ears = Ears()
        transport = websocket(ears)
        async with opened(transport):
            peers = []
            for _ in range(4):
                peers.append(await join_websocket(transport, ears))
                await tell(peers[-1], begun)
            await until(lambda: ears.gone)
            assert (ears.refusals, len(ears.clients)) == (["too_large"], 3)
            for peer in peers:
                peer.close()

    asyncio.run(story())


@pytest.mark.usefixtures("few")
def test_websocket_clients_that_say_much_in_whole_messages_stay() -> None:
    async def story() -> None:
        ears = Ears()
        transport = websocket(ears)
        async with opened(transport):
            peers = [await join_websocket(transport, ears) for _ in range(4)]
            for peer in peers * 3:
                await tell(peer, part(b"x" * 500, fin=False) + part(b"x" * 400, opcode=0))
            await until(lambda: len(ears.said) == 12)
            assert (ears.refusals, ears.gone) == ([], [])
            for peer in peers:
                peer.close()

    asyncio.run(story())


@pytest.mark.usefixtures("few")
def test_greetings_without_end_are_bounded_as_well() -> None:
    async def story() -> None:
        ears = Ears()
        transport = websocket(ears)
        async with opened(transport):
            peers = [await join(transport) for _ in range(4)]
            for peer in peers:
                await tell(peer, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 140)
            await until(lambda: ears.refusals == ["too_large"])
            for peer in peers:
                peer.close()

    asyncio.run(story())


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize(
    ("kind", "begun"), [("packets", b"\x05\x00\x00\x00x"), ("lines", b"{"), ("websocket", part(b"x", length=5))]
)
def test_who_does_not_end_what_it_began_is_closed_and_who_is_silent_is_not(kind: str, begun: bytes) -> None:
    async def story() -> None:
        ears = Ears()
        transport = websocket(ears) if kind == "websocket" else tcp(ears, kind == "packets")
        with capture_logs() as logs:
            async with opened(transport):
                is_websocket = kind == "websocket"
                peers = [await (join_websocket(transport, ears) if is_websocket else join(transport)) for _ in "ab"]
                await until(lambda: len(ears.clients) == 2)
                await tell(peers[0], begun)
                await until(lambda: ears.gone)
                await asyncio.sleep(0.2)
                assert [client.label for client in ears.clients] == ["{}:{}".format(*peers[1].getsockname())]
                for peer in peers:
                    peer.close()
        assert ["did not end" in log["event"] for log in logs if log["log_level"] == "warning"] == [True]

    asyncio.run(story())


def test_who_asks_for_a_websocket_has_room_however_many_connect_and_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_websocket, "STRANGERS", 5)

    async def story() -> None:
        ears = Ears()
        transport = websocket(ears, max_clients=2)
        async with opened(transport):
            first = await join_websocket(transport, ears)
            strangers = [await join(transport) for _ in range(20)]
            second = await join_websocket(transport, ears)
            assert (len(ears.clients), ears.gone) == (2, [])
            for peer in (first, second, *strangers):
                peer.close()

    asyncio.run(story())


def test_memory_of_large_messages_is_given_back() -> None:
    """By those that are whole and by those that never are."""
    large = 8 << 20

    async def story() -> None:
        ears = Ears()
        transport = TcpTransport(ANY, ears, prefixed=True, max_clients=10, most=large)
        async with opened(transport):
            before = resident_kib()
            peers = [await join(transport) for _ in range(7)]
            loop = asyncio.get_running_loop()
            for number, peer in enumerate(peers):
                await loop.sock_sendall(peer, struct.pack("<I", large) + b"x" * (large - number % 2))
            await until(lambda: len(ears.said) == 4)
            ears.said.clear()
            for peer in peers:
                peer.close()
            await until(lambda: len(ears.gone) == 7)
            await until(lambda: resident_kib() - before < 2 * large // 1024)

    asyncio.run(story())


def test_memory_is_given_back_once_for_all_that_was_freed_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr(gateway_memory, "_trim", calls.append)
    monkeypatch.setattr(gateway_memory, "TRIM_SECONDS", 0.05)

    async def story() -> None:
        trimmer = Trimmer()
        trimmer.freed(LARGE - 1)
        await asyncio.sleep(0.1)
        assert calls == []
        for _ in range(3):
            trimmer.freed(LARGE)
        await until(lambda: calls == [0])
        trimmer.freed(LARGE)
        trimmer.close()
        await asyncio.sleep(0.1)
        assert calls == [0]

    asyncio.run(story())
