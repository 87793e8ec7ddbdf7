"""Gateways of a running router, with ROS software in other processes and clients on real sockets."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import zenoh
from backports import zstd
from websockets.sync.client import connect

from router.gateway.packets import unbatched
from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.ros_speaker import Speaker
from tests.acceptance.site import RouterProcess, Site, key, site, total, udp, wait_until
from tests.ports import free_port

HEAD = """\
version: 1
extends: {root}/tests/acceptance/patient.yaml
metrics:
  address: 127.0.0.1:{metrics}
listen:
  rover:
    address: 127.0.0.5:{listen}
endpoints:
{endpoints}gateways:
"""

HEADSET = """\
  headset:
    transport: {udp: 127.0.0.9:PORT}
    receive: 127.0.0.5:RECEIVE
    topics: {include: ["/gw/**"], exclude: ["/gw/secret/**"]}
    publish_period: 100ms
    schema_period: 1s
    discovery_period: 200ms
"""

LOGGER = """\
  logger:
    transport: {tcp: 127.0.0.5:PORT}
    format: json_lines
    topics: {include: ["/gw/**"]}
    publish_period: each
    discovery_period: 200ms
"""

DASHBOARD = """\
  dashboard:
    transport: {websocket: 127.0.0.5:PORT}
    topics: {include: ["/gw/**"]}
    publish_period: 50ms
    discovery_period: 200ms
    inbound:
      - {topic: /gw/cmd_vel, type: geometry_msgs/msg/Twist, ttl: 2s,
         deadman: {timeout: 300ms, send: {linear.x: -1.0}, repeat: 100ms, at_start: silent}}
      - {topic: gw/limited, type: std_msgs/msg/String, max_rate: 1 Hz}
