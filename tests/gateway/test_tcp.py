"""A gateway's TCP clients on the loopback interface: fast, slow, stopped, hostile."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import struct
import subprocess
import sys
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from router.errors import StartError
from router.gateway.transport import stream as gateway_stream
from router.gateway.transport.base import HIGH_WATER, LOW_WATER, Client
from router.gateway.transport.stream import READ_PER_TURN, Limits
from router.gateway.transport.tcp import TcpTransport
from router.table.addresses import Address
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.transport_events import Events, close_while_clients_come, data, opened, resident_kib

ANY = Address("127.0.0.1", 0)
MOST = 1000
TEN = Limits(10, 10, MOST)


def prefixed(*packets: bytes) -> bytes:
    return b"".join(struct.pack("<I", len(packet)) + packet for packet in packets)


def lines(events: Events, max_clients: int = 10) -> TcpTransport:
    return TcpTransport(ANY, events, Limits(max_clients, max_clients, MOST), prefixed=False)


def packets(events: Events, most: int = MOST) -> TcpTransport:
    return TcpTransport(ANY, events, Limits(10, 10, most), prefixed=True)


async def connect(transport: TcpTransport) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    assert transport.address is not None
    return await asyncio.open_connection(*transport.address)


def connect_lazily(transport: TcpTransport) -> socket.socket:
    """A client that reads nothing, with a small buffer."""
    peer = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    peer.settimeout(10)
    assert transport.address is not None
    peer.connect(transport.address)
    return peer


@asynchronous
async def test_packets_go_both_ways_each_preceded_by_its_length() -> None:
    events = Events()
    transport = packets(events)
    async with opened(transport):
        reader, writer = await connect(transport)
        writer.write(prefixed(b"one", b"", b"x" * MOST))
        await until(lambda: len(events.said) == 3)
        assert events.said == [b"one", b"", b"x" * MOST]
        [client] = events.clients
        assert client.label == "{}:{}".format(*writer.get_extra_info("sockname"))
        client.write([data(b"two"), data(b"")])
        assert await reader.readexactly(11) == prefixed(b"two", b"")
        writer.close()
        await until(lambda: events.gone == [client])


@asynchronous
async def test_lines_go_both_ways_and_several_clients_get_the_same() -> None:
    events = Events()
    transport = lines(events)
    async with opened(transport):
        ends = [await connect(transport) for _ in range(3)]
        await until(lambda: len(events.clients) == 3)
        transport.write_all(events.clients, [data(b"one"), data(b"two")])
        for reader, _ in ends:
            assert await reader.readexactly(8) == b"one\ntwo\n"
        ends[1][1].write(b'{"op":1}\r\n{"op":2}\n{"op"')
        await until(lambda: len(events.said) == 2)
        assert events.said == [b'{"op":1}', b'{"op":2}']
        assert events.said_by[0] in events.clients
        for _, writer in ends:
            writer.close()


@pytest.mark.parametrize("is_prefixed", [True, False])
@asynchronous
async def test_a_large_message_arrives_whole_between_small_ones_while_others_are_served(is_prefixed: bool) -> None:
    large = b"x" * 7_000_000
    messages = [b"before", large, b"after", large[:70_000], b"end"]
    events = Events()
    transport = TcpTransport(ANY, events, TEN, prefixed=is_prefixed)
    async with opened(transport):
        reader, writer = await connect(transport)
        await until(lambda: events.clients)
        events.clients[0].write([data(message) for message in messages])
        assert events.clients[0].backlog() > 6_000_000
        expected = prefixed(*messages) if is_prefixed else b"".join(message + b"\n" for message in messages)
        other_reader, other_writer = await connect(transport)
        await until(lambda: len(events.clients) == 2)
        transport.write_all(events.clients, [data(b"both")])
        assert await other_reader.readuntil(b"both")
        assert await reader.readexactly(len(expected)) == expected
        await until(lambda: events.eased == [events.clients[0]])
        writer.close()
        other_writer.close()


@asynchronous
async def test_a_client_that_stands_still_holds_up_nobody_and_costs_no_memory_of_its_own() -> None:
    """A hundred of them, each with 7 MB to get: the pieces are shared."""
    events = Events()
    transport = TcpTransport(ANY, events, Limits(101, 101, MOST), prefixed=True)
    async with opened(transport):
        still = [connect_lazily(transport) for _ in range(100)]
        await until(lambda: len(events.clients) == 100)
        reader, writer = await connect(transport)
        await until(lambda: len(events.clients) == 101)
        before = resident_kib()
        transport.write_all(events.clients, [data(b"x" * 7_000_000)])
        await reader.readexactly(7_000_004)
        assert all(client.backlog() > 6_000_000 for client in events.clients[:100])
        assert resident_kib() - before < 100_000
        transport.write_all(events.clients[100:], [data(b"next")])
        assert await reader.readexactly(8) == prefixed(b"next")
        assert events.eased == [events.clients[100]]
        writer.close()
        for peer in still:
            peer.close()


@asynchronous
async def test_a_slow_client_is_written_to_while_it_takes_and_told_when_it_has_drained() -> None:
    """As a service does it: nothing over HIGH_WATER, and on from `drained`."""
    message = b"x" * 9996
    wanted = 600
    events = Events()
    transport = packets(events)
    sent = 0

    def send(client: Client) -> None:
        nonlocal sent
        while sent < wanted and client.backlog() < HIGH_WATER:
            client.write([data(message)])
            sent += 1

    def go_on(client: Client) -> None:
        assert client.backlog() < LOW_WATER
        send(client)

    events.on_drained = go_on
    async with opened(transport):
        peer = connect_lazily(transport)
        await until(lambda: events.clients)
        send(events.clients[0])
        assert sent < wanted
        assert HIGH_WATER <= events.clients[0].backlog() < HIGH_WATER + 10_000

        def read() -> bytes:
            return b"".join(iter(lambda: peer.recv(3000), b""))

        reading = asyncio.create_task(asyncio.to_thread(read))
        await until(lambda: sent == wanted and not events.clients[0].backlog())
        await transport.close()
        assert await reading == prefixed(*[message] * wanted)
        assert len(events.eased) > 2
        peer.close()


@asynchronous
async def test_a_stopped_process_is_closed_and_told_when_it_took_nothing_for_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gateway_stream, "STALLED_SECONDS", 0.3)
    program = (
        "import socket, sys; s = socket.create_connection(('127.0.0.1', int(sys.argv[1])))\nwhile s.recv(1000): pass"
    )
    events = Events()
    transport = lines(events)
    with capture_logs() as logs:
        async with opened(transport):
            assert transport.address is not None
            with subprocess.Popen([sys.executable, "-c", program, str(transport.address.port)]) as process:
                await until(lambda: events.clients)
                [client] = events.clients
                process.send_signal(signal.SIGSTOP)
                client.write([data(b"x" * 10_000_000)])
                await until(lambda: events.gone == [client])
                process.send_signal(signal.SIGCONT)
    assert ["send stalled" in log["event"] for log in logs if log["log_level"] == "warning"] == [True]


@asynchronous
async def test_a_client_that_is_killed_leaves() -> None:
    events = Events()
    transport = lines(events)
    async with opened(transport):
        peer = connect_lazily(transport)
        await until(lambda: events.clients)
        [client] = events.clients
        client.write([data(b"x" * 1_000_000)])
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        peer.close()
        await until(lambda: events.gone == [client])
        client.write([data(b"too late")])
        assert events.eased == []


@pytest.mark.parametrize(
    ("is_prefixed", "hostile"),
    [
        (True, struct.pack("<I", MOST + 1)),
        (True, b"GET / HTTP/1.1\r\n\r\n"),
        (False, b"x" * (MOST + 1)),
        (False, b"x" * (MOST + 1) + b"\n"),
    ],
)
@asynchronous
async def test_what_is_too_long_is_refused_and_its_sender_closed(is_prefixed: bool, hostile: bytes) -> None:
    events = Events()
    transport = packets(events) if is_prefixed else lines(events)
    with capture_logs() as logs:
        async with opened(transport):
            _, writer = await connect(transport)
            writer.write((prefixed(b"good") if is_prefixed else b"good\n") + hostile)
            await until(lambda: events.gone)
            assert (events.said, events.refusals) == ([b"good"], ["too_large"])
            writer.close()
    assert [log["event"] for log in logs if log["log_level"] == "warning"] == ["a client was closed"]


@asynchronous
async def test_one_that_sends_without_end_does_not_keep_others_waiting() -> None:
    events = Events()
    transport = lines(events)
    async with opened(transport):
        _, flood = await connect(transport)
        _, other = await connect(transport)
        await until(lambda: len(events.clients) == 2)
        flood.write(b"\n" * 20 * READ_PER_TURN)
        other.write(b"me too\n")
        await until(lambda: b"me too" in events.said)
        await until(lambda: len(events.said) == 20 * READ_PER_TURN + 1)
        flood.close()
        other.close()


@asynchronous
async def test_a_client_beyond_the_most_is_closed_at_once_and_told() -> None:
    events = Events()
    transport = lines(events, max_clients=2)
    with capture_logs() as logs:
        async with opened(transport):
            ends = [await connect(transport) for _ in range(2)]
            await until(lambda: len(events.clients) == 2)
            reader, writer = await connect(transport)
            with suppress(ConnectionResetError):
                assert await reader.read() == b""
            ends[0][1].close()
            await until(lambda: events.gone)
            ends.append(await connect(transport))
            await until(lambda: len(events.clients) == 2)
            for _, end in [*ends, (reader, writer)]:
                end.close()
    [warning] = [log for log in logs if log["log_level"] == "warning"]
    assert "too many" in warning["event"]
    assert len(events.gone) == 3


@asynchronous
async def test_a_port_that_is_taken_is_refused_with_who_has_it_and_free_again_at_once_after_closing() -> None:
    events = Events()
    first = lines(events)
    async with opened(first):
        assert first.address is not None
        second = TcpTransport(first.address, Events(), TEN, prefixed=False)
        with pytest.raises(StartError, match=r"127\.0\.0\.1:\d+ cannot be used: .*\(pid \d+\) has the port"):
            await second.open()
        await second.close()
        reader, writer = await connect(first)
        await until(lambda: events.clients)
        await first.close()
        assert await reader.read() == b""
        writer.close()
    async with opened(second):
        pass


MESSAGES = st.lists(st.binary(max_size=20).map(lambda message: message.replace(b"\n", b" ").rstrip(b"\r")), max_size=10)


@settings(max_examples=20)
@given(MESSAGES, st.lists(st.integers(1, 30), min_size=1), st.booleans())
@asynchronous
async def test_it_does_not_matter_how_the_network_cuts_what_is_sent(
    messages: list[bytes], cuts: list[int], is_prefixed: bool
) -> None:
    sent = prefixed(*messages) if is_prefixed else b"".join(message + b"\n" for message in messages)
    events = Events()
    transport = TcpTransport(ANY, events, Limits(1, 1, 20), prefixed=is_prefixed)
    async with opened(transport):
        _, writer = await connect(transport)
        at = 0
        while at < len(sent):
            cut = cuts[at % len(cuts)]
            writer.write(sent[at : at + cut])
            at += cut
            await asyncio.sleep(0)
        await until(lambda: len(events.said) == len(messages))
        assert events.said == messages
        writer.close()


@asynchronous
async def test_a_fault_of_ours_is_told_and_closes_that_client_alone() -> None:
    events = Events()
    faults: list[Exception] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: faults.append(context["exception"]))
    transport = lines(events)

    def stumble(client: Client, data: bytes, arrived_ns: int) -> None:
        json.loads(data)

    events.received = stumble  # type: ignore[method-assign]
    async with opened(transport):
        _, writer = await connect(transport)
        _, other = await connect(transport)
        await until(lambda: len(events.clients) == 2)
        writer.write(b"{\n")
        await until(lambda: faults)
        await until(lambda: len(events.gone) == 1)
        other.write(b"{}\n")
        await asyncio.sleep(0.05)
        assert len(events.clients) == 1
        writer.close()
        other.close()
    assert [type(fault) for fault in faults] == [json.JSONDecodeError]


@pytest.mark.parametrize("turns", range(4))
def test_closing_ends_although_clients_are_just_coming(turns: int) -> None:
    asyncio.run(close_while_clients_come(packets(Events()), turns))
