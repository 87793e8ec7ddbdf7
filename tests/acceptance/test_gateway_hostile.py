"""Gateways of a running router whose clients mean harm, or stand still: nothing gets through, nobody else suffers."""

from __future__ import annotations

import json
import random
import signal
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from backports import zstd

from tests.acceptance.gateway_clients import Scene, head, scene
from tests.acceptance.site import key, total, udp, wait_until

ARRAY = "std_msgs/msg/UInt8MultiArray"
GATEWAYS = f"""\
  headset:
    transport: {{udp: 127.0.0.9:HEADSET}}
    receive: 127.0.0.5:RECEIVE
    topics: {{include: ["/gw/**"]}}
    publish_period: 100ms
    discovery_period: 200ms
    max_message: 1MiB
    inbound:
      - {{topic: /gw/set, type: std_msgs/msg/Int32}}
      - {{topic: /gw/twist, type: geometry_msgs/msg/Twist, ttl: 500ms}}
      - {{topic: /gw/many, type: {ARRAY}}}
  open:
    transport: {{tcp: 127.0.0.5:OPEN}}
    max_clients_per_host: 200
    topics: {{include: ["/gw/**"]}}
    publish_period: each
    discovery_period: 200ms
    inbound: [{{topic: /gw/other_set, type: std_msgs/msg/Int32}}]
"""
HEARD = {"/gw/set": "std_msgs/msg/Int32", "/gw/twist": "geometry_msgs/msg/Twist", "/gw/many": ARRAY}
WRAPPED_TWIST = {part: [{axis: [0.0] for axis in "xyz"}] for part in ("linear", "angular")}
WRONG_VALUES = b'1e308 1e400 NaN -Infinity null true "x" 3.0 2147483648 [] {} [[1]] 01 "\\ud800"'.split()
WRONG_NAMES = ("/gw/other", "", "/gw/set\n", '/gw/set\n{"event":"forged"}', "\x1b[2Jforged", "x" * 5000)


def hostile(topic: str, seed: int) -> Iterator[bytes]:
    """Packets, none of which is to be published."""
    rng = random.Random(seed)
    good = head(topic, "std_msgs/msg/Int32")
    packed = zstd.compress(b'{"data":[7]}')
    for value in WRONG_VALUES:
        yield good + b'{"data":[' + value + b"]}"
    for name in WRONG_NAMES:
        yield head(name, "std_msgs/msg/Int32") + b'{"data":[7]}'
    for text in (b"{", b"{}", b'{"data":7}', b'{"data":[7],"more":[1]}', b"[" * 3_000):
        yield good + text
    for stamp in (float("nan"), float("inf")):
        yield head(topic, "std_msgs/msg/Int32", stamp=stamp) + b'{"data":[7]}'
    for end in range(len(packed)):
        yield head(topic, "std_msgs/msg/Int32", 1) + packed[:end] if end else good + b"\xff"
    for length in range(40):
        yield rng.randbytes(length)[:8] + b"\x05" + rng.randbytes(length)


def bomb(topic: str) -> bytes:
    """A small packet that asks for much memory."""
    return head(topic, "std_msgs/msg/Int32", 1) + zstd.compress(bytes(17 << 20))