"""


def packet(data: bytes) -> tuple[float, int, str, str, bytes]:
    """As the existing clients take it apart."""
    stamp, kind = struct.unpack_from("<dB", data)
    topic, type_name, payload = data[9:].split(b"\0", 2)
    return stamp, kind, topic.decode(), type_name.decode(), payload


class Headset:
    """The existing VR client, in what it expects: it drops data before the schema of its type."""

    def __init__(self, opened: socket.socket) -> None:
        self._opened = opened
        self.schemas: dict[str, Any] = {}
        self.early: list[str] = []

    def next(self) -> tuple[str, Any]:
        """Topic and data, or topic and None for a schema."""
        data = self._opened.recv(65535)
        assert len(data) >= 13
        stamp, kind, topic, type_name, payload = packet(data)
        assert abs(stamp - time.time()) < PATIENCE
        text = zstd.decompress(payload) if kind else payload
        value = json.loads(text)
        if {"name", "namespace", "fields"} <= value.keys():
            assert not kind
            self.schemas[type_name] = value
            return topic, None
        if type_name not in self.schemas:
            self.early.append(topic)
        return topic, value

    def wait_for(self, wanted: Callable[[str, Any], bool], meanwhile: Callable[[], None] = lambda: None) -> Any:
        """What is done `meanwhile` is done again and again."""
        deadline = time.monotonic() + PATIENCE
        self._opened.settimeout(0.1)
        while time.monotonic() < deadline:
            meanwhile()
            try:
                topic, value = self.next()
            except TimeoutError:
                continue
            if value is not None and wanted(topic, value):
                return value
        raise AssertionError("it never came")

    def silent_on(self, topic: str, seconds: float) -> bool:
        """Whether nothing of `topic` comes any more for so long, once what was under way has come."""
        deadline = time.monotonic() + PATIENCE
        quiet_since = time.monotonic()
        while time.monotonic() < deadline:
            self._opened.settimeout(seconds)
            try:
                if self.next()[0] == topic:
                    quiet_since = time.monotonic()
            except TimeoutError:
                return True
            if time.monotonic() - quiet_since > seconds:
                return True
        return False


@dataclass
class Scene:
    """A router with gateways, and ROS software that publishes."""

    site: Site
    router: RouterProcess
    speaker: Speaker
    port: int
    receive: int

    def count(self, metric: str, **labels: str) -> int:
        return self.site.scrape()[key(metric, **labels)]


@contextmanager
def scene(folder: Path, gateways: str) -> Iterator[Scene]:
    """`gateways` has the words PORT and RECEIVE where free ports are to be."""
    with site(folder) as place:
        port, receive = free_port("127.0.0.5", kind=socket.SOCK_STREAM), free_port("127.0.0.5")
        text = gateways.replace("PORT", str(port)).replace("RECEIVE", str(receive))
        table = place.table(HEAD + text.replace("{", "{{").replace("}", "}}"))
        with RouterProcess(folder, table) as router, Speaker() as speaker:
            yield Scene(place, router, speaker, port, receive)


@contextmanager
def headset(scene: Scene) -> Iterator[Headset]:
    with udp("127.0.0.9", scene.port) as opened:
        yield Headset(opened)


@contextmanager
def repeating(action: Callable[[], object]) -> Iterator[None]:
    """What is published before both sides of a topic know of each other is lost."""
    done = threading.Event()

    def repeat() -> None:
        while not done.wait(0.1):
            action()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def data_of(*topics: str) -> Callable[[str, Any], bool]:
    return lambda topic, _: topic in topics


def test_a_headset_gets_schemas_before_values_and_values_again_and_again(tmp_path: Path) -> None:
    with scene(tmp_path, HEADSET) as now, headset(now) as client:
        now.speaker.open("/gw/point", "geometry_msgs/msg/Point", keeps=True)
        now.speaker.open("/gw/secret/word", "std_msgs/msg/String")
        now.speaker.open("/elsewhere", "std_msgs/msg/String")
        now.speaker.say("/gw/point", {"x": 1.0, "y": 0.1, "z": -0.0})
        value = client.wait_for(data_of("/gw/point"))
        assert json.dumps(value, separators=(",", ":")) == '{"x":[1.0],"y":[0.1],"z":[-0.0]}'
        for _ in range(5):
            assert client.wait_for(data_of("/gw/point")) == value
        assert client.early == []
        assert client.schemas["geometry_msgs/msg/Point"]["namespace"] == "geometry_msgs::msg"
        assert now.speaker.heard_by("/gw/secret/word") == now.speaker.heard_by("/elsewhere") == 0


def test_a_topic_that_goes_away_is_silent_and_comes_back_once(tmp_path: Path) -> None:
    with scene(tmp_path, HEADSET) as now, headset(now) as client:
        now.speaker.open("/gw/word", "std_msgs/msg/String", keeps=True)
        now.speaker.say("/gw/word", {"data": "first"})
        client.wait_for(data_of("/gw/word"))
        now.speaker.close("/gw/word")
        assert client.silent_on("/gw/word", 1.0)
        client.schemas.clear()
        now.speaker.open("/gw/word", "std_msgs/msg/String", reliable=False)
        again = partial(now.speaker.say, "/gw/word", {"data": "second"})
        assert client.wait_for(data_of("/gw/word"), again) == {"data": ["second"]}
        assert client.early == []
        before = time.monotonic()
        for _ in range(10):
            client.wait_for(data_of("/gw/word"))
        assert time.monotonic() - before > 0.7, "it is sent more than once in a period"


def test_qos_follows_the_publishers(tmp_path: Path) -> None:
    with scene(tmp_path, HEADSET) as now, headset(now) as client:
        now.speaker.open("/gw/latched", "std_msgs/msg/Int32", keeps=True)
        now.speaker.say("/gw/latched", {"data": 1})  # before anybody listens
        now.speaker.open("/gw/lossy", "std_msgs/msg/Int32", reliable=False)
        assert client.wait_for(data_of("/gw/latched")) == {"data": [1]}
        again = partial(now.speaker.say, "/gw/lossy", {"data": 2})
        assert client.wait_for(data_of("/gw/lossy"), again) == {"data": [2]}
        now.speaker.open("/gw/latched", "std_msgs/msg/Int32", reliable=False, name="another")
        again = partial(now.speaker.say, "another", {"data": 3})
        assert client.wait_for(lambda topic, value: topic == "/gw/latched" and value == {"data": [3]}, again)


def test_values_are_compressed_and_schemas_are_not(tmp_path: Path) -> None:
    with scene(tmp_path, HEADSET + "    compression: {zstd: 3}\n") as now, headset(now) as client:
        now.speaker.open("/gw/word", "std_msgs/msg/String", keeps=True)
        now.speaker.say("/gw/word", {"data": "x" * 1000})
        assert client.wait_for(data_of("/gw/word")) == {"data": ["x" * 1000]}
        assert client.early == []


def test_what_no_datagram_carries_is_counted_and_what_does_goes_on(tmp_path: Path) -> None:
    with scene(tmp_path, HEADSET) as now, headset(now) as client:
        now.speaker.open("/gw/long", "std_msgs/msg/String", keeps=True)
        now.speaker.open("/gw/short", "std_msgs/msg/String", keeps=True)
        now.speaker.say("/gw/long", {"data": "x" * 70_000})
        now.speaker.say("/gw/short", {"data": "y"})
        assert client.wait_for(data_of("/gw/short")) == {"data": ["y"]}
        lost = key("messages_dropped", route="headset", target="clients", reason="too_large")
        wait_until(lambda: now.site.scrape()[lost] == 1, "the drop")
        assert "use tcp, websocket or zenoh" in now.router.text()


def lines(opened: socket.socket) -> Generator[dict[str, Any], None, None]:
    with opened.makefile("r", encoding="utf-8") as text:
        for line in text:
            yield json.loads(line)


def test_a_logger_gets_every_message_in_order(tmp_path: Path) -> None:
    with scene(tmp_path, LOGGER) as now:
        now.speaker.open("/gw/number", "std_msgs/msg/Int32", keeps=True)
        wait_until(lambda: now.speaker.heard_by("/gw/number") > 0, "the subscription")
        with socket.create_connection(("127.0.0.5", now.port), PATIENCE) as opened:
            received = lines(opened)
            wait_until(lambda: now.site.samples()['gateway_clients{route="logger"}'] == 1, "the client")
            for number in range(100):
                now.speaker.say("/gw/number", {"data": number})
            assert next(received)["op"] == "schema"
            assert [next(received)["data"] for _ in range(100)] == [{"data": number} for number in range(100)]
            received.close()  # which has the socket open as well
        wait_until(lambda: now.site.samples()['gateway_clients{route="logger"}'] == 0, "the client to be gone")


def test_a_stopped_client_delays_nobody_and_gets_the_latest_values_when_it_goes_on(tmp_path: Path) -> None:
    with scene(tmp_path, LOGGER) as now:
        now.speaker.open("/gw/word", "std_msgs/msg/String", keeps=True)
        wait_until(lambda: now.speaker.heard_by("/gw/word") > 0, "the subscription")
        with (
            socket.create_connection(("127.0.0.5", now.port), PATIENCE) as slow,
            socket.create_connection(("127.0.0.5", now.port), PATIENCE) as quick,
        ):
            wait_until(lambda: now.site.samples()['gateway_clients{route="logger"}'] == 2, "the clients")
            received = lines(quick)
            for number in range(400):
                now.speaker.say("/gw/word", {"data": f"{number} " + "x" * 60_000})
                while (line := next(received))["op"] != "data":
                    pass
                assert line["data"]["data"].startswith(f"{number} ")
            dropped = key("client_messages_dropped", route="logger", reason="superseded")
            wait_until(lambda: now.site.scrape()[dropped] > 0, "drops")
            assert any(lag > 0 for name, lag in now.site.samples().items() if name.startswith("gateway_client_lag"))
            for line in lines(slow):
                if line["op"] == "data" and line["data"]["data"].startswith("399 "):
                    break


class Dashboard:
    """A client of the websocket gateway."""

    def __init__(self, scene: Scene) -> None:
        self._connecting = connect(
            f"ws://127.0.0.5:{scene.port}/", open_timeout=PATIENCE, close_timeout=1, max_size=None
        )
        self._documents = self.documents()

    def __enter__(self) -> Dashboard:
        self._connection = self._connecting.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._connecting.__exit__(None, None, None)

    def documents(self) -> Generator[dict[str, Any], None, None]:
        while True:
            text = self._connection.recv(timeout=PATIENCE)
            assert isinstance(text, str)
            yield from map(json.loads, text.split("\n"))

    def next(self, op: str) -> dict[str, Any]:
        return next(document for document in self._documents if document["op"] == op)

    def publish(self, topic: str, data: object, **others: object) -> None:
        self._connection.send(json.dumps({"op": "publish", "topic": topic, "data": data, **others}))

    def ask(self, **document: object) -> None:
        self._connection.send(json.dumps(document))


def twist(x: float) -> dict[str, Any]:
    return {"linear": {"x": x, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}


def test_a_dashboard_is_told_what_there_is_and_what_it_may_send(tmp_path: Path) -> None:
    with scene(tmp_path, DASHBOARD) as now:
        now.speaker.open("/gw/point", "geometry_msgs/msg/Point", keeps=True)
        now.speaker.say("/gw/point", {"x": 1.0, "y": 2.0, "z": 3.0})
        wait_until(lambda: now.speaker.heard_by("/gw/point") > 0, "the subscription")
        with Dashboard(now) as client:
            inbound = client.next("inbound")["topics"]
            assert [each["topic"] for each in inbound] == ["/gw/cmd_vel", "/gw/limited"]
            assert inbound[0]["example"] == twist(0.0)
            assert client.next("data")["data"] == {"x": 1.0, "y": 2.0, "z": 3.0}
            assert [each["topic"] for each in client.next("topics")["topics"]] == ["/gw/point"]


def test_a_late_client_gets_schema_and_latest_value_at_once(tmp_path: Path) -> None:
    with scene(tmp_path, DASHBOARD) as now:
        now.speaker.open("/gw/point", "geometry_msgs/msg/Point")
        received = key("messages_received", route="dashboard", source="ros")
        while now.site.scrape()[received] == 0:  # what is said before both sides know of each other is lost
            now.speaker.say("/gw/point", {"x": 7.0})
            time.sleep(0.1)
        with Dashboard(now) as first, Dashboard(now) as second:
            for client in (first, second):
                assert client.next("schema")["type"] == "geometry_msgs/msg/Point"
                assert client.next("data")["data"]["x"] == 7.0


def test_what_a_dashboard_may_send_is_published_and_its_silence_ends_in_the_deadman(tmp_path: Path) -> None:
    with (
        scene(tmp_path, DASHBOARD) as now,
        RosPeer({"/gw/cmd_vel": "geometry_msgs/msg/Twist"}) as peer,
        Dashboard(now) as client,
    ):
        with repeating(lambda: client.publish("/gw/cmd_vel", twist(0.5), time=time.time())):
            received = [peer.receive()]
        while received[-1] != ("/gw/cmd_vel", twist(-1.0)):
            received.append(peer.receive())
        assert received[:-1] == [("/gw/cmd_vel", twist(0.5))] * (len(received) - 1) != []
        assert peer.receive() == ("/gw/cmd_vel", twist(-1.0))
        assert now.count("deadman_trips", route="dashboard:/gw/cmd_vel") == 1


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        ({"topic": "/gw/other", "data": {}}, "not_allowed"),
        ({"topic": "/gw/cmd_vel", "type": "std_msgs/msg/String", "data": {}}, "wrong_type"),
        ({"topic": "/gw/cmd_vel", "data": twist(1.0)}, "invalid"),  # without a time, where there is a ttl
        ({"topic": "/gw/cmd_vel", "time": 1.0, "data": twist(1.0)}, "stale"),
        ({"topic": "/gw/limited", "data": {"data": 5}}, "invalid"),
        ({"topic": "/gw/limited", "data": {"data": "x", "more": 1}}, "invalid"),
        ({"topic": 5, "data": {}}, "malformed"),
    ],
)
def test_what_may_not_be_sent_is_refused_with_a_reason_and_counted(
    refusing: tuple[Scene, Dashboard], request_: dict[str, Any], reason: str
) -> None:
    now, client = refusing
    metric = "messages_dropped" if reason == "stale" else "datagrams_rejected"
    before = total(now.site.scrape(), metric, reason=reason)
    client.ask(op="publish", **request_)
    answer = client.next("rejected")
    assert answer["reason"] == reason
    assert answer["detail"]
    assert total(now.site.scrape(), metric, reason=reason) == before + 1
    assert total(now.site.scrape(), "messages_published", route="dashboard") == 0


@pytest.fixture(scope="module")
def refusing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Scene, Dashboard]]:
    with scene(tmp_path_factory.mktemp("refusing"), DASHBOARD) as now, Dashboard(now) as client:
        yield now, client


def test_more_often_than_max_rate_is_refused(tmp_path: Path) -> None:
    with scene(tmp_path, DASHBOARD) as now, Dashboard(now) as client:
        for _ in range(3):
            client.publish("/gw/limited", {"data": "x"})
        assert client.next("rejected")["reason"] == "rate_limited"
        assert client.next("rejected")["reason"] == "rate_limited"
        assert now.count("messages_published", route="dashboard", topic="/gw/limited") == 1


INBOUND = """\
    inbound:
      - {topic: /gw/set, type: std_msgs/msg/Int32}
