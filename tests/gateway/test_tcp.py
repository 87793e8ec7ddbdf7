"""A gateway's TCP clients, whose messages have a length in front or are lines. test_stream.py has the rest."""

from __future__ import annotations

import asyncio

from hypothesis import given
from hypothesis import strategies as st

from router.gateway.transport.base import PER_TURN
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stream_peers import MOST, framed, join, served
from tests.gateway.transport_events import data


@asynchronous
async def test_packets_go_both_ways_each_preceded_by_its_length() -> None:
    async with served("packets") as (transport, events):
        peer = await join("packets", transport)
        await peer.send(b"\3\0\0\0one" + b"\0\0\0\0" + b"\xe8\3\0\0" + b"x" * MOST)
        await until(lambda: len(events.said) == 3)
        assert events.said == [b"one", b"", b"x" * MOST]
        [client] = events.clients
        assert client.label == peer.label
        client.write([data(b"two"), data(b"")])
        assert await peer.reader.readexactly(11) == b"\3\0\0\0two" + b"\0\0\0\0"
        peer.leave()
        await until(lambda: events.gone == [client])


@asynchronous
async def test_lines_go_both_ways_and_several_clients_get_the_same() -> None:
    async with served("lines") as (transport, events):
        peers = [await join("lines", transport) for _ in range(3)]
        await until(lambda: len(events.clients) == 3)
        transport.write_all(events.clients, [data(b"one"), data(b"two")])
        for peer in peers:
            assert await peer.reader.readexactly(8) == b"one\ntwo\n"
        await peers[1].send(b'{"op":1}\r\n{"op":2}\n{"op"')
        await until(lambda: len(events.said) == 2)
        assert events.said == [b'{"op":1}', b'{"op":2}']
        assert events.said_by[0] in events.clients
        for peer in peers:
            peer.leave()


@asynchronous
async def test_blank_lines_are_no_messages() -> None:
    async with served("lines") as (transport, events):
        peer = await join("lines", transport)
        await peer.send(b'\n\r\n \t\r\n{"op":1}\r\n\r\n\n  {"op":2} \n\n')
        await until(lambda: len(events.said) == 2)
        assert events.said == [b'{"op":1}', b'{"op":2}']
        peer.leave()


@asynchronous
async def test_one_that_sends_without_end_does_not_keep_others_waiting() -> None:
    async with served("lines") as (transport, events):
        flood, other = [await join("lines", transport) for _ in range(2)]
        await until(lambda: len(events.clients) == 2)
        flood.writer.write(b"x\n" * 20 * PER_TURN)
        other.writer.write(b"me too\n")
        await until(lambda: b"me too" in events.said)
        await until(lambda: len(events.said) == 20 * PER_TURN + 1)
        flood.leave()
        other.leave()


MESSAGES = st.lists(st.binary(max_size=20).map(lambda message: b"{" + message.replace(b"\n", b" ") + b"}"), max_size=10)


@given(MESSAGES, st.lists(st.integers(1, 30), min_size=1), st.sampled_from(["packets", "lines"]))
@asynchronous
async def test_it_does_not_matter_how_the_network_cuts_what_is_sent(
    messages: list[bytes], cuts: list[int], kind: str
) -> None:
    sent = framed(kind, *messages)
    async with served(kind) as (transport, events):
        peer = await join(kind, transport)
        at = 0
        while at < len(sent):
            cut = cuts[at % len(cuts)]
            peer.writer.write(sent[at : at + cut])
            at += cut
            await asyncio.sleep(0)
        await until(lambda: len(events.said) == len(messages))
        assert events.said == messages
        peer.leave()
