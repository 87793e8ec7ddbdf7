"""A gateway's topics and clients brought together: what is sent, what is counted, and what faults leave intact."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from backports import zstd
from structlog.testing import capture_logs

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.clock import boottime_ns
from router.gateway import packets, subscriptions
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stage import Graph, Stage, program

STRING = "std_msgs/msg/String"
TCP = "transport: {tcp: 127.0.0.1:8600}, format: json_lines, publish_period: 20ms, discovery_period: 100ms"
EACH = TCP.replace("20ms", "each")
PATIENCE_S = 20.0


def cdr(text: str) -> bytes:
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


def publish(topic: str, data: object, **others: object) -> bytes:
    return json.dumps({"op": "publish", "topic": topic, "data": {"data": data}, **others}).encode()


@asynchronous
async def test_a_value_that_another_gateway_has_taken_comes_to_a_client_that_was_there_before(tmp_path: Path) -> None:
    graph = Graph({"/map": STRING})
    both = f"early: {{{TCP}}}, late: {{{TCP.replace('8600', '8601')}}}"
    async with Stage(program(tmp_path, both), graph) as stage:
        early, late = stage.played["early"], stage.played["late"]
        await early.start()
        await until(lambda: "/map" in graph.taps)
        graph.taps["/map"].put(cdr("a rover's world"))
        await until(lambda: early.client.values)
        await late.start()
        await until(lambda: late.client.values)
        assert [frame.is_schema for frame in late.client.frames] == [True, False]
        assert stage.count("messages_received", "late", "ros") == stage.count("messages_sent", "late", "clients") == 1


@asynchronous
async def test_a_fault_of_the_first_look_does_not_end_looking(tmp_path: Path) -> None:
    graph = Graph({"/map": STRING})
    graph.faults["names"] = RuntimeError("no")
    async with Stage(program(tmp_path, f"it: {{{TCP}}}"), graph) as stage:
        await stage.played["it"].start()
        await until(lambda: "/map" in graph.taps)
        assert [str(fault) for fault in stage.faults] == ["no"]


@asynchronous
async def test_a_topic_with_a_fault_keeps_no_other_from_being_served(tmp_path: Path) -> None:
    graph = Graph({"/bad": STRING, "/good": STRING})
    graph.faults["/bad"] = ArithmeticError("no")
    async with Stage(program(tmp_path, f"it: {{{TCP}}}"), graph) as stage:
        await stage.played["it"].start()
        await until(lambda: "/good" in graph.taps)
        assert stage.faults


@asynchronous
async def test_topics_beyond_the_limit_are_named_and_not_subscribed_and_a_named_topic_comes_first(
    tmp_path: Path,
) -> None:
    graph = Graph({f"/stranger/{number}": STRING for number in range(5)})
    limited = f"{TCP}, topics: {{include: ['/**', /wanted]}}, max_topics: 3"
    async with Stage(program(tmp_path, f"it: {{{limited}}}"), graph) as stage:
        with capture_logs() as logs:
            await stage.played["it"].start()
            await until(lambda: stage.count("gateway_topics", "it", "served") == 3)
        assert [*graph.taps] == ["/stranger/0", "/stranger/1", "/stranger/2"]
        assert stage.count("gateway_topics", "it", "over_limit") == 2
        [line] = [line for line in logs if line["log_level"] == "warning"]
        assert (line["not_served"], line["such_as"]) == (2, ["/stranger/3", "/stranger/4"])
        graph.topics |= {"/a_stranger": STRING, "/wanted": STRING}
        await until(lambda: stage.count("gateway_topics", "it", "over_limit") == 4)
        assert "/wanted" in graph.taps
        assert "/a_stranger" not in graph.taps  # those that are served stay
        graph.topics = {"/wanted": STRING}
        await until(lambda: stage.count("gateway_topics", "it", "served") == 1)
        assert stage.count("gateway_topics", "it", "over_limit") == 0


@asynchronous
async def test_memory_is_returned_once_after_many_topics_have_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    returned: list[int] = []
    graph = Graph({f"/stranger/{number}": STRING for number in range(150)})
    monkeypatch.setattr(subscriptions, "RETURN_S", 0.2)
    monkeypatch.setattr(subscriptions, "return_freed_memory", lambda: returned.append(len(graph.topics)))
    async with Stage(program(tmp_path, f"it: {{{TCP}}}"), graph) as stage:
        await stage.played["it"].start()
        await until(lambda: stage.count("gateway_topics", "it", "served") == 150)
        graph.topics.clear()
        await until(lambda: returned)
        await asyncio.sleep(0.3)
        assert returned == [0]


def test_freed_memory_between_blocks_in_use_is_returned() -> None:
    script = """
