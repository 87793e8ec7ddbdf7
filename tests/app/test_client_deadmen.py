"""The stop of a gateway client's deadman reaches the board to which this router carries the topic, whatever ends it."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from tests.acceptance.site import wait_until
from tests.app.conftest import Site
from tests.app.test_starting import end, wait_for_start
from tests.ports import free_port
from tests.readable import readable
from tests.ros.peers import Subscriber
from tests.routers import MODULE, start

TYPE = "comms/msg/DrivingBoardMotorMessage"
COMMAND = b'{"op": "publish", "topic": "/drive", "data": {"turning_radius": 0, "distance_to_go": 50}}\n'
NOBODY = "  ph_info: {source: sensor_board, destinations: [basestation]}\n"


def route(limit: str = "", ttl: str = "") -> str:
    """Carries what clients publish to a board, with the gateway's deadman alone."""
    return f"""\
  drive_motor:
    source: {{topic: drive, type: {TYPE}, queue_depth: 10}}
    fields: {{distance_to_go: distance_to_go}}
    destinations: [{{endpoint: basestation{limit}}}]
    deadman: {{none: the gateway's deadman stops it}}
{ttl}"""


URGENT = route(ttl="    ttl: 5s\n")
LIMITED = route(", max_rate: 1 Hz, on_limit: latest")
LATER = """\
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <library_settings><intraprocess_delivery>OFF</intraprocess_delivery></library_settings>
  <profiles>
    <participant profile_name="slow" is_default_profile="true"><rtps><flow_controller_descriptor_list>
      <flow_controller_descriptor>
        <name>slow</name><max_bytes_per_period>350</max_bytes_per_period><period_ms>200</period_ms>
      </flow_controller_descriptor>
    </flow_controller_descriptor_list></rtps></participant>
    <data_writer profile_name="slow" is_default_profile="true"><qos><publishMode>
      <kind>ASYNCHRONOUS</kind><flow_controller_name>slow</flow_controller_name>
    </publishMode></qos></data_writer>
  </profiles>
</dds>
"""
"""Messages are delivered by another thread, no more than one every 200 ms."""

GATEWAY = """\
gateways:
  {name}:
    transport: {{tcp: 127.0.0.1:{port}}}
    format: json_lines
    inbound:
      - topic: {topic}
        type: {type}
        queue_depth: 10
        deadman: {{timeout: {timeout}, send: {{distance_to_go: 0}}, at_start: silent}}
"""


def gateway(port: int, name: str = "operator", topic: str = "drive", timeout: str = "1h") -> str:
    return GATEWAY.format(port=port, name=name, topic=topic, timeout=timeout, type=TYPE)


@contextmanager
def driving(site: Site, port: int) -> Iterator[socket.socket]:
    """A client that has told the board to drive 50."""
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(COMMAND)
        assert driven_to(site) == 50
        yield client


def driven_to(site: Site) -> float:
    datagram = site.basestation.recv(1000)
    return float(struct.unpack_from("<f", datagram, 3)[0]) if len(datagram) > 3 else 0.0


@pytest.mark.parametrize("carried", [route(), URGENT, LIMITED], ids=["plain", "urgent", "limited"])
def test_at_the_stop_of_the_router(site: Site, carried: str) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with site.router(carried + gateway(port)) as router, driving(site, port):
        pass
    assert driven_to(site) == 0
    assert router.total("messages_dropped") == 0


def test_at_the_stop_another_node_gets_it_too(site: Site) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with closing(Subscriber("drive", TYPE)) as subscriber:
        with site.router(route() + gateway(port)), driving(site, port) as client:
            assert subscriber.line() == "matched"
            while not readable(subscriber.process.stdout.fileno(), 0.1):  # the publisher may not know it yet
                client.sendall(COMMAND)
        while number(subscriber) == 50:
            pass


@pytest.mark.parametrize("carried", [route(), URGENT], ids=["plain", "urgent"])
def test_at_sigterm_while_the_middleware_delivers_later(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, carried: str
) -> None:
    profiles = tmp_path / "profiles.xml"
    profiles.write_text(LATER)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(profiles))
    monkeypatch.setenv("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")
    port = free_port(kind=socket.SOCK_STREAM)
    process = start(MODULE, "run", site.write(carried + gateway(port)))
    wait_for_start(process)
    with driving(site, port):
        assert end(process)[-1] == "router stopped"
    assert driven_to(site) == 0


def number(subscriber: Subscriber) -> float:
    return float(struct.unpack_from("<f", bytes.fromhex(subscriber.line()), 4)[0])


@pytest.mark.parametrize("carried", [route(), URGENT], ids=["plain", "urgent"])
@pytest.mark.parametrize(
    "kept", ["route", "nothing", "another gateway", "another topic"], ids=lambda kept: kept.replace(" ", "_")
)
def test_at_a_reload_that_ends_the_deadman(site: Site, carried: str, kept: str) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    then = {
        "route": carried,
        "nothing": NOBODY,
        "another gateway": carried + gateway(port, name="pilot"),
        "another topic": NOBODY + gateway(port, topic="elsewhere"),
    }[kept]
    with site.router(carried + gateway(port)) as router, driving(site, port):
        site.write(then)
        result = router.reload()
        assert result.ok, result
        assert driven_to(site) == 0


def test_at_a_reload_that_restarts_the_gateway_after_the_timeout(site: Site) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with site.router(route() + gateway(port, timeout="5s")) as router, driving(site, port):
        site.write(route() + gateway(port, timeout="200ms"))
        assert router.reload().ok
        wait_until(lambda: router.total("deadman_active") == 1)
        assert driven_to(site) == 0