def filled(topic: str, type_name: str, elements: bytes) -> bytes:
    """A small packet whose content is about as long as a gateway takes at most."""
    text = b'{"layout":[{"dim":[],"data_offset":[0]}],"data":[' + elements * (1_000_000 // len(elements)) + b"0]}"
    return head(topic, type_name, 1) + zstd.compress(text)


@pytest.fixture(scope="module")
def now(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    with scene(tmp_path_factory.mktemp("hostile"), GATEWAYS, "OPEN", "HEADSET RECEIVE", HEARD) as running:
        yield running


@pytest.fixture
def client(now: Scene) -> Iterator[socket.socket]:
    with udp("127.0.0.9") as opened:
        opened.connect(("127.0.0.5", now.ports["RECEIVE"]))
        yield opened


def settled(now: Scene, before: Counter[str], gateway: str, datagrams: int) -> Counter[str]:
    """Waits until so many have come, and what became of each is in the counters; what was counted."""
    counts = Counter[str]()

    def is_settled() -> bool:
        nonlocal counts
        counts = now.site.changes(before)
        rejected = total(counts, "datagrams_rejected", listener=gateway)
        accepted = counts[key("messages_received", route=gateway, source="clients")]
        return total(counts, "datagrams_received", listener=gateway) == datagrams == rejected + accepted

    wait_until(is_settled, f"the last of {datagrams} datagrams")
    return counts


def rejected(counts: Counter[str], gateway: str, reason: str) -> int:
    return counts[key("datagrams_rejected", listener=gateway, reason=reason)]


def test_of_hostile_datagrams_none_is_published_and_each_is_counted(now: Scene, client: socket.socket) -> None:
    before, packets = now.site.scrape(), list(hostile("/gw/set", 0))
    for start in range(0, len(packets), 20):  # the kernel keeps only so many
        for datagram in packets[start : start + 20]:
            client.send(datagram)
        settled(now, before, "headset", min(start + 20, len(packets)))
    client.send(bomb("/gw/set"))
    counts = settled(now, before, "headset", len(packets) + 1)
    assert rejected(counts, "headset", "too_large") == 1
    assert counts[key("messages_received", route="headset", source="clients")] == 0
    client.send(head("/gw/set", "std_msgs/msg/Int32") + b'{"data":[8]}')
    assert now.peer.receive() == ("/gw/set", {"data": 8})
    assert now.peer.nothing_left()
    assert not now.router.events("forged")
    assert len(now.router.log()) < 50, "the log is flooded"


def test_of_hostile_packets_over_tcp_each_is_counted_and_a_giant_one_ends_the_connection(now: Scene) -> None:
    before, packets = now.site.scrape(), list(hostile("/gw/other_set", 1))
    with now.connect("OPEN") as client:
        client.sendall(b"".join(struct.pack("<I", len(each)) + each for each in packets))
        settled(now, before, "open", len(packets))
        giant = bomb("/gw/other_set")
        client.sendall(struct.pack("<I", len(giant)) + giant)
        settled(now, before, "open", len(packets) + 1)
        client.sendall(struct.pack("<I", 0xFFFFFFFF))
        wait_until(lambda: not client.recv(65536), "the end of the connection")
    counts = settled(now, before, "open", len(packets) + 2)
    assert counts[key("messages_received", route="open", source="clients")] == 0
    assert rejected(counts, "open", "too_large") == 2


def test_what_was_sent_while_the_router_stood_still_is_stale(now: Scene, client: socket.socket) -> None:
    before, text = now.site.scrape(), json.dumps(WRAPPED_TWIST).encode()
    with now.router.standing_still():
        for _ in range(10):
            client.send(head("/gw/twist", "geometry_msgs/msg/Twist") + text)
        time.sleep(0.6)
    stale = key("messages_dropped", route="headset", target="/gw/twist", reason="stale")
    published = key("messages_published", route="headset", topic="/gw/twist")
    wait_until(lambda: now.site.changes(before)[stale] == 10, "the drops")
    assert now.site.changes(before)[published] == 0
    assert now.peer.nothing_left()

    def moves() -> bool:
        client.send(head("/gw/twist", "geometry_msgs/msg/Twist") + text)
        return now.site.changes(before)[published] > 0

    wait_until(moves, "a fresh one")
    now.peer.receive_on("/gw/twist")


def lagging(now: Scene) -> set[str]:
    return {name for name, lag in now.site.samples().items() if name.startswith("gateway_client_lag") and lag}


def test_clients_that_never_read_are_counted(now: Scene) -> None:
    now.peer.open("/gw/word", "std_msgs/msg/String")
    now.await_subscription("/gw/word")
    with ExitStack() as opened:
        stopped = [opened.enter_context(now.connect("OPEN")) for _ in range(100)]
        now.await_clients("open", 100)
        now.peer.say("/gw/word", {"data": "x" * 20_000}, times=200)
        wait_until(lambda: len(lagging(now)) == 100, "the clients to lag")
        for each in stopped[1:]:
            each.close()
        now.await_clients("open", 1)
        assert len(lagging(now)) == 1


def test_what_is_long_to_read_delays_neither_other_commands_nor_the_end(now: Scene, client: socket.socket) -> None:
    """Last in this module."""
    before, numbers = now.site.scrape(), filled("/gw/many", ARRAY, b"0,")
    packets = [
        filled("/gw/many", ARRAY, b'0,"",'),
        filled("/gw/many", ARRAY, b"["),
        filled("/gw/many", ARRAY, b"9"),
        filled("/gw/nope", "a/msg/B", b"0,"),
        head("/gw/many", ARRAY, 1) + zstd.compress(b" " * (1 << 20) + b"1"),
    ]
    for datagram in (numbers, *packets, head("/gw/set", "std_msgs/msg/Int32") + b'{"data":[8]}'):
        client.send(datagram)
    now.peer.receive_on("/gw/set")
    counts = settled(now, before, "headset", 7)
    for reason, times in (("not_allowed", 1), ("malformed", 1), ("invalid", 2), ("too_large", 1)):
        assert rejected(counts, "headset", reason) == times
    assert counts[key("messages_published", route="headset", topic="/gw/many")] == 1
    now.peer.open("/gw/words", "std_msgs/msg/String")
    now.await_subscription("/gw/words")
    with now.connect("OPEN"):
        now.await_clients("open", 1)
        now.peer.say("/gw/words", {"data": "x" * 20_000}, times=200)
        wait_until(lambda: bool(lagging(now)), "the client to lag")
        for _ in range(3):
            client.send(numbers)
        assert now.router.stop(signal.SIGTERM) == 0
