"""Gateways of a running router, with ROS software in another process and clients on real sockets.

Most tests share one router with a gateway for each transport; each has topics of its own.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import zenoh
from backports import zstd

from router.gateway.latched import FRESH_S
from router.gateway.packets import unbatched
from tests.acceptance.gateway_clients import (
    Dashboard,
    Headset,
    Scene,
    head,
    lines,
    packet,
    scene,
    twist,
)
from tests.acceptance.payloads import generated, sample
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import key, total, udp, wait_until
from tests.repeating import repeating

SHOWN = """\
    topics: {include: ["/gw/**"], exclude: ["/gw/secret/**"]}
    discovery_period: 200ms
"""
HEADSET = f"""\
  headset:
    transport: {{udp: 127.0.0.9:HEADSET}}
    receive: 127.0.0.5:RECEIVE
{SHOWN}    publish_period: 100ms
    schema_period: 1s
"""
LOGGER = f"""\
  logger:
    transport: {{tcp: 127.0.0.5:LOGGER}}
    format: json_lines
{SHOWN}    publish_period: each
"""
ALL = f"""\
{HEADSET}    inbound: [{{topic: /gw/set, type: std_msgs/msg/Int32}}]
  packed:
    transport: {{udp: 127.0.0.9:PACKED}}
    receive: 127.0.0.5:ASK
{SHOWN}    publish_period: 100ms
    schema_period: 1h
    compression: {{zstd: 3}}
  batched:
    transport: {{udp: 127.0.0.9:BATCHED}}
{SHOWN}    publish_period: 100ms
    format: gateway_v2
    max_datagram: 1200B
  elsewhere:
    transport: {{udp: 127.0.0.9:ELSEWHERE}}
    receive: 192.0.2.1:RECEIVE
{SHOWN}{LOGGER}  dashboard:
    transport: {{websocket: 127.0.0.5:DASHBOARD}}
{SHOWN}    publish_period: 50ms
    inbound:
      - {{topic: /gw/cmd_vel, type: geometry_msgs/msg/Twist, ttl: 2s,
         deadman: {{timeout: 300ms, send: {{linear.x: -1.0}}, repeat: 100ms, at_start: silent}}}}
      - {{topic: gw/limited, type: std_msgs/msg/String, max_rate: 0.01 Hz}}
  earth:
    transport: {{zenoh: {{key: rovers/loki, listen: ["tcp/127.0.0.1:EARTH"]}}}}
{SHOWN}    publish_period: 50ms
    inbound: [{{topic: /gw/from_earth, type: std_msgs/msg/Int32}}]
