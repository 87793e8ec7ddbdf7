"""A router whose table has `gateways` only, in a process of its own, and its reload."""

from __future__ import annotations

import json
import signal
import socket
import urllib.request
from functools import partial
from pathlib import Path

from router.tools.running_router import post
from tests.acceptance.gateway_clients import lines
from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.site import RouterProcess, key, site, total, udp, wait_until
from tests.ports import free_port
from tests.repeating import repeating
from tests.tables import PROTOS

ONLY = """\
version: 1
http: {address: 127.0.0.1:METRICS}
foxglove: {address: 127.0.0.1:FOXGLOVE}
record: {directory: recordings, last: 10s}
node: {diagnostics: true}
gateways:
  logger: {transport: {tcp: 127.0.0.5:PORT}, format: json_lines, topics: {include: ["/gw/**"]},
           publish_period: each, discovery_period: 200ms}
"""
ROUTES = f"""\
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: 127.0.0.5:LISTEN}}}}
routes:
  imu_info: {{source: any, topics: [{{topic: gw/imu, type: comms/msg/ImuSensorInformation, fields: auto}}]}}
"""
IMU = sample("imu_info", WIRE.envelopes.first.cases["imu_info"].message_class(accel_x=1.5)).datagram


def asked(port: int, path: str) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=PATIENCE) as answer:
        return str(answer.read().decode())


def test_a_reload_gives_it_its_first_routes_and_takes_them_away_again(tmp_path: Path) -> None:
    with site(tmp_path, {}) as place, udp("127.0.0.30") as board, RosPeer() as peer:
        port = free_port("127.0.0.5", kind=socket.SOCK_STREAM)
        ports = {"METRICS": place.metrics, "FOXGLOVE": free_port(kind=socket.SOCK_STREAM), "PORT": port}
        only, routes = ONLY, ROUTES.replace("LISTEN", str(place.listen))
        for word, number in ports.items():
            only = only.replace(word, str(number))
        table = tmp_path / "table.yaml"
        table.write_text(only)
        peer.open("/gw/word", "std_msgs/msg/String", keeps=True)
        peer.say("/gw/word", {"data": "before"})
        peer.open("/elsewhere", "std_msgs/msg/String")
        with (
            RouterProcess(tmp_path, table) as router,
            socket.create_connection(("127.0.0.5", port), PATIENCE) as opened,
        ):
            received = (line for line in lines(opened) if line["op"] == "data")
            assert next(received)["data"] == {"data": "before"}
            assert peer.heard_by("/elsewhere") == 0
            assert asked(place.metrics, "/ready").strip() == "ready"
            assert json.loads(asked(place.metrics, "/status.json"))["routes"].keys() == {"logger"}
            assert total(place.scrape(), "datagrams_received") == total(place.scrape(), "unhandled") == 0

            table.write_text(only + routes)
            assert post(f"http://127.0.0.1:{place.metrics}", "/-/reload").ok
            with repeating(partial(board.sendto, IMU, ("127.0.0.5", place.listen))):
                imu = next(line for line in received if line["topic"] == "/gw/imu")
            assert imu["data"]["accel_x"] == 1.5
            assert "imu_info" in json.loads(asked(place.metrics, "/status.json"))["routes"]

            table.write_text(only)
            assert post(f"http://127.0.0.1:{place.metrics}", "/-/reload").ok
            assert asked(place.metrics, "/ready").strip() == "ready"
            with udp("127.0.0.5", place.listen):
                pass  # nobody has it any more
            saved = Path(post(f"http://127.0.0.1:{place.metrics}", "/record/save").body["file"])
            assert saved.stat().st_size > 0
            peer.say("/gw/word", {"data": "after"})
            assert next(line for line in received if line["topic"] == "/gw/word")["data"] == {"data": "after"}
            accepted = key("messages_received", route="imu_info", source="unknown")
            wait_until(lambda: place.scrape()[accepted] == total(place.scrape(), "datagrams_received"), "the balance")
            assert router.stop(signal.SIGTERM) == 0
            assert {line["level"] for line in router.log()} == {"info"}