from router.gateway.subscriptions import return_freed_memory
from tests.gateway.transport_events import resident_kib
before = resident_kib()
blocks = [bytes(2000) for _ in range(50_000)]
kept = blocks[::100]
del blocks
held = resident_kib() - before
return_freed_memory()
assert held > 80_000 > 20_000 > resident_kib() - before, (held, resident_kib() - before)
"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(__file__).parents[2])


@asynchronous
async def test_what_comes_faster_than_each_can_be_handed_on_is_in_the_books(tmp_path: Path) -> None:
    graph = Graph({"/fast": STRING})
    async with Stage(program(tmp_path, f"it: {{{EACH}}}"), graph) as stage:
        await stage.played["it"].start()
        await until(lambda: "/fast" in graph.taps)
        graph.taps["/fast"].put(cdr("first"))
        await until(lambda: stage.played["it"].client.values)
        for _ in range(250):
            graph.taps["/fast"].put(cdr("more"))
        await until(lambda: stage.count("messages_dropped", "it", "clients", "overloaded"))
        assert stage.count("messages_received", "it", "ros") == 251
        assert stage.count("messages_sent", "it", "clients") == 101
        assert stage.count("messages_dropped", "it", "clients", "overloaded") == 150
    assert stage.count("messages_received", "it", "ros") == 251
    age = boottime_ns() - stage.count("route_silence_seconds", "it")
    assert 0 <= age < 2 * PATIENCE_S * 1e9


@asynchronous
async def test_small_messages_pass_a_large_one_that_is_being_converted(tmp_path: Path) -> None:
    graph = Graph({"/large": STRING, "/small": STRING})
    may_convert = threading.Event()
    async with Stage(program(tmp_path, f"it: {{{TCP}}}"), graph) as stage:
        played = stage.played["it"]
        await played.start()
        await until(lambda: len(graph.taps) == 2)
        stage.context.converting.submit(may_convert.wait)
        graph.taps["/large"].put(cdr("x" * 100_000))
        await until(lambda: stage.count("messages_received", "it", "ros") == 1)
        graph.taps["/small"].put(cdr("y"))
        await until(lambda: played.client.values)
        may_convert.set()
        await until(lambda: len(played.client.values) == 2)
        assert [frame.topic for frame in played.client.values] == ["/small", "/large"]


