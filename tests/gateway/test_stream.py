"""What holds for TCP and websocket clients: fast, slow, stopped and hostile ones on the loopback interface."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections import Counter
from contextlib import ExitStack, suppress
from ipaddress import IPv4Network, IPv6Network

import pytest
from structlog.testing import capture_logs

from router.errors import StartError
from router.gateway.transport import binding as gateway_binding
from router.gateway.transport import stream as gateway_stream
from router.gateway.transport import tcp as gateway_tcp
from router.gateway.transport import websocket as gateway_websocket
from router.gateway.transport.base import HIGH_WATER, LOW_WATER, Client
from router.gateway.transport.stream import MESSAGE_SECONDS, Limits, StreamTransport
from router.net import doors
from router.net.doors import Door
from router.table.addresses import Address
from tests.gateway.asynchronous import PATIENCE_SECONDS, asynchronous, until
from tests.gateway.stream_peers import GREETING, KINDS, MOST, framed, join, served, transport_of, websocket_frame
from tests.gateway.transport_events import Events, data, opened, resident_kib

EACH_KIND = pytest.mark.parametrize("kind", KINDS)


@EACH_KIND
@asynchronous
async def test_a_large_message_arrives_whole_between_small_ones_while_others_are_served(kind: str) -> None:
    large = b"x" * 7_000_000
    messages = [b"before", large, b"after", large[:70_000], b"end"]
    async with served(kind) as (transport, events):
        peer = await join(kind, transport)
        await until(lambda: events.clients)
        events.clients[0].write([data(message) for message in messages])
        assert events.clients[0].backlog() > 6_000_000
        other = await join(kind, transport)
        await until(lambda: len(events.clients) == 2)
        transport.write_all(events.clients, [data(b"both")])
        assert await other.hear() == b"both"
        assert [await peer.hear() for _ in (*messages, b"both")] == [*messages, b"both"]
        await until(lambda: events.clients[0] in events.eased)
        peer.leave()
        other.leave()


@EACH_KIND
@asynchronous
async def test_clients_that_stand_still_hold_up_nobody_and_cost_no_memory_of_their_own(kind: str) -> None:
    """Fifty of them, each with 7 MB to get: the pieces are shared."""
    async with served(kind, Limits(51, 51, MOST)) as (transport, events):
        still = [await join(kind, transport) for _ in range(50)]
        for each in still:
            each.stand_still()
        await until(lambda: len(events.clients) == 50)
        peer = await join(kind, transport)
        await until(lambda: len(events.clients) == 51)
        before = resident_kib()
        transport.write_all(events.clients, [data(b"x" * 7_000_000)])
        assert len(await peer.hear()) == 7_000_000
        assert all(client.backlog() > 6_000_000 for client in events.clients[:50])
        assert resident_kib() - before < 100_000
        transport.write_all(events.clients[50:], [data(b"next")])
        assert await peer.hear() == b"next"
        assert set(events.eased) == {events.clients[50]}
        await transport.close()  # at once, though they do not answer
        for each in (peer, *still):
            each.leave()


@EACH_KIND
@asynchronous
async def test_a_slow_client_is_written_to_while_it_takes_and_told_when_it_has_drained(kind: str) -> None:
    """As a service does it: nothing over HIGH_WATER, and on from `drained`."""
    message, wanted, sent = b"x" * 9996, 400, 0

    def send(client: Client) -> None:
        nonlocal sent
        while sent < wanted and client.backlog() < HIGH_WATER:
            client.write([data(b"%04d" % sent + message)])
            sent += 1

    def go_on(client: Client) -> None:
        assert client.backlog() < LOW_WATER
        send(client)

    async with served(kind) as (transport, events):
        events.on_drained = go_on
        peer = await join(kind, transport)
        await until(lambda: events.clients)
        send(events.clients[0])
        assert sent < wanted
        assert HIGH_WATER <= events.clients[0].backlog() < HIGH_WATER + 11_000
        for number in range(wanted):
            assert await peer.hear() == b"%04d" % number + message
        assert len(events.eased) > 2
        peer.leave()


@EACH_KIND
@asynchronous
async def test_a_client_that_takes_nothing_for_long_is_closed_and_told(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gateway_stream, "STALLED_SECONDS", 0.3)
    with capture_logs() as logs:
        async with served(kind) as (transport, events):
            peer = await join(kind, transport)
            peer.stand_still()
            await until(lambda: events.clients)
            [client] = events.clients
            client.write([data(b"x" * 10_000_000)])
            await until(lambda: events.gone == [client])
            peer.leave()
    assert ["does not read" in log["event"] for log in logs if log["log_level"] == "warning"] == [True]


@EACH_KIND
@asynchronous
async def test_a_client_that_is_killed_leaves(kind: str) -> None:
    async with served(kind) as (transport, events):
        peer = await join(kind, transport)
        await until(lambda: events.clients)
        [client] = events.clients
        client.write([data(b"x" * 1_000_000)])
        reset = struct.pack("ii", 1, 0)
        peer.writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
        peer.leave()
        await until(lambda: events.gone == [client])
        client.write([data(b"too late")])
        assert events.eased == []


@EACH_KIND
@asynchronous
async def test_places_are_limited_for_each_host_and_for_all(kind: str) -> None:
    with capture_logs() as logs:
        async with served(kind, Limits(4, 3, MOST)) as (transport, events):
            peers = [await join(kind, transport) for _ in range(3)]
            await until(lambda: len(events.clients) == 3)
            refused = await join(kind, transport)
            assert await refused.is_closed()
            peers.append(await join(kind, transport, "127.0.0.2"))
            await until(lambda: len(events.clients) == 4)
            assert events.clients[3].label == peers[3].label
            one_more = await join(kind, transport, "127.0.0.3")
            assert await one_more.is_closed()
            peers[0].leave()
            await until(lambda: len(events.gone) == 1)
            peers.append(await join(kind, transport))
            await until(lambda: len(events.clients) == 4)
            for peer in (refused, one_more, *peers):
                peer.leave()
    warnings = [log for log in logs if log["log_level"] == "warning"]
    assert [warning["limit"] for warning in warnings] == ["max_clients_per_host", "max_clients"]
    assert all("too many" in warning["event"] for warning in warnings)
    assert len(events.gone) == 5


BEGUN = [
    ("packets", [b"\x05", b"\x00\x00\x00", *[b"x"] * 4]),
    ("lines", [b"x"] * 9),
    ("websocket", [websocket_frame(b"x", length=9), *[b"x"] * 8]),
    ("websocket", [websocket_frame(b"x", fin=False), *[websocket_frame(b"x", opcode=0, fin=False)] * 8]),
]


class Clock:
    """The transports' monotonic clock, in seconds. It stands still on a busy computer."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    async def passes(self, seconds: float, transport: StreamTransport) -> None:
        """Let time pass, and wait for the next check of what is unfinished."""
        self.now += seconds
        before = transport._watching
        await until(lambda: transport._watching is not before)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in (gateway_stream, gateway_tcp, gateway_websocket):
        monkeypatch.setattr(module, "monotonic", clock)
    monkeypatch.setattr(gateway_stream, "WATCH_SECONDS", 0.02)
    return clock