"""


def test_a_headset_sends_what_it_receives_in(tmp_path: Path) -> None:
    with (
        scene(tmp_path, HEADSET + INBOUND) as now,
        RosPeer({"/gw/set": "std_msgs/msg/Int32"}) as peer,
        udp("127.0.0.9") as client,
        udp("127.0.0.8") as stranger,
    ):
        head = struct.pack("<dB", time.time(), 0) + b"/gw/set\0std_msgs/msg/Int32\0"
        stranger.sendto(head + b'{"data":[1]}', ("127.0.0.5", now.receive))
        client.sendto(head + b'{"data":2}', ("127.0.0.5", now.receive))
        valid = head + b'{"data":[3]}'
        with repeating(lambda: client.sendto(valid, ("127.0.0.5", now.receive))):
            assert peer.receive() == ("/gw/set", {"data": 3})
        compressed = struct.pack("<dB", time.time(), 1) + b"/gw/set\0std_msgs/msg/Int32\0"
        client.sendto(compressed + zstd.compress(b'{"data":[4]}'), ("127.0.0.5", now.receive))
        while (received := peer.receive()) == ("/gw/set", {"data": 3}):
            pass
        assert received == ("/gw/set", {"data": 4})
        taken = key("messages_received", route="headset", source="clients")
        published = key("messages_published", route="headset", topic="/gw/set")
        # A message is counted as published when it is out, so the peer may have it before.
        wait_until(lambda: (counts := now.site.scrape())[published] == counts[taken], "the count of the last message")
        counts = now.site.scrape()
        assert counts[key("datagrams_rejected", listener="headset", reason="source_mismatch")] == 1
        assert counts[key("datagrams_rejected", listener="headset", reason="invalid")] == 1
        assert counts[key("datagrams_received", listener="headset")] == counts[taken] + 2
        assert counts[published] == counts[taken]


def test_schemas_come_on_request(tmp_path: Path) -> None:
    table = HEADSET.replace("schema_period: 1s", "schema_period: 1h")
    with scene(tmp_path, table) as now, headset(now) as client:
        now.speaker.open("/gw/word", "std_msgs/msg/String", keeps=True)
        now.speaker.say("/gw/word", {"data": "x"})
        client.wait_for(data_of("/gw/word"))
        client.schemas.clear()
        for _ in range(5):
            client.wait_for(data_of("/gw/word"))
        assert client.schemas == {}
        with udp("127.0.0.9") as asking:
            asking.sendto(struct.pack("<dB", time.time(), 0) + b"\0\0", ("127.0.0.5", now.receive))
            wait_until(lambda: bool(client.next() and client.schemas), "the schema")


def test_an_address_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    missing = HEADSET.replace("127.0.0.5:RECEIVE", "192.0.2.1:RECEIVE")
    with scene(tmp_path, missing + LOGGER.replace("PORT", "RECEIVE")) as now:
        assert "192.0.2.1" in now.router.text()
        with socket.create_connection(("127.0.0.5", now.receive), PATIENCE):
            wait_until(lambda: now.site.samples()['gateway_clients{route="logger"}'] == 1, "the client")


def test_an_address_that_another_has_ends_the_start(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.5", 0)) as other, site(tmp_path) as place:
        text = LOGGER.replace("PORT", str(other.getsockname()[1])).replace("{", "{{").replace("}", "}}")
        table = place.table(HEAD + text)
        router = RouterProcess(tmp_path, table)
        assert router.wait() == 78
        assert "logger" in router.text()
        assert "table.yaml:" in router.text()


def test_the_books_of_a_gateway_balance(tmp_path: Path) -> None:
    with scene(tmp_path, HEADSET) as now, headset(now) as client:
        now.speaker.open("/gw/number", "std_msgs/msg/Int32", keeps=True)
        now.speaker.say("/gw/number", {"data": -1})
        client.wait_for(data_of("/gw/number"))  # both sides know of each other: what comes now is announced one by one
        received = key("messages_received", route="headset", source="ros")
        before = now.site.scrape()[received]
        for number in range(90):
            now.speaker.say("/gw/number", {"data": number})
        client.wait_for(lambda topic, value: topic == "/gw/number" and value == {"data": [89]})
        wait_until(lambda: now.site.scrape()[received] == before + 90, "the last message")
        counts = now.site.scrape()
        outcomes = ("messages_sent", "messages_filtered", "messages_dropped")
        of_clients = sum(total(counts, metric, route="headset", target="clients") for metric in outcomes)
        assert of_clients == before + 90


IMU_ONLY = """\
  dashboard:
    transport: {websocket: 127.0.0.5:PORT}
    topics: {include: [/imu_data]}
    publish_period: 50ms
    discovery_period: 1h
