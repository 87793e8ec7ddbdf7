"""A gateway's websocket clients and its page, with the library's own client. test_stream.py has the rest."""

from __future__ import annotations

import asyncio
import base64
import re
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from hashlib import sha256

import pytest
from structlog.testing import capture_logs
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from router.gateway.transport import websocket as gateway_websocket
from router.gateway.transport.stream import Limits
from router.gateway.transport.websocket import WebsocketTransport
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stream_peers import ANY, MOST, OPEN, join
from tests.gateway.transport_events import Events, data, opened

PAGE = b"<!doctype html><style>a{}</style><p>\xc3\xa4</p><script>let a;</script><script>let b;</script>"


@asynccontextmanager
async def served(max_clients: int, *, text: bool) -> AsyncIterator[tuple[WebsocketTransport, Events]]:
    """An open transport, and what it tells."""
    events = Events()
    transport = WebsocketTransport(ANY, events, Limits(max_clients, max_clients, MOST), OPEN, text=text, page=PAGE)
    async with opened(transport):
        yield transport, events


documents = partial(served, 10, text=True)
packets = partial(served, 10, text=False)


def dial(transport: WebsocketTransport, path: str = "/", host: str = "", **settings: str) -> connect:
    """Used with `async with`. `settings` are the library's."""
    assert transport.address is not None
    uri = f"ws://{host or transport.address}{path}"
    where = {"host": transport.address.host, "port": transport.address.port}
    return connect(uri, max_size=None, proxy=None, **where, **settings)  # type: ignore[arg-type]


def _request(path: str, *headers: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", "Host: rover:8765", "Sec-WebSocket-Version: 13", *headers, "", ""]
    return "\r\n".join(lines).encode()


async def fetch(transport: WebsocketTransport, path: str, *headers: str) -> tuple[int, str, bytes]:
    """Status, head and body of an HTTP answer."""
    assert transport.address is not None
    reader, writer = await asyncio.open_connection(*transport.address)
    writer.write(_request(path, *headers))
    head, _, body = (await reader.read()).partition(b"\r\n\r\n")
    writer.close()
    return int(head.split()[1]), head.decode(), body


@asynchronous
async def test_frames_of_one_writing_are_one_text_message_joined_by_newlines() -> None:
    async with documents() as (transport, events), dial(transport) as one, dial(transport, "/any/path?x=1") as other:
        await until(lambda: len(events.clients) == 2)
        assert events.clients[0].label == "{}:{}".format(*one.local_address)
        assert one.protocol.extensions == []  # nothing is compressed
        transport.write_all(events.clients, [data(b'{"a":1}'), data('{"b":"ä"}'.encode())])
        events.clients[1].write([data(b"{}")])
        for end in (one, other):
            assert await end.recv() == '{"a":1}\n{"b":"ä"}'
        assert await other.recv() == "{}"
        await one.send('{"op":"schema"}')
        await one.send(b"\x00")
        await until(lambda: len(events.said) == 2)
        assert events.said == [b'{"op":"schema"}', b"\x00"]
        assert events.said_by == [events.clients[0]] * 2


@asynchronous
async def test_a_large_message_is_cut_so_that_pings_pass_and_arrives_whole() -> None:
    large = "ä€" * 1_400_000
    async with documents() as (transport, events), dial(transport) as end:
        await until(lambda: events.clients)
        [client] = events.clients
        client.write([data(large.encode())])
        client.write([data(b"next")])
        assert client.backlog() > 6_000_000
        answered = await end.ping()
        parts = [part async for part in end.recv_streaming()]
        assert "".join(map(str, parts)) == large
        assert len(parts) > 100
        await answered
        assert await end.recv() == "next"
        await until(lambda: {*events.eased} == {client})  # perhaps once for each of the two


@asynchronous
async def test_a_client_that_does_not_answer_pings_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_websocket, "PING_SECONDS", 0.1)
    monkeypatch.setattr(gateway_websocket, "CLOSING_SECONDS", 0.1)
    async with documents() as (transport, events):
        peer = await join("websocket", transport)
        peer.stand_still()
        await until(lambda: len(events.gone) == 1)
        peer.leave()


@asynchronous
async def test_a_client_that_pings_without_end_and_reads_nothing_is_closed() -> None:
    pings = (b"\x89\xfdmask" + b"x" * 125) * 100
    async with documents() as (transport, events):
        peer = await join("websocket", transport)
        peer.stand_still()
        with suppress(ConnectionError):
            while not events.gone:
                await peer.send(pings)
        await until(lambda: len(events.gone) == 1)
        peer.leave()


@asynchronous
async def test_clients_that_leave_in_either_way_are_gone() -> None:
    async with documents() as (transport, events):
        async with dial(transport) as end:
            await until(lambda: len(events.clients) == 1)
            end.transport.abort()
            await until(lambda: len(events.gone) == 1)
        async with dial(transport):
            await until(lambda: len(events.clients) == 1)
        await until(lambda: len(events.gone) == 2)
        async with dial(transport) as end:
            await until(lambda: len(events.clients) == 1)
            events.clients[0].close()
            with pytest.raises(ConnectionClosed):
                await end.recv()
            assert len(events.gone) == 3
        events.gone[0].write([data(b"too late")])