@pytest.mark.parametrize(("kind", "pieces"), BEGUN)
@asynchronous
async def test_a_message_has_to_end_in_time_although_a_byte_comes_now_and_then(
    kind: str, pieces: list[bytes], clock: Clock
) -> None:
    with capture_logs() as logs:
        async with served(kind) as (transport, events):
            slow, silent = [await join(kind, transport) for _ in range(2)]
            await until(lambda: len(events.clients) == 2)
            for piece in pieces:
                await slow.send(piece)
                await until(lambda: any(client.unfinished_since is not None for client in transport._clients))
                await clock.passes(MESSAGE_SECONDS / 4, transport)
                if events.gone:
                    break
            await until(lambda: events.gone)
            assert clock.now > MESSAGE_SECONDS
            assert [client.label for client in events.gone] == [slow.label]
            assert [client.label for client in events.clients] == [silent.label]
            assert events.said == []
            slow.leave()
            silent.leave()
    assert ["did not finish" in log["event"] for log in logs if log["log_level"] == "warning"] == [True]


@EACH_KIND
@asynchronous
async def test_the_time_is_for_each_message_where_one_follows_the_other(kind: str, clock: Clock) -> None:
    """Also where what comes at a time always ends in the middle of a message."""
    message = framed(kind, b"abc")
    async with served(kind) as (transport, events):
        peer = await join(kind, transport)
        await until(lambda: events.clients)
        stream = message * 7
        ends = range(len(message) - 2, len(stream), len(message))
        for number, (begin, end) in enumerate(zip([0, *ends], ends, strict=False)):
            await peer.send(stream[begin:end])
            await until(lambda number=number: len(events.said) == number)  # type: ignore[misc]
            await clock.passes(MESSAGE_SECONDS / 2, transport)
        assert (events.gone, len(events.said)) == ([], 6)
        peer.leave()


@pytest.mark.parametrize(
    ("kind", "hostile"),
    [
        ("packets", struct.pack("<I", MOST + 1)),
        ("packets", b"GET / HTTP/1.1\r\n\r\n"),
        ("lines", b"x" * (MOST + 1)),
        ("lines", b"x" * (MOST + 1) + b"\n"),
        ("websocket", websocket_frame(b"x" * (MOST + 1))),
    ],
)
@asynchronous
async def test_what_is_too_long_is_refused_and_its_sender_closed(kind: str, hostile: bytes) -> None:
    with capture_logs() as logs:
        async with served(kind) as (transport, events):
            peer = await join(kind, transport)
            await peer.say(b"x" * MOST)
            await peer.send(hostile)
            assert await peer.is_closed()
            peer.leave()
            await until(lambda: events.gone)
            assert (events.said, events.refusals) == ([b"x" * MOST], ["too_large"])
    if kind != "websocket":  # where code 1009 says it
        assert [log["event"] for log in logs if log["log_level"] == "warning"] == ["client disconnected"]


