"""A gateway's UDP socket on the loopback interface."""

from __future__ import annotations

import asyncio
import errno
import socket
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

import pytest
from structlog.testing import capture_logs

from router.clock import wall_ns
from router.errors import StartError
from router.gateway.transport import binding as gateway_binding
from router.gateway.transport import udp as gateway_udp
from router.gateway.transport.base import HIGH_WATER, LOW_WATER
from router.gateway.transport.udp import UdpTransport
from router.net.addresses import family
from router.table.addresses import Address
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.transport_events import Events, data, opened
from tests.namespaces import Computer, cable, computers, narrow_path
from tests.ports import free_port


@pytest.fixture
def headset() -> Iterator[socket.socket]:
    with headset_at("127.0.0.1") as peer:
        yield peer


@contextmanager
def headset_at(host: str) -> Iterator[socket.socket]:
    with socket.socket(family(host), socket.SOCK_DGRAM) as peer:
        peer.bind((host, 0))
        peer.settimeout(10)
        yield peer


def address_of(peer: socket.socket) -> Address:
    return Address(*peer.getsockname()[:2])


def local(host: str = "127.0.0.1") -> Address:
    return Address(host, free_port(host))


@asynccontextmanager
async def served(headset: socket.socket) -> AsyncIterator[tuple[UdpTransport, Events]]:
    """An open transport, and what it tells."""
    events = Events()
    transport = UdpTransport(address_of(headset), local(), events)
    async with opened(transport):
        yield transport, events


async def hear(peer: socket.socket) -> tuple[bytes, tuple[str, int]]:
    heard: tuple[bytes, tuple[str, int]] = await asyncio.to_thread(peer.recvfrom, 65536)
    return heard


@asynchronous
async def test_each_frame_is_a_datagram_from_the_local_address(headset: socket.socket) -> None:
    async with served(headset) as (transport, events):
        [client] = events.clients
        assert client.label == str(address_of(headset))
        transport.write_all([client], [data(b"one"), data(b"x" * 65507)])
        assert headset.recvfrom(65536) == (b"one", transport.address)
        assert headset.recvfrom(65536) == (b"x" * 65507, transport.address)
        assert client.backlog() == 0
    assert events.gone == [client]
    client.write([data(b"too late")])
    assert client.backlog() == 0


@asynchronous
async def test_the_clients_host_is_heard_from_any_port_and_nobody_else(headset: socket.socket) -> None:
    async with served(headset) as (transport, events):
        assert transport.address is not None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as restarted:
            restarted.sendto(b"hello", transport.address)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.2", 0))
            stranger.sendto(b"hello", transport.address)
        headset.sendto(b"x" * 65507, transport.address)
        headset.sendto(b"", transport.address)
        await until(lambda: len(events.said) == 3)
        assert events.said == [b"hello", b"x" * 65507, b""]
        assert events.refusals == ["source_mismatch"]


@pytest.mark.parametrize("local_host", ["::1", "::", None])
@asynchronous
async def test_a_client_has_an_ipv6_address(local_host: str | None) -> None:
    with headset_at("::1") as headset:
        events = Events()
        transport = UdpTransport(address_of(headset), local(local_host) if local_host else None, events)
        async with opened(transport):
            [client] = events.clients
            assert client.label == f"[::1]:{headset.getsockname()[1]}"
            client.write([data(b"one")])
            heard, sender = await hear(headset)
            assert (heard, sender[0]) == (b"one", "::1")
            headset.sendto(b"hello", sender)
            await until(lambda: events.said or not local_host)
            assert events.said == [b"hello"] * bool(local_host)


def say_from(interface: str) -> None:
    index = socket.if_nametoindex(interface)
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as headset:
        headset.bind(("fe80::2", 9001, 0, index))
        headset.sendto(interface.encode(), ("fe80::1", 8500, 0, index))


def test_a_link_local_client_is_heard_on_its_interface_only() -> None:
    async def serve(near: Computer) -> tuple[list[bytes], list[str]]:
        events = Events()
        async with opened(UdpTransport(Address("fe80::2%eth0", 9000), Address("::", 8500), events)):
            [client] = events.clients
            client.write([data(b"one")])
            assert (await hear(headset))[0] == b"one"
            far.inside(lambda: say_from("eth1"))
            await until(lambda: events.refusals)
            far.inside(lambda: say_from("eth0"))
            await until(lambda: events.said)
            near.ip("link", "del", "eth0")
            client.write([data(b"lost")])
            [(_, error, lost)] = events.failures
            assert isinstance(error, OSError)
            assert (error.errno, lost) == (errno.ENODEV, 1)
        return events.said, events.refusals

    with computers("near", "far") as (near, far):
        for interface in ("eth0", "eth1"):
            cable(near, interface, "fe80::1/64", far, interface, "fe80::2/64")
        with far.inside(lambda: socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)) as headset:
            headset.bind(("::", 9000))
            headset.settimeout(10)
            assert near.inside(lambda: asyncio.run(serve(near))) == ([b"eth0"], ["source_mismatch"])