@asynchronous
async def test_a_message_that_is_too_long_is_refused_and_its_sender_closed() -> None:
    async with documents() as (transport, events), dial(transport) as end:
        await end.send("x" * MOST)
        await end.send("x" * (MOST + 1))
        await until(lambda: events.gone)
        assert ([len(said) for said in events.said], events.refusals) == ([MOST], ["too_large"])
        with pytest.raises(ConnectionClosed, match="1009"):
            await end.recv()


@asynchronous
async def test_the_page_is_given_with_a_policy_that_lets_it_nothing_from_outside() -> None:
    async with documents() as (transport, _):
        status, head, body = await fetch(transport, "/")
        assert (status, body) == (200, PAGE)
        assert "Content-Type: text/html; charset=utf-8" in head
        assert "Cache-Control: no-store" in head
        [policy] = re.findall("Content-Security-Policy: (.*)\r", head)
        hashes = [
            "'sha256-" + base64.b64encode(sha256(text).digest()).decode() + "'"
            for text in (b"let a;", b"let b;", b"a{}")
        ]
        assert policy == (
            f"default-src 'none'; script-src {hashes[0]} {hashes[1]}; style-src {hashes[2]}; img-src data:; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
            "connect-src 'self' ws://rover:8765 wss://rover:8765"
        )
        assert (await fetch(transport, "/?topic=/imu"))[0] == 200
        assert [(await fetch(transport, path))[0] for path in ("/favicon.ico", "//", "/../etc/passwd")] == [404] * 3


ORIGINS = [
    ("rover:8765", "http://rover:8765", True),
    ("rover:8765", "https://ROVER:8765", True),
    ("10.0.0.7:8765", "http://10.0.0.7:8765", True),
    ("[fe80::1]:8765", "http://[fe80::1]:8765", True),
    ("loki.local", "http://loki.local", True),
    ("rover:8765", "http://rover", False),
    ("rover:8765", "http://evil.example", False),
    ("rover:8765", "http://rover:8765.evil.example", False),
    ("evil.example:8765", "http://evil.example:8765", False),  # a name that was made to lead here
    ("rover:8765", "null", False),
    ("rover:8765", "", False),
]


@asynchronous
async def test_a_page_of_another_host_may_not_connect() -> None:
    async with documents() as (transport, events):
        for host, origin, welcome in ORIGINS:
            dialling = dial(transport, host=host, additional_headers={"Origin": origin})  # type: ignore[arg-type]
            if welcome:
                async with dialling:
                    await until(lambda: events.clients)
                await until(lambda: not events.clients)
            else:
                with pytest.raises(InvalidStatus, match="403"):
                    await dialling
    assert len(events.gone) == sum(welcome for _, _, welcome in ORIGINS)


@asynchronous
async def test_a_client_beyond_the_most_is_sent_away_and_told_but_may_see_the_page() -> None:
    with capture_logs() as logs:
        async with served(1, text=True) as (transport, events), dial(transport):
            await until(lambda: events.clients)
            async with dial(transport) as second:
                with pytest.raises(ConnectionClosed, match="1013"):
                    await second.recv()
            assert (await fetch(transport, "/"))[0] == 200
    [warning] = [log for log in logs if log["log_level"] == "warning"]
    assert "too many" in warning["event"]
    assert len(events.gone) == 1


@pytest.mark.parametrize(
    "greeting", [b"", b"GET / HT", b"\x16\x03\x01" + b"x" * 100, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 1000]
)
@asynchronous
async def test_who_does_not_speak_http_does_not_hold_up_closing(greeting: bytes) -> None:
    with capture_logs() as logs:
        async with documents() as (transport, events):
            assert transport.address is not None
            _, writer = await asyncio.open_connection(*transport.address)
            writer.write(greeting)
            await asyncio.sleep(0.05)
            before = asyncio.get_running_loop().time()
            await transport.close()
            assert asyncio.get_running_loop().time() - before < 5
            writer.close()
    assert events.clients == events.gone == []
    assert {log["log_level"] for log in logs} <= {"debug"}


@asynchronous
async def test_clients_that_say_goodbye_hear_that_the_gateway_goes_away() -> None:
    async with AsyncExitStack() as stack, documents() as (transport, events):
        ends: list[ClientConnection] = [await stack.enter_async_context(dial(transport)) for _ in range(3)]
        await until(lambda: len(events.clients) == 3)
        await transport.close()
        for end in ends:
            with pytest.raises(ConnectionClosed, match="1001"):
                await end.recv()
        assert len(events.gone) == 3


@asynchronous
async def test_connections_of_one_host_without_a_websocket_take_no_room_from_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gateway_websocket, "STRANGERS", 10)
    monkeypatch.setattr(gateway_websocket, "STRANGERS_PER_HOST", 2)
    async with served(2, text=True) as (transport, events):
        first = await join("websocket", transport, "127.0.0.1")
        await until(lambda: len(events.clients) == 1)
        strangers = [await join("stranger", transport, "127.0.0.2") for _ in range(20)]
        assert await strangers[19].is_closed()
        second = await join("websocket", transport, "127.0.0.1")
        await until(lambda: len(events.clients) == 2)
        assert events.gone == []
        for peer in (first, second, *strangers):
            peer.leave()


@asynchronous
async def test_a_handshake_has_to_end_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_websocket, "MESSAGE_SECONDS", 0.2)
    async with documents() as (transport, _):
        peer = await join("stranger", transport)
        await peer.send(b"GET / HTTP/1.1\r\n")
        assert await peer.is_closed()
        peer.leave()