"""


@pytest.mark.slow
def test_what_only_the_router_publishes_is_filled_while_a_client_is_there(tmp_path: Path) -> None:
    imu = next(generated("imu_info")).datagram
    with scene(tmp_path, IMU_ONLY) as now:
        send = partial(now.site.send, "sensor_board", imu)
        time.sleep(3)  # as long as it looks often, because it has just started
        for _ in range(10):
            send()
        filtered = key("messages_filtered", route="imu_info", target="imu_data")
        wait_until(lambda: now.site.scrape()[filtered] == 10, "what nobody wants")
        with Dashboard(now) as client, repeating(send):
            assert client.next("data")["topic"] == "/imu_data"


BATCHING = """\
    format: gateway_v2
    max_datagram: 1200B
"""


def test_small_messages_share_a_datagram_and_what_none_holds_is_dropped(tmp_path: Path) -> None:
    with scene(tmp_path, HEADSET + BATCHING) as now, udp("127.0.0.9", now.port) as client:
        for number in range(20):
            now.speaker.open(f"/gw/number_{number}", "std_msgs/msg/Int32", keeps=True)
            now.speaker.say(f"/gw/number_{number}", {"data": number})
        now.speaker.open("/gw/image", "std_msgs/msg/UInt8MultiArray", keeps=True)
        now.speaker.say("/gw/image", {"data": [7] * 2_000_000})
        numbers, shared = set[str](), 0
        while len(numbers) < 20:
            packets = unbatched(client.recv(65535))
            shared += len(packets) > 1
            found = [packet(each) for each in packets]
            assert len(packets) == 1 or all(len(each) <= 1200 for each in packets)
            numbers |= {topic for _, _, topic, _, payload in found if payload.startswith(b'{"data":[')}
        assert shared
        dropped = key("messages_dropped", route="headset", target="clients", reason="too_large")
        wait_until(lambda: now.site.scrape()[dropped] == 1, "the drop")
        [detail] = [line["detail"] for line in now.router.events("message dropped") if line["reason"] == "too_large"]
        assert detail.endswith("use tcp, websocket or zenoh")


@pytest.mark.parametrize("gateway", [LOGGER, DASHBOARD], ids=["tcp", "websocket"])
def test_a_message_of_two_megabytes_passes(tmp_path: Path, gateway: str) -> None:
    numbers = [number / 7 for number in range(250_000)]
    with scene(tmp_path, gateway.replace("each", "5ms")) as now, ExitStack() as opened:
        now.speaker.open("/gw/cloud", "std_msgs/msg/Float64MultiArray", keeps=True)
        now.speaker.open("/gw/number", "std_msgs/msg/Int32", keeps=True)
        wait_until(lambda: now.speaker.heard_by("/gw/cloud") * now.speaker.heard_by("/gw/number") > 0, "both")
        if gateway is LOGGER:
            connection = opened.enter_context(socket.create_connection(("127.0.0.5", now.port), PATIENCE))
            documents = lines(connection)
        else:
            documents = opened.enter_context(Dashboard(now)).documents()
        now.speaker.say("/gw/cloud", {"data": numbers})
        now.speaker.say("/gw/number", {"data": 1})
        came = list(islice(filter(_is_data, documents), 2))
        assert {document["topic"]: document["data"]["data"] for document in came} == {
            "/gw/number": 1,
            "/gw/cloud": numbers,
        }
        documents.close()


def _is_data(document: dict[str, Any]) -> bool:
    return bool(document["op"] == "data")


ZENOH = """\
  earth:
    transport: {zenoh: {key: rovers/loki, listen: ["tcp/127.0.0.1:PORT"]}}
    topics: {include: ["/gw/**"]}
    publish_period: 50ms
    discovery_period: 200ms
    inbound: [{topic: /gw/set, type: std_msgs/msg/Int32}]