"""
HEARD = {
    "/gw/set": "std_msgs/msg/Int32",
    "/gw/from_earth": "std_msgs/msg/Int32",
    "/gw/cmd_vel": "geometry_msgs/msg/Twist",
}


@pytest.fixture(scope="module")
def now(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    tcp, datagrams = "LOGGER DASHBOARD EARTH", "HEADSET RECEIVE PACKED ASK BATCHED ELSEWHERE"
    with scene(tmp_path_factory.mktemp("gateways"), ALL, tcp, datagrams, HEARD) as running:
        yield running


@pytest.fixture(scope="module")
def client(now: Scene) -> Iterator[Headset]:
    with udp("127.0.0.9", now.ports["HEADSET"]) as opened:
        yield Headset(opened)


def test_a_headset_gets_schemas_before_values_and_values_again_and_again(now: Scene, client: Headset) -> None:
    now.peer.open("/gw/secret/word", "std_msgs/msg/String")
    now.peer.open("/elsewhere", "std_msgs/msg/String")
    now.keep("/gw/point", "geometry_msgs/msg/Point", x=1.0, y=0.1, z=-0.0)
    value = client.wait_for("/gw/point")
    assert json.dumps(value, separators=(",", ":")) == '{"x":[1.0],"y":[0.1],"z":[-0.0]}'
    for _ in range(5):
        assert client.wait_for("/gw/point") == value
    assert client.early == []
    assert client.schemas["geometry_msgs/msg/Point"]["namespace"] == "geometry_msgs::msg"
    assert now.peer.heard_by("/gw/secret/word") == now.peer.heard_by("/elsewhere") == 0


def test_a_topic_that_goes_away_is_silent_and_comes_back_once(now: Scene, client: Headset) -> None:
    now.keep("/gw/gone", "std_msgs/msg/Bool", data=True)
    client.wait_for("/gw/gone")
    now.peer.close("/gw/gone")
    client.wait_for_silence("/gw/gone", 0.5)
    del client.schemas["std_msgs/msg/Bool"]
    now.peer.open("/gw/gone", "std_msgs/msg/Bool", reliable=False)
    client.wait_for("/gw/gone", partial(now.peer.say, "/gw/gone", {"data": False}), {"data": [False]})
    assert client.early == []
    client.catch_up()  # values that waited here would come at once
    before = time.monotonic()
    for _ in range(10):
        client.wait_for("/gw/gone")
    assert time.monotonic() - before > 0.7, "it is sent more than once in a period"


def test_qos_follows_the_publishers(now: Scene, client: Headset) -> None:
    now.keep("/gw/latched", "std_msgs/msg/Int32", data=1)  # before anybody listens
    assert client.wait_for("/gw/latched") == {"data": [1]}
    now.peer.open("/gw/lossy", "std_msgs/msg/Int32", reliable=False)
    client.wait_for("/gw/lossy", partial(now.peer.say, "/gw/lossy", {"data": 2}), {"data": [2]})
    now.peer.open("/gw/latched", "std_msgs/msg/Int32", reliable=False, name="another")
    client.wait_for("/gw/latched", partial(now.peer.say, "another", {"data": 3}), {"data": [3]})


def test_values_are_compressed_and_schemas_which_come_on_request_are_not(now: Scene) -> None:
    with udp("127.0.0.9", now.ports["PACKED"]) as opened, udp("127.0.0.9") as asking:
        client = Headset(opened)
        now.keep("/gw/packed", "std_msgs/msg/ByteMultiArray", data=[7] * 1000)
        value = client.wait_for("/gw/packed")
        assert value["data"] == [7] * 1000
        assert "/gw/packed" not in client.early
        client.schemas.clear()
        for _ in range(5):
            client.wait_for("/gw/packed")
        assert client.schemas == {}
        asking.sendto(head("", ""), ("127.0.0.5", now.ports["ASK"]))
        wait_until(lambda: bool(client.next() and client.schemas), "the schema")


def test_what_no_datagram_carries_is_counted_and_what_does_goes_on(now: Scene, client: Headset) -> None:
    lost = key("messages_dropped", route="headset", target="clients", reason="too_large")
    before = now.site.scrape()[lost]
    now.keep("/gw/long", "std_msgs/msg/String", data="x" * 70_000)
    now.keep("/gw/short", "std_msgs/msg/String", data="y")
    assert client.wait_for("/gw/short") == {"data": ["y"]}
    wait_until(lambda: now.site.scrape()[lost] == before + 1, "the drop")
    assert "use tcp, websocket or zenoh" in now.router.text()


def values(documents: Iterator[dict[str, Any]], topic: str) -> Iterator[Any]:
    return (line["data"]["data"] for line in documents if line["op"] == "data" and line["topic"] == topic)


def test_a_logger_gets_every_message_in_order(now: Scene) -> None:
    now.peer.open("/gw/number", "std_msgs/msg/Int32", keeps=True)
    now.await_subscription("/gw/number")
    with now.connect("LOGGER") as opened:
        received = lines(opened)
        now.await_clients("logger", 1)
        now.peer.say("/gw/number", *({"data": number} for number in range(100)))
        assert any(line["op"] == "schema" and line["type"] == "std_msgs/msg/Int32" for line in received)
        assert list(islice(values(received, "/gw/number"), 100)) == list(range(100))
        received.close()  # which has the socket open as well
    now.await_clients("logger", 0)


@pytest.mark.slow
def test_a_stopped_client_delays_nobody_and_gets_the_latest_values_when_it_goes_on(tmp_path: Path) -> None:
    with scene(tmp_path, LOGGER, "LOGGER") as now:
        now.peer.open("/gw/slow", "std_msgs/msg/String", keeps=True)
        now.await_subscription("/gw/slow")
        with now.connect("LOGGER") as slow, now.connect("LOGGER") as quick:
            now.await_clients("logger", 2)
            received = values(lines(quick), "/gw/slow")
            for number in range(400):
                now.peer.say("/gw/slow", {"data": f"{number} " + "x" * 60_000})
                assert next(received).startswith(f"{number} ")
            dropped = key("client_messages_dropped", route="logger", reason="superseded")
            wait_until(lambda: now.site.scrape()[dropped] > 0, "drops")
            assert any(lag > 0 for name, lag in now.site.samples().items() if name.startswith("gateway_client_lag"))
            assert any(word.startswith("399 ") for word in values(lines(slow), "/gw/slow"))


def test_a_dashboard_is_told_what_there_is_and_what_it_may_send(now: Scene) -> None:
    now.keep("/gw/shown", "geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
    now.await_subscription("/gw/shown")
    with Dashboard(now.ports["DASHBOARD"]) as client:
        inbound = client.next("inbound")["topics"]
        assert [each["topic"] for each in inbound] == ["/gw/cmd_vel", "/gw/limited"]
        assert inbound[0]["example"] == twist(0.0)
        assert client.next("data", topic="/gw/shown")["data"] == {"x": 1.0, "y": 2.0, "z": 3.0}
        topics = {each["topic"] for each in client.next("topics")["topics"]}
        assert "/gw/shown" in topics
        assert "/gw/secret/word" not in topics


def test_a_late_client_gets_schema_and_latest_value_at_once(now: Scene) -> None:
    now.peer.open("/gw/late", "geometry_msgs/msg/Point32")
    received = key("messages_received", route="dashboard", source="ros")
    before = now.site.scrape()[received]

    def taken() -> bool:
        now.peer.say("/gw/late", {"x": 7.0})
        return now.site.scrape()[received] > before

    wait_until(taken, "the subscription")
    with Dashboard(now.ports["DASHBOARD"]) as first, Dashboard(now.ports["DASHBOARD"]) as second:
        for client in (first, second):
            client.next("schema", type="geometry_msgs/msg/Point32")
            assert client.next("data", topic="/gw/late")["data"]["x"] == 7.0


def test_what_a_dashboard_may_send_is_published_and_its_silence_ends_in_the_deadman(now: Scene) -> None:
    with Dashboard(now.ports["DASHBOARD"]) as client:
        with repeating(lambda: client.ask(op="publish", topic="/gw/cmd_vel", data=twist(0.5), time=time.time())):
            assert now.peer.receive_on("/gw/cmd_vel") == twist(0.5)
        while now.peer.receive_on("/gw/cmd_vel") != twist(-1.0):
            pass
        assert now.peer.receive_on("/gw/cmd_vel") == twist(-1.0)
        assert now.count("deadman_trips", route="dashboard:/gw/cmd_vel") >= 1


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"topic": "/gw/other", "data": {}}, "not_allowed"),
    ({"topic": "/gw/cmd_vel", "type": "std_msgs/msg/String", "data": {}}, "wrong_type"),
    ({"topic": "/gw/cmd_vel", "data": twist(1.0)}, "invalid"),  # without a time, where there is a ttl
    ({"topic": "/gw/cmd_vel", "time": 1.0, "data": twist(1.0)}, "stale"),
    ({"topic": "/gw/limited", "data": {"data": 5}}, "invalid"),
    ({"topic": "/gw/limited", "data": {"data": "x", "more": 1}}, "invalid"),
    ({"topic": 5, "data": {}}, "malformed"),
]


def test_what_may_not_be_sent_is_refused_with_a_reason_and_counted(now: Scene) -> None:
    start = now.site.scrape()
    with Dashboard(now.ports["DASHBOARD"]) as client:
        for request, reason in REFUSED:
            metric = "messages_dropped" if reason == "stale" else "datagrams_rejected"
            before = total(now.site.scrape(), metric, reason=reason)
            client.ask(op="publish", **request)
            answer = client.next("rejected")
            assert answer["reason"] == reason
            assert answer["detail"]
            assert total(now.site.scrape(), metric, reason=reason) == before + 1
        limited = key("messages_published", route="dashboard", topic="/gw/limited")
        assert now.site.changes(start)[limited] == 0
        for _ in range(3):
            client.ask(op="publish", topic="/gw/limited", data={"data": "x"})
        assert [client.next("rejected")["reason"] for _ in range(2)] == ["rate_limited"] * 2
        assert now.site.changes(start)[limited] == 1


def test_a_headset_sends_what_it_receives_in(now: Scene) -> None:
    taken = key("messages_received", route="headset", source="clients")
    published = key("messages_published", route="headset", topic="/gw/set")
    before, router = now.site.scrape(), ("127.0.0.5", now.ports["RECEIVE"])
    with udp("127.0.0.9") as client, udp("127.0.0.8") as stranger:
        beginning = head("/gw/set", "std_msgs/msg/Int32")
        stranger.sendto(beginning + b'{"data":[1]}', router)
        client.sendto(beginning + b'{"data":2}', router)
        with repeating(lambda: client.sendto(beginning + b'{"data":[3]}', router)):
            assert now.peer.receive_on("/gw/set") == {"data": 3}
        client.sendto(head("/gw/set", "std_msgs/msg/Int32", 1) + zstd.compress(b'{"data":[4]}'), router)
        while (received := now.peer.receive_on("/gw/set")) == {"data": 3}:
            pass
        assert received == {"data": 4}
        # A message is counted as published when it is out, so the peer may have it before.
        wait_until(lambda: (counts := now.site.changes(before))[published] == counts[taken] > 0, "the last count")
        counts = now.site.changes(before)
        assert counts[key("datagrams_rejected", listener="headset", reason="source_mismatch")] == 1
        assert counts[key("datagrams_rejected", listener="headset", reason="invalid")] == 1
        assert counts[key("datagrams_received", listener="headset")] == counts[taken] + 2


def test_an_address_that_is_not_there_yet_is_waited_for(now: Scene) -> None:
    """All other gateways of this module run meanwhile."""
    assert f"192.0.2.1:{now.ports['RECEIVE']}" in now.router.text()


def test_small_messages_share_a_datagram_and_what_none_holds_is_dropped(now: Scene) -> None:
    dropped = key("messages_dropped", route="batched", target="clients", reason="too_large")
    before = now.site.scrape()[dropped]
    with udp("127.0.0.9", now.ports["BATCHED"]) as client:
        topics = {f"/gw/small/number_{number}" for number in range(20)}
        for number, topic in enumerate(topics):
            now.keep(topic, "std_msgs/msg/Int32", data=number)
        numbers, shared = set[str](), 0
        deadline = time.monotonic() + PATIENCE
        while len(numbers) < 20:
            assert time.monotonic() < deadline, f"no value of {sorted(topics - numbers)}"
            packets = unbatched(client.recv(65535))
            shared += len(packets) > 1
            found = [packet(each) for each in packets]
            assert len(packets) == 1 or all(len(each) <= 1200 for each in packets)
            numbers |= {topic for _, _, topic, _, payload in found if payload.startswith(b'{"data":[')} & topics
        assert shared
        now.keep("/gw/image", "std_msgs/msg/UInt8MultiArray", data=[7] * 100_000)
        wait_until(lambda: now.site.scrape()[dropped] == before + 1, "the drop")
        refused = [line for line in now.router.events("message dropped") if line["reason"] == "too_large"]
        assert all(line["detail"].endswith("use tcp, websocket or zenoh") for line in refused)


def test_a_message_of_two_megabytes_passes(now: Scene) -> None:
    numbers = [number / 7 for number in range(250_000)]
    now.peer.open("/gw/cloud", "std_msgs/msg/Float64MultiArray", keeps=True)
    now.await_subscription("/gw/cloud")
    with now.connect("LOGGER") as opened, Dashboard(now.ports["DASHBOARD"]) as dashboard:
        now.peer.say("/gw/cloud", {"data": numbers})
        received = lines(opened)
        for documents in (received, dashboard.documents()):
            assert next(values(documents, "/gw/cloud")) == numbers
        received.close()


@contextmanager
def earthling(now: Scene) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{now.ports["EARTH"]}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


def test_a_late_joiner_on_zenoh_gets_schema_and_latest_value_at_once_and_can_send(now: Scene) -> None:
    now.peer.open("/gw/word", "std_msgs/msg/String", keeps=True)
    now.await_subscription("/gw/word")
    now.peer.say("/gw/word", {"data": "latest"})
    wanted = {"rovers/loki/data/gw/word", "rovers/loki/schema/std_msgs/msg/String"}
    with earthling(now) as session:
        found: dict[str, bytes] = {}

        def asked() -> bool:
            for reply in session.get("rovers/loki/**"):
                found[str(reply.ok.key_expr)] = reply.ok.payload.to_bytes()
            return found.keys() >= wanted

        wait_until(asked, "the answers")
        word = packet(found["rovers/loki/data/gw/word"])
        assert word[2:] == ("/gw/word", "std_msgs/msg/String", b'{"data":["latest"]}')
        assert b'"namespace":"std_msgs::msg"' in found["rovers/loki/schema/std_msgs/msg/String"]
        heard: list[bytes] = []
        session.declare_subscriber("rovers/loki/data/**", lambda sample: heard.append(sample.payload.to_bytes()))
        with repeating(partial(now.peer.say, "/gw/word", {"data": "next"})):  # the router knows of it late
            wait_until(lambda: any(data.endswith(b'{"data":["next"]}') for data in heard), "the next value")
        put = head("/gw/from_earth", "std_msgs/msg/Int32") + b'{"data":[5]}'
        with repeating(partial(session.put, "rovers/loki/inbound/gw/from_earth", put)):
            assert now.peer.receive_on("/gw/from_earth") == {"data": 5}


KEPT = ["a", "b", "c", "d 2", "d 3", "d 4"]


def kept(documents: Iterator[dict[str, Any]], number: int) -> list[str]:
    """The next messages of /gw/kept."""
    return sorted(islice(values(documents, "/gw/kept"), number))


def answers(session: zenoh.Session, selector: str) -> list[str]:
    """The messages of /gw/kept that a query finds."""
    packets = [packet(reply.ok.payload.to_bytes()) for reply in session.get(selector)]
    found = [json.loads(payload) for _, _, topic, _, payload in packets if topic == "/gw/kept"]
    return sorted(value["data"][0] for value in found if "data" in value)


def test_a_late_client_gets_what_a_late_subscriber_of_ros_would(now: Scene, client: Headset) -> None:
    for name, depth in (("a", 1), ("b", 1), ("c", 1), ("d", 3)):
        now.peer.open("/gw/kept", "std_msgs/msg/String", keeps=True, name=name, depth=depth)
        texts = [f"{name} {number}" for number in range(5)] if depth > 1 else [f"old {name}", name]
        now.peer.say(name, *({"data": text} for text in texts))
    with Dashboard(now.ports["DASHBOARD"]) as dashboard, now.connect("LOGGER") as opened, earthling(now) as earth:
        logged = lines(opened)
        for documents in (dashboard.documents(), logged):
            found = set[str]()
            for text in values(documents, "/gw/kept"):  # some come as they are published
                found.add(text)
                if found >= {*KEPT}:
                    break
        for _ in range(2):
            with Dashboard(now.ports["DASHBOARD"]) as late:
                assert kept(late.documents(), len(KEPT)) == KEPT
            with now.connect("LOGGER") as late_logger:
                late_lines = lines(late_logger)
                assert kept(late_lines, len(KEPT)) == KEPT
                late_lines.close()
        time.sleep(0.2)
        dashboard.ask(op="schema", type="std_msgs/msg/String")
        assert kept(dashboard.documents(), len(KEPT)) == KEPT
        wait_until(lambda: answers(earth, "rovers/loki/**") == KEPT, "the answers")
        assert answers(earth, "rovers/loki/data/gw/kept/**") == KEPT
        for _ in range(2):  # it may have come at any time, and gets them with the schemas
            for text in KEPT:
                client.wait_for("/gw/kept", value={"data": [text]})
        now.peer.close("c")
        now.peer.close("d")
        time.sleep(FRESH_S)
        with Dashboard(now.ports["DASHBOARD"]) as late:
            assert kept(late.documents(), 2) == KEPT[:2]
        wait_until(lambda: answers(earth, "rovers/loki/**") == KEPT[:2], "what is still kept")
        logged.close()


def test_the_books_of_a_gateway_balance(now: Scene) -> None:
    """Last of those that share a router."""
    outcomes = ("messages_sent", "messages_filtered", "messages_dropped")
    for gateway in ("headset", "packed", "batched", "logger", "dashboard", "earth"):
        received = key("messages_received", route=gateway, source="ros")

        def balances(gateway: str = gateway, received: str = received) -> bool:
            counts = now.site.scrape()
            of_clients = sum(total(counts, metric, route=gateway, target="clients") for metric in outcomes)
            return of_clients == counts[received] > 100

        with repeating(partial(now.peer.say, "/gw/word", {"data": "more"})):  # fast tests made fewer
            wait_until(balances, f"the balance of {gateway}")


IMU_ONLY = """\
  dashboard:
    transport: {websocket: 127.0.0.5:DASHBOARD}
    topics: {include: [/imu_data]}
    publish_period: 50ms
    discovery_period: 1h
