"""Gateways of a running router whose clients mean harm, or stand still: nothing gets through, nobody else suffers."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from backports import zstd

from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.site import key, total, udp, wait_until
from tests.acceptance.test_gateway import HEADSET, Scene, scene

INBOUND = """\
    inbound:
      - {topic: /gw/set, type: std_msgs/msg/Int32}
      - {topic: /gw/twist, type: geometry_msgs/msg/Twist, ttl: 500ms}
"""

OPEN = """\
  open:
    transport: {tcp: 127.0.0.5:PORT}
    max_clients_per_host: 200
    topics: {include: ["/gw/**"]}
    publish_period: each
    discovery_period: 200ms
"""

WRAPPED_TWIST = {part: [{axis: [0.0] for axis in "xyz"}] for part in ("linear", "angular")}
WRONG_VALUES = b'1e308 1e400 NaN -Infinity null true "x" 3.0 2147483648 [] {} [[1]] 01 "\\ud800"'.split()
WRONG_NAMES = ("/gw/other", "", "/gw/set\n", '/gw/set\n{"event":"forged"}', "\x1b[2Jforged", "x" * 5000)


def head(topic: str, type_name: str, kind: int = 0, stamp: float | None = None) -> bytes:
    names = f"{topic}\0{type_name}\0".encode()
    return struct.pack("<dB", time.time() if stamp is None else stamp, kind) + names


def hostile(seed: int) -> Iterator[bytes]:
    """Packets, none of which is to be published."""
    rng = random.Random(seed)
    good = head("/gw/set", "std_msgs/msg/Int32")
    packed = zstd.compress(b'{"data":[7]}')
    for value in WRONG_VALUES:
        yield good + b'{"data":[' + value + b"]}"
    for name in WRONG_NAMES:
        yield head(name, "std_msgs/msg/Int32") + b'{"data":[7]}'
    for text in (b"{", b"{}", b'{"data":7}', b'{"data":[7],"more":[1]}', b"[" * 3_000):
        yield good + text
    for stamp in (float("nan"), float("inf")):
        yield head("/gw/set", "std_msgs/msg/Int32", stamp=stamp) + b'{"data":[7]}'
    for end in range(len(packed)):
        yield head("/gw/set", "std_msgs/msg/Int32", 1) + packed[:end] if end else good + b"\xff"
    for length in range(40):
        yield rng.randbytes(length)[:8] + b"\x05" + rng.randbytes(length)


def bomb() -> bytes:
    """A small packet that asks for much memory."""
    return head("/gw/set", "std_msgs/msg/Int32", 1) + zstd.compress(bytes(17 << 20))


def filled(topic: str, type_name: str, elements: bytes) -> bytes:
    """A small packet whose content is about as long as a gateway takes at most."""
    text = b'{"layout":[{"dim":[],"data_offset":[0]}],"data":[' + elements * (1_000_000 // len(elements)) + b"0]}"
    return head(topic, type_name, 1) + zstd.compress(text)


def settled(now: Scene, gateway: str, datagrams: int) -> None:
    """Waits until so many have come, and what became of each is in the counters."""

    def is_settled() -> bool:
        counts = now.site.scrape()
        rejected = total(counts, "datagrams_rejected", listener=gateway)
        accepted = counts[key("messages_received", route=gateway, source="clients")]
        return total(counts, "datagrams_received", listener=gateway) == datagrams == rejected + accepted

    wait_until(is_settled, f"the last of {datagrams} datagrams")


def test_of_hostile_datagrams_none_is_published_and_each_is_counted(tmp_path: Path) -> None:
    with (
        scene(tmp_path, HEADSET + INBOUND) as now,
        RosPeer({"/gw/set": "std_msgs/msg/Int32", "/gw/twist": "geometry_msgs/msg/Twist"}) as peer,
        udp("127.0.0.9") as client,
    ):
        sent = 0
        for seed in range(5):
            for datagram in hostile(seed):
                client.sendto(datagram, ("127.0.0.5", now.receive))
                sent += 1
                if not sent % 20:
                    settled(now, "headset", sent)  # the kernel keeps only so many
        settled(now, "headset", sent)
        client.sendto(bomb(), ("127.0.0.5", now.receive))
        settled(now, "headset", sent + 1)
        assert now.count("datagrams_rejected", listener="headset", reason="too_large") == 1
        assert now.count("messages_received", route="headset", source="clients") == 0
        client.sendto(head("/gw/set", "std_msgs/msg/Int32") + b'{"data":[8]}', ("127.0.0.5", now.receive))
        assert peer.receive() == ("/gw/set", {"data": 8})
        assert peer.nothing_left()
        assert not now.router.events("forged")
        assert len(now.router.log()) < 50, "the log is flooded"


def test_of_hostile_packets_over_tcp_each_is_counted_and_a_giant_one_ends_the_connection(tmp_path: Path) -> None:
    with scene(tmp_path, OPEN + INBOUND) as now:
        packets = list(hostile(1))
        with socket.create_connection(("127.0.0.5", now.port), PATIENCE) as client:
            client.sendall(b"".join(struct.pack("<I", len(each)) + each for each in packets))
            settled(now, "open", len(packets))
            client.sendall(struct.pack("<I", len(bomb())) + bomb())
            settled(now, "open", len(packets) + 1)
            client.sendall(struct.pack("<I", 0xFFFFFFFF))
            wait_until(lambda: not client.recv(65536), "the end of the connection")
        settled(now, "open", len(packets) + 2)
        assert now.count("messages_received", route="open", source="clients") == 0
        assert now.count("datagrams_rejected", listener="open", reason="too_large") == 2


def test_what_is_long_to_read_delays_neither_other_commands_nor_the_end(tmp_path: Path) -> None:
    many = "      - {topic: /gw/many, type: std_msgs/msg/UInt8MultiArray}\n    max_message: 1MiB\n"
    array = "std_msgs/msg/UInt8MultiArray"
    with (
        scene(tmp_path, HEADSET + INBOUND + many) as now,
        RosPeer({"/gw/set": "std_msgs/msg/Int32", "/gw/many": array}) as peer,
        udp("127.0.0.9") as client,
    ):
        numbers = filled("/gw/many", array, b"0,")
        hostile = [
            filled("/gw/many", array, b'0,"",'),
            filled("/gw/many", array, b"["),
            filled("/gw/many", array, b"9"),
            filled("/gw/nope", "a/msg/B", b"0,"),
            head("/gw/many", array, 1) + zstd.compress(b" " * (1 << 20) + b"1"),
        ]
        for datagram in (numbers, *hostile, head("/gw/set", "std_msgs/msg/Int32") + b'{"data":[8]}'):
            client.sendto(datagram, ("127.0.0.5", now.receive))
        topics = [peer.receive() for _ in range(2)]
        assert {topic for topic, _ in topics} == {"/gw/many", "/gw/set"}
        settled(now, "headset", 7)
        for reason, times in (("not_allowed", 1), ("invalid", 3), ("too_large", 1)):
            assert now.count("datagrams_rejected", listener="headset", reason=reason) == times
        for _ in range(3):
            client.sendto(numbers, ("127.0.0.5", now.receive))
        assert now.router.stop(signal.SIGTERM) == 0


def is_stopped(process: int) -> bool:
    """Every thread of it."""
    states = (path.read_text().rpartition(")")[2].split()[0] for path in Path(f"/proc/{process}/task").glob("*/stat"))
    return set(states) == {"T"}


def test_what_was_sent_while_the_router_stood_still_is_stale(tmp_path: Path) -> None:
    with (
        scene(tmp_path, HEADSET + INBOUND) as now,
        RosPeer({"/gw/twist": "geometry_msgs/msg/Twist"}) as peer,
        udp("127.0.0.9") as client,
    ):
        text = json.dumps(WRAPPED_TWIST).encode()
        os.kill(now.router.process.pid, signal.SIGSTOP)
        wait_until(lambda: is_stopped(now.router.process.pid), "the stop")
        for _ in range(10):
            client.sendto(head("/gw/twist", "geometry_msgs/msg/Twist") + text, ("127.0.0.5", now.receive))
        time.sleep(1.0)
        os.kill(now.router.process.pid, signal.SIGCONT)
        stale = key("messages_dropped", route="headset", target="/gw/twist", reason="stale")
        wait_until(lambda: now.site.scrape()[stale] == 10, "the drops")
        client.sendto(head("/gw/twist", "geometry_msgs/msg/Twist") + text, ("127.0.0.5", now.receive))
        peer.receive()
        wait_until(lambda: now.count("messages_published", route="headset", topic="/gw/twist") == 1, "the count")
        assert peer.nothing_left()


@pytest.mark.parametrize("clients", [100])
def test_clients_that_never_read_are_counted_and_let_the_router_stop(tmp_path: Path, clients: int) -> None:
    with scene(tmp_path, OPEN) as now, ExitStack() as opened:
        now.speaker.open("/gw/word", "std_msgs/msg/String")
        wait_until(lambda: now.speaker.heard_by("/gw/word") > 0, "the subscription")
        stopped = [
            opened.enter_context(socket.create_connection(("127.0.0.5", now.port), PATIENCE)) for _ in range(clients)
        ]
        wait_until(lambda: now.site.samples()['gateway_clients{route="open"}'] == clients, "the clients")
        now.speaker.say("/gw/word", {"data": "x" * 20_000}, times=200)
        lag = 'gateway_client_lag_seconds{client="99",route="open"}'
        wait_until(lambda: now.site.samples()[lag] > 0, "a client that lags")
        for each in stopped[1:]:
            each.close()
        wait_until(lambda: now.site.samples()['gateway_clients{route="open"}'] == 1, "the clients to be gone")
        assert lag not in now.site.samples()
        assert now.router.stop(signal.SIGTERM) == 0
