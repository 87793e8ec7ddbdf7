"""A gateway's topics and clients brought together: what is sent, what is counted, and what faults leave intact."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

import pytest
from backports import zstd

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.gateway.letters import QUICK
from router.gateway.packets import Packet, pack
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stage import Graph, Stage, program

STRING = "std_msgs/msg/String"
TCP = "transport: {tcp: 127.0.0.1:8600}, format: json_lines, publish_period: 20ms, discovery_period: 100ms"
EACH = TCP.replace("20ms", "each")
PATIENCE_S = 20.0


def cdr(text: str) -> bytes:
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


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
    age = time.time_ns() - stage.count("route_last_message_timestamp_seconds", "it")
    assert 0 <= age < 2 * PATIENCE_S * 1e9


@asynchronous
async def test_a_client_that_asks_for_schemas_too_often_is_told(tmp_path: Path) -> None:
    async with Stage(program(tmp_path, f"it: {{{TCP}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        for _ in range(2):
            played.service.received(played.client, b'{"op":"schema"}', 0)
        [answer] = [json.loads(frame.data) for frame in played.client.frames]
        assert (answer["op"], answer["reason"]) == ("rejected", "rate_limited")


@asynchronous
async def test_messages_that_are_not_small_are_read_in_order_though_many_come_at_once(tmp_path: Path) -> None:
    inbound = "inbound: [{topic: /said, type: std_msgs/msg/String}]"
    async with Stage(program(tmp_path, f"it: {{{TCP}, {inbound}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        words = [*(str(number) * QUICK for number in range(10)), "a short one does not overtake them"]
        for word in words:
            request = {"op": "publish", "topic": "/said", "data": {"data": word}}
            played.service.received(played.client, json.dumps(request).encode(), 0)
        await until(lambda: len(stage.published) == len(words))
        assert stage.published == [("/said", cdr(word)) for word in words]


TWO = "inbound: [{topic: /said, type: std_msgs/msg/String}, {topic: /set, type: std_msgs/msg/Int32}]"


def publish(topic: str, data: object, **others: object) -> bytes:
    return json.dumps({"op": "publish", "topic": topic, "data": {"data": data}, **others}).encode()


@asynchronous
async def test_a_large_message_holds_up_its_own_topic_and_no_other(tmp_path: Path) -> None:
    async with Stage(program(tmp_path, f"it: {{{TCP}, {TWO}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        for data in (publish("/said", "a" * 2 * QUICK), publish("/said", "b"), publish("/set", 1)):
            played.service.received(played.client, data, 0)
        assert [topic for topic, _ in stage.published] == ["/set"]
        played.service.received(played.client, publish("/said", 3), 0)  # which is nothing to keep in order
        assert stage.count("datagrams_rejected", "it", "invalid") == 1
        await until(lambda: len(stage.published) == 3)
        assert stage.published[1:] == [("/said", cdr("a" * 2 * QUICK)), ("/said", cdr("b"))]
        played.service.received(played.client, publish("/said", "c"), 0)
        assert stage.published[-1] == ("/said", cdr("c"))


@asynchronous
async def test_what_need_not_be_read_to_be_refused_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    long = "a" * 2 * QUICK
    refused = {
        "not_allowed": publish("/other", long),
        "wrong_type": publish("/said", long, type="std_msgs/msg/Int32"),
        "too_large": publish("/set", long),
        "malformed": b'{"op":"publish","data":"' + long.encode() + b'"}',
    }

    def read(letter: object, most: int) -> None:
        raise AssertionError("it was read")

    monkeypatch.setattr("router.gateway.letters.DocumentLetter.read", read)
    async with Stage(program(tmp_path, f"it: {{{TCP}, {TWO}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        for data in refused.values():
            played.service.received(played.client, data, 0)
        assert [json.loads(frame.data)["reason"] for frame in played.client.frames] == [*refused]
        assert [stage.count("datagrams_rejected", "it", reason) for reason in refused] == [1] * len(refused)


@asynchronous
async def test_of_a_frame_that_does_not_tell_its_size_only_what_its_topic_may_have_is_decompressed(
    tmp_path: Path,
) -> None:
    compressor = zstd.ZstdCompressor()
    payload = compressor.compress(b'{"data":[' + b" " * 100_000 + b"1]}") + compressor.flush()
    v1 = TCP.replace("json_lines", "gateway_v1")
    async with Stage(program(tmp_path, f"it: {{{v1}, {TWO}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        played.service.received(played.client, pack(Packet(1.0, True, "/set", "std_msgs/msg/Int32", payload)), 0)
        await until(lambda: stage.count("datagrams_rejected", "it", "too_large"))


@asynchronous
async def test_when_too_much_waits_to_be_read_the_rest_is_refused_and_its_client_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("router.gateway.reader.MOST_READING", 3 * QUICK)
    inbound = "inbound: [{topic: /said, type: std_msgs/msg/String}]"
    async with Stage(program(tmp_path, f"it: {{{TCP}, {inbound}}}"), Graph({})) as stage:
        played = stage.played["it"]
        await played.start()
        request = {"op": "publish", "topic": "/said", "data": {"data": "a" * QUICK}}
        for _ in range(5):
            played.service.received(played.client, json.dumps(request).encode(), 0)
        await until(lambda: len(stage.published) == 2)
        assert stage.count("datagrams_rejected", "it", "rate_limited") == 3
        assert [json.loads(frame.data)["reason"] for frame in played.client.frames] == ["rate_limited"] * 3


@asynchronous
async def test_whoever_sends_while_the_gateway_closes_leaves_no_task_behind(tmp_path: Path) -> None:
    inbound = "inbound: [{topic: /said, type: std_msgs/msg/String}]"
    async with Stage(program(tmp_path, f"it: {{{TCP}, {inbound}}}"), Graph({})) as stage:
        played, before = stage.played["it"], asyncio.all_tasks()
        await played.start()
        request = {"op": "publish", "topic": "/said", "data": {"data": "a" * 100_000}}
        played.transport.last_words = [json.dumps(request).encode()]
        await played.close()
        assert asyncio.all_tasks() == before
        assert (stage.published, stage.faults) == ([], [])