@asynchronous
async def test_without_a_local_address_it_sends_from_any_port_and_hears_nothing(headset: socket.socket) -> None:
    events = Events()
    transport = UdpTransport(address_of(headset), None, events)
    async with opened(transport):
        events.clients[0].write([data(b"one")])
        _, sender = await hear(headset)
        headset.sendto(b"hello", sender)
        await asyncio.sleep(0.05)
        assert events.said == []


@asynchronous
async def test_what_was_said_counts_from_when_the_kernel_got_it(headset: socket.socket) -> None:
    """Which begins to stamp a little after it was asked to."""
    async with served(headset) as (transport, events):
        assert transport.address is not None
        for number in range(1, 100):
            headset.sendto(b"go", transport.address)
            sent = wall_ns()
            time.sleep(0.01)
            await until(lambda number=number: len(events.said) == number)  # type: ignore[misc]
            if events.arrivals[-1] <= sent:
                return
    raise AssertionError("the kernel stamps nothing")


@asynchronous
async def test_what_the_kernel_drops_is_known_and_a_burst_is_kept(headset: socket.socket) -> None:
    events = Events()
    transport = UdpTransport(address_of(headset), local(), events)
    assert transport.kernel_drops() == 0
    async with opened(transport):
        assert transport.address is not None
        for _ in range(5000):  # the loop is away
            headset.sendto(b"x" * 1400, transport.address)
        dropped = transport.kernel_drops()
        assert dropped > 0
        await until(lambda: len(events.said) == 5000 - dropped)
    assert transport.kernel_drops() == dropped


@asynchronous
async def test_a_socket_that_closes_while_another_thread_asks_has_no_new_drops(
    headset: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with served(headset) as (transport, _):
        with monkeypatch.context() as closing, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
            closing.setattr(transport, "_socket", closed)
            closed.close()
            assert transport.kernel_drops() == 0


@asynchronous
async def test_a_client_that_is_not_there_costs_nothing() -> None:
    events = Events()
    transport = UdpTransport(local(), local(), events)
    async with opened(transport):
        for _ in range(5):
            events.clients[0].write([data(b"one")])
            await asyncio.sleep(0.01)
        assert events.failures == []


@asynchronous
async def test_what_cannot_be_sent_is_told_once_for_all_of_a_burst(headset: socket.socket) -> None:
    async with served(headset) as (_, events):
        [client] = events.clients
        client.write([data(b"x" * 65508), data(b"fits"), data(b"x" * 65508)])
        assert (await hear(headset))[0] == b"fits"
        [(failed, error, lost)] = events.failures
        assert (failed, lost) == (client, 2)
        assert isinstance(error, OSError)


@asynchronous
async def test_a_burst_is_paced_and_goes_out_in_order(headset: socket.socket) -> None:
    headset.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)  # what is late here is this test's own thread
    async with served(headset) as (_, events):
        [client] = events.clients
        frames = [data(b"%06d" % number + b"x" * 1394) for number in range(1000)]
        reading = asyncio.get_running_loop().run_in_executor(None, lambda: [headset.recv(2000) for _ in frames])
        await asyncio.sleep(0.05)
        client.write(frames[:500])
        assert client.backlog() == (500 - gateway_udp.BURST) * 1400
        client.write(frames[500:])
        assert client.backlog() == (1000 - gateway_udp.BURST) * 1400 > HIGH_WATER
        await until(lambda: events.eased)
        assert client.backlog() < LOW_WATER
        assert await reading == [frame.data for frame in frames]
        assert set(events.eased) == {client}
        assert events.failures == []


@asynchronous
async def test_large_datagrams_are_paced_by_their_bytes(headset: socket.socket) -> None:
    async with served(headset) as (_, events):
        events.clients[0].write([data(b"x" * 60_000)] * 10)
        assert events.clients[0].backlog() == 7 * 60_000


@asynchronous
async def test_a_port_that_is_taken_is_refused_with_who_has_it(headset: socket.socket) -> None:
    transport = UdpTransport(Address("127.0.0.1", 9), address_of(headset), Events())
    with pytest.raises(StartError, match=r"127\.0\.0\.1:\d+ cannot be used: .*\(pid \d+\) has the port"):
        await transport.open()
    await transport.close()


@asynchronous
async def test_an_address_that_this_machine_does_not_have_yet_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway_binding, "RETRY_SECONDS", 0.01)
    events = Events()
    transport = UdpTransport(Address("127.0.0.1", 9), Address("192.0.2.1", 8500), events)
    with capture_logs() as logs:
        async with opened(transport):
            await asyncio.sleep(0.1)
            assert events.clients == []
            monkeypatch.setattr(transport, "_local", local())  # the interface comes up
            await until(lambda: len(events.clients) == 1)
    assert [log["log_level"] for log in logs] == ["warning", "info"]


def test_a_packet_larger_than_the_paths_mtu_arrives_though_icmp_is_filtered() -> None:
    async def serve() -> bytes:
        events = Events()
        async with opened(UdpTransport(address_of(hearer), None, events)):
            [client] = events.clients
            client.write([data(bytes(1400))])
            return (await hear(hearer))[0]

    with narrow_path() as (near, far), far.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as hearer:
        hearer.bind(("10.78.2.2", 9000))
        hearer.settimeout(10)
        assert near.inside(lambda: asyncio.run(serve())) == bytes(1400)