@EACH_KIND
@asynchronous
async def test_a_port_that_is_taken_is_refused_with_who_has_it_and_free_again_at_once_after_closing(kind: str) -> None:
    async with served(kind) as (first, events):
        assert first.address is not None
        second = transport_of(kind, Events(), address=first.address)
        with pytest.raises(StartError, match=r"127\.0\.0\.1:\d+ cannot be used: .*\(pid \d+\) has the port"):
            await second.open()
        await second.close()
        peer = await join(kind, first)
        await until(lambda: events.clients)
        closing = asyncio.create_task(first.close())
        assert await peer.is_closed()
        peer.leave()
        await closing
    async with opened(second):
        pass


@EACH_KIND
@asynchronous
async def test_a_fault_of_ours_is_told_and_closes_that_client_alone(kind: str) -> None:
    faults: list[Exception] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: faults.append(context["exception"]))

    def stumble(client: Client, data: bytes, arrived_ns: int) -> None:
        if data == b"stumble":
            raise ZeroDivisionError
        events.said.append(data)

    async with served(kind) as (transport, events):
        events.received = stumble  # type: ignore[method-assign]
        peer, other = [await join(kind, transport) for _ in range(2)]
        await until(lambda: len(events.clients) == 2)
        await peer.say(b"stumble")
        assert await peer.is_closed()
        peer.leave()
        await until(lambda: len(events.gone) == 1)
        await other.say(b"go on")
        await until(lambda: events.said)
        assert len(events.clients) == 1
        other.leave()
    assert [type(fault) for fault in faults] == [ZeroDivisionError]


@EACH_KIND
@pytest.mark.parametrize("turns", range(4))
@asynchronous
async def test_closing_ends_although_clients_are_just_coming(kind: str, turns: int) -> None:
    """`turns` are those of the loop since they connected."""
    transport = transport_of(kind, Events())
    await transport.open()
    assert transport.address is not None
    with ExitStack() as connected:
        for _ in range(20):
            connected.enter_context(socket.create_connection(transport.address))
        for _ in range(turns):
            await asyncio.sleep(0)
        await asyncio.wait_for(transport.close(), PATIENCE_SECONDS)


@EACH_KIND
@asynchronous
async def test_clients_come_by_ipv6(kind: str) -> None:
    door = Door("gateways.test", [IPv6Network("fd00::/64")], Counter())  # and from the own computer
    async with served(kind, Limits(3, 1, MOST), door, Address("::1", 0)) as (transport, events):
        peer = await join(kind, transport, "::1")
        await until(lambda: events.clients)
        assert str(transport.address).startswith("[::1]:")
        assert [client.label for client in events.clients] == [peer.label]
        assert peer.label.startswith("[::1]:")
        await peer.say(b"hello")
        events.clients[0].write([data(b"welcome")])
        assert await peer.hear() == b"welcome"
        await until(lambda: events.said == [b"hello"])
        second = await join(kind, transport, "::1")
        assert await second.is_closed()
        second.leave()
        again = transport_of(kind, Events(), address=transport.address or pytest.fail("it is open"))
        with pytest.raises(StartError, match=r"\[::1\]:\d+ cannot be used: .* has the port"):
            await again.open()
        peer.leave()


@EACH_KIND
@asynchronous
async def test_an_interface_of_a_link_local_address_is_waited_for(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_binding, "RETRY_SECONDS", 0.01)
    transport = transport_of(kind, Events(), address=Address("fe80::1%nowhere0", 8500))
    with capture_logs() as logs:
        async with opened(transport):
            await asyncio.sleep(0.1)
            assert transport.address is None
            monkeypatch.setattr(transport, "_requested", Address("::1", 0))  # the interface comes up
            await until(lambda: transport.address)
    assert [log["log_level"] for log in logs] == ["warning", "info"]


@EACH_KIND
@asynchronous
async def test_clients_outside_the_networks_are_refused_and_counted(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doors, "is_own_computer", lambda *_: False)
    refused = Counter[str]()
    door = Door("gateways.test", [IPv4Network("127.0.1.0/24"), IPv4Network("127.0.3.7/32")], refused)
    with capture_logs() as logs:
        async with served(kind, door=door) as (transport, events):
            assert transport.address is not None
            for host in ("127.0.2.1", "127.0.2.1", "127.0.3.8"):
                reader, writer = await asyncio.open_connection(*transport.address, local_addr=(host, 0))
                with suppress(ConnectionError):
                    assert await reader.read() == b""
                writer.close()
            assert refused == {"gateways.test": 3}
            assert not events.clients
            _, writer = await asyncio.open_connection(*transport.address, local_addr=("127.0.3.7", 0))
            writer.write(GREETING)
            await until(lambda: len(events.clients) == 1)
            writer.close()
    told = [each["client"] for each in logs if each["log_level"] == "warning"]
    assert told == ["127.0.2.1", "127.0.3.8", "127.0.2.1"]  # the last line is a summary
    assert logs[-1]["more"] == 1