@asynchronous
async def test_a_client_that_asks_for_schemas_too_often_is_told(tmp_path: Path) -> None:
    async with Stage(program(tmp_path, f"it: {{{TCP}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        for _ in range(2):
            played.service.received(played.client, b'{"op":"schema"}', 0)
        [answer] = [json.loads(frame.data) for frame in played.client.frames]
        assert (answer["op"], answer["reason"]) == ("rejected", "rate_limited")


@pytest.mark.parametrize(
    ("transport", "told"), [("{tcp: 127.0.0.1:8600}, format: json_lines", 3), ("{zenoh: {key: a}}, format: json", 1)]
)
@asynchronous
async def test_a_client_is_told_why_a_command_was_rejected_and_a_network_not_more_often_than_it_is_bounded(
    tmp_path: Path, transport: str, told: int
) -> None:
    gateway = f"transport: {transport}, inbound: [{{topic: /said, type: {STRING}, ttl: 500ms}}]"
    async with Stage(program(tmp_path, f"it: {{{gateway}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        for data in (publish("/said", "x", time=time.time() - 2), publish("/said", 1, time=time.time()), b"{}"):
            played.service.received(played.client, data, time.time_ns())
        answers = [json.loads(frame.data) for frame in played.client.frames]
        assert [answer["reason"] for answer in answers] == ["stale", "invalid", "malformed"][:told]
        assert {answer["op"] for answer in answers} == {"rejected"}
        await asyncio.sleep(0.15)
        played.service.received(played.client, b"{}", time.time_ns())
        assert len(played.client.frames) == told + 1


TWO = "inbound: [{topic: /said, type: std_msgs/msg/String}, {topic: /set, type: std_msgs/msg/Int32}]"
TIMED = "inbound: [{topic: /said, type: std_msgs/msg/String, ttl: 500ms}]"


@pytest.mark.parametrize(
    ("said", "most"), [("", 64 << 10), ("max_message: 2kB,", 2000), ("max_message: 16MiB,", 1 << 20)]
)
@asynchronous
async def test_what_clients_send_is_bounded(tmp_path: Path, said: str, most: int) -> None:
    around = len(b'{"data":""}')

    async with Stage(program(tmp_path, f"it: {{{TCP}, {said} {TWO}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        for length in (most - around, most - around + 1):
            request = b'{"op":"publish","topic":"/said","data":{"data":"%b"}}' % (b"a" * length)
            played.service.received(played.client, request, 0)
        assert len(stage.published) == 1
        assert stage.count("datagrams_rejected", "it", "too_large") == 1


@pytest.mark.parametrize("topic", ["/other", "/set"])
@asynchronous
async def test_only_what_is_allowed_is_decompressed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topic: str
) -> None:
    asked: list[int] = []

    def decompress(data: bytes, most: int) -> bytes:
        asked.append(most)
        return packets.decompress(data, most)

    monkeypatch.setattr("router.gateway.inbound.decompress", decompress)
    compressor = zstd.ZstdCompressor()  # whose frame does not tell its size
    payload = compressor.compress(b'{"data":[' + b" " * 100_000 + b"1]}") + compressor.flush()

    v1 = TCP.replace("json_lines", "gateway_v1")
    async with Stage(program(tmp_path, f"it: {{{v1}, {TWO}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        packet = packets.pack(packets.Packet(1.0, True, topic, "std_msgs/msg/Int32", payload))
        played.service.received(played.client, packet, 0)
        reason = "not_allowed" if topic == "/other" else "too_large"
        assert stage.count("datagrams_rejected", "it", reason) == 1
        assert asked == ([] if topic == "/other" else [64 << 10])


@pytest.mark.parametrize(
    ("ahead", "waited", "counted"),
    [(0.0, 0.0, 0), (-0.2, 0.0, 0), (0.01, 0.0, 0), (1.0, 0.0, 1), (1.9, 0.0, 1), (0.0, 0.2, 0), (1.0, 0.2, 1)],
)
@asynchronous
async def test_a_clients_clock_that_is_ahead_is_counted_and_its_message_published(
    tmp_path: Path, ahead: float, waited: float, counted: int
) -> None:
    async with Stage(program(tmp_path, f"it: {{{TCP}, {TIMED}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        now = time.time_ns()
        arrived = now - int(waited * 1e9)
        with capture_logs() as lines:
            for _ in range(3):
                played.service.received(played.client, publish("/said", "a", time=now / 1e9 + ahead), arrived)
            await played.close()
        assert len(stage.published) == 3
        assert stage.count("gateway_client_clock_ahead", "it") == 3 * counted
        warnings = [line for line in lines if "clock" in line["event"]]
        assert [line.get("more") for line in warnings] == [None, 2][: 2 * counted]


@pytest.mark.parametrize("form", ["json_lines", "gateway_v1"])
@pytest.mark.parametrize(("lead", "most"), [("", 2.0), (", max_lead: 100ms", 0.1)])
@asynchronous
async def test_a_command_from_the_future_is_refused_so_that_nobody_can_keep_it(
    tmp_path: Path, form: str, lead: str, most: float
) -> None:
    inbound = TIMED.replace("ttl: 500ms", f"ttl: 500ms{lead}")
    async with Stage(program(tmp_path, f"it: {{{TCP.replace('json_lines', form)}, {inbound}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()

        def send(ahead: float) -> None:
            at = time.time() + ahead
            packet = packets.pack(packets.Packet(at, False, "/said", "std_msgs/msg/String", b'{"data":["a"]}'))
            request = publish("/said", "a", time=at) if form == "json_lines" else packet
            played.service.received(played.client, request, time.time_ns())

        send(most - 0.05)
        assert len(stage.published) == 1
        for ahead in (most + 5, 1e300):
            send(ahead)
        assert len(stage.published) == 1
        assert stage.count("datagrams_rejected", "it", "premature") == 2
        assert f"s in the future, and more than {most:g} s" in str(stage.reports[-1])


@pytest.mark.parametrize("limit", ["", ", ttl: {none: a light does no harm}"])
@asynchronous
async def test_a_time_without_a_ttl_is_not_looked_at(tmp_path: Path, limit: str) -> None:
    inbound = TIMED.replace(", ttl: 500ms", limit)
    async with Stage(program(tmp_path, f"it: {{{TCP}, {inbound}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        played.service.received(played.client, publish("/said", "a", time=time.time() + 60), time.time_ns())
        assert len(stage.published) == 1


@asynchronous
async def test_whoever_sends_while_the_gateway_closes_leaves_no_task_behind(tmp_path: Path) -> None:
    inbound = "inbound: [{topic: /said, type: std_msgs/msg/String}]"
    async with Stage(program(tmp_path, f"it: {{{TCP}, {inbound}}}"), Graph({})) as stage:
        played, before = stage.played["it"], asyncio.all_tasks()
        await played.start()
        played.transport.last_words = [publish("/said", "a" * 100_000), b'{"op":"schema"}']
        await played.close()
        assert asyncio.all_tasks() == before
        assert (stage.published, stage.faults) == ([], [])