"""


@pytest.mark.slow
def test_what_only_the_router_publishes_is_filled_while_a_client_is_there(tmp_path: Path) -> None:
    imu = next(generated("imu_info")).datagram
    with scene(tmp_path, IMU_ONLY, "DASHBOARD") as now:
        send = partial(now.site.send, "sensor_board", imu)
        time.sleep(3)  # as long as it looks often, because it has just started
        filtered = key("messages_filtered", route="imu_info", target="imu_data")
        with repeating(send):  # a machine that is busy takes longer to start
            wait_until(lambda: now.site.scrape()[filtered] >= 10, "what nobody wants")
        with Dashboard(now.ports["DASHBOARD"]) as client, repeating(send):
            assert client.next("data")["topic"] == "/imu_data"


def test_of_what_only_the_router_publishes_each_period_has_the_newest_value_and_all_are_counted(tmp_path: Path) -> None:
    payload, sent = next(generated("imu_info")).payload, 0

    def send(to: Scene) -> None:
        nonlocal sent
        sent += 1
        payload.accel_x = sent
        to.site.send("sensor_board", sample("imu_info", payload).datagram)

    def counts(of: Scene) -> tuple[float, float]:
        found = of.site.scrape()
        published = found[key("messages_published", route="imu_info", topic="imu_data")]
        return published, found[key("messages_received", route="dashboard", source="ros")]

    gateway = IMU_ONLY.replace("50ms", "300ms")
    with scene(tmp_path, gateway, "DASHBOARD") as now, Dashboard(now.ports["DASHBOARD"]) as client:
        with repeating(partial(send, now), 0.005):
            values = [client.next("data")["data"]["accel_x"] for _ in range(3)]
            rates = [client.next("topics")["topics"][0]["rate"] for _ in range(3)]
        while values[-1] != sent:
            values.append(client.next("data")["data"]["accel_x"])
        assert values == sorted(values)
        assert rates[-1] > 10  # messages come much more often than values are sent
        wait_until(lambda: len({*counts(now)}) == 1, "the count of all that was published")
        assert counts(now)[0] > 2 * len(values)
