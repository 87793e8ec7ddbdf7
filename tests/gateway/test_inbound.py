"""What a client's message does once it is checked."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.clock import monotonic_ns, wall_ns
from router.gateway.encoding import ENCODINGS
from router.gateway.inbound import InboundOutputs, InboundPublisher, RefusedError
from router.gateway.packets import Packet, pack
from router.library import load
from tests.gateway.stage import program

STRING = "std_msgs/msg/String"
GATEWAY = """it: {transport: {tcp: 127.0.0.1:8600}, format: json_lines, inbound: [
  {topic: /light, type: std_msgs/msg/String, ttl: 10s, deadman: {timeout: 10s, send: {}}}]}"""


class MiddlewareError(Exception):
    pass


def test_a_message_feeds_the_deadman_once_it_is_published_and_one_that_fails_does_not(tmp_path: Path) -> None:
    made = program(tmp_path, GATEWAY)
    [plan] = made.gateways
    done, fails = list[str](), False

    def publish(_: bytes) -> None:
        if fails:
            raise MiddlewareError("no room")
        done.append("published")

    [guarded] = [each.deadman for each in plan.inbound.values()]
    assert guarded is not None
    outputs = InboundOutputs(
        library=load(),
        publish=dict.fromkeys(plan.inbound, publish),
        publish_errors=(MiddlewareError,),
        feed_deadman={guarded.route: lambda _: done.append("fed")},
        report=lambda _: None,
        clock_ns=monotonic_ns,
        wall_ns=wall_ns,
    )
    encoding = ENCODINGS[plan.settings.format](plan.settings)
    publisher = InboundPublisher(plan, encoding, made.counters, made.counters.fresh_counts(), outputs)

    def receive() -> None:
        request = {"op": "publish", "topic": "/light", "time": wall_ns() / 1e9, "data": {"data": "on"}}
        publisher.receive(json.dumps(request).encode(), wall_ns())

    receive()
    assert done == ["published", "fed"]
    fails = True
    with pytest.raises(RefusedError, match="no room"):
        receive()
    assert done == ["published", "fed"]


UDP = "udp: 127.0.0.1:8600}, receive: 127.0.0.1:8601"
PACKETS = {"gateway_v1": UDP, "gateway_v2": UDP}
DOCUMENTS = {"json_lines": "tcp: 127.0.0.1:8600}", "json": "websocket: 127.0.0.1:8600}"}
BROKEN = ['{"data":', '{"data":"on"} x', '{"data":NaN}', '{"data":"a\nb"}', "on", '{"x":' + "[" * 10_000]
WRONG = ['{"data":5}', "{}", "[]", '{"data":"on","more":1}', '{"data":1e999}']


@pytest.mark.parametrize("form", [*DOCUMENTS, *PACKETS])
@pytest.mark.parametrize(("texts", "reason"), [(BROKEN, "malformed"), (WRONG, "invalid")])
def test_what_is_no_json_is_malformed_in_every_format(tmp_path: Path, form: str, texts: list[str], reason: str) -> None:
    inbound = f"inbound: [{{topic: /light, type: {STRING}}}]"
    made = program(tmp_path, f"it: {{transport: {{{(DOCUMENTS | PACKETS)[form]}, format: {form}, {inbound}}}")
    [plan] = made.gateways
    outputs = InboundOutputs(load(), {}, (), {}, lambda _: None, monotonic_ns, wall_ns)
    encoding = ENCODINGS[plan.settings.format](plan.settings)
    publisher = InboundPublisher(plan, encoding, made.counters, made.counters.fresh_counts(), outputs)
    for text in texts:
        document = f'{{"op":"publish","topic":"/light","data":{text}}}'
        packet = pack(Packet(0.0, False, "/light", STRING, text.replace('"on"', '["on"]').encode()))
        with pytest.raises(RefusedError) as refused:
            publisher.receive(packet if form in PACKETS else document.encode(), wall_ns())
        assert refused.value.reason == reason, (text, refused.value)