"""


def test_a_late_joiner_on_zenoh_gets_schema_and_latest_value_at_once_and_can_send(tmp_path: Path) -> None:
    with scene(tmp_path, ZENOH) as now, RosPeer({"/gw/set": "std_msgs/msg/Int32"}) as peer:
        now.speaker.open("/gw/word", "std_msgs/msg/String", keeps=True)
        wait_until(lambda: now.speaker.heard_by("/gw/word") > 0, "the subscription")
        now.speaker.say("/gw/word", {"data": "latest"})
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{now.port}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        with zenoh.open(config) as session:
            found: dict[str, bytes] = {}

            def asked() -> bool:
                for reply in session.get("rovers/loki/**"):
                    found[str(reply.ok.key_expr)] = reply.ok.payload.to_bytes()
                return len(found) == 2

            wait_until(asked, "the answers")
            assert packet(found["rovers/loki/data/gw/word"])[2:] == (
                "/gw/word",
                "std_msgs/msg/String",
                b'{"data":["latest"]}',
            )
            assert b'"namespace":"std_msgs::msg"' in found["rovers/loki/schema/std_msgs/msg/String"]
            heard: list[bytes] = []
            session.declare_subscriber("rovers/loki/data/**", lambda sample: heard.append(sample.payload.to_bytes()))
            with repeating(partial(now.speaker.say, "/gw/word", {"data": "next"})):  # the router knows of it late
                wait_until(lambda: any(data.endswith(b'{"data":["next"]}') for data in heard), "the next value")
            head = struct.pack("<dB", time.time(), 0) + b"/gw/set\0std_msgs/msg/Int32\0"
            put = partial(session.put, "rovers/loki/inbound/gw/set", head + b'{"data":[5]}')
            with repeating(put):
                assert peer.receive() == ("/gw/set", {"data": 5})
