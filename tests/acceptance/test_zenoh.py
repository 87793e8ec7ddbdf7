"""Zenoh gateways of running routers: certificates, access control, and two that have one key.

The first two are those of docs/guides/gateways.md. All of it on the loopback interface, without multicast.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest
import zenoh

from tests.acceptance.gateway_clients import Scene, repeating, scene, twist
from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.site import RouterProcess, key, wait_until
from tests.ports import free_port
from tests.tables import PROTOS
from tests.test_docs import examples

pytestmark = pytest.mark.slow  # discovery between three programs, with TLS

KEY = "rovers/rover_1"
ZENOH = """\
  earth:
    transport: {zenoh: {key: rovers/loki, listen: ["tcp/127.0.0.1:PORT"]}}
    topics: {include: ["/gw/**"]}
    publish_period: 50ms
    discovery_period: 200ms
    inbound: [{topic: /gw/set, type: std_msgs/msg/Int32}]
"""


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands of docs/guides/gateways.md make there, and in `others` the same once more."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    folder = tmp_path_factory.mktemp("certificates")
    [commands] = [text for text in examples("guides/gateways.md", "sh") if "openssl" in text]
    for place in (folder, folder / "others"):
        place.mkdir(exist_ok=True)
        local = commands.replace("192.168.0.11", "127.0.0.1")
        subprocess.run(["/bin/sh", "-e", "-c", local], cwd=place, check=True, capture_output=True)
    return folder


def documented(language: str, certificates: Path) -> str:
    [text] = [text for text in examples("guides/gateways.md", language) if "/etc/rover/zenoh" in text]
    return text.replace("/etc/rover/zenoh", str(certificates)).replace("192.168.0.11:7447", "127.0.0.1:PORT")


@contextmanager
def station(now: Scene, certificates: Path, name: str = "station", others: str = "") -> Iterator[zenoh.Session]:
    """The base station of docs/guides/gateways.md, with the certificate of `name`."""
    text = documented("json5", certificates).replace("PORT", str(now.ports["PORT"]))
    text = text.replace("/station.", f"{others}/{name}.")
    config: zenoh.Config = zenoh.Config.from_json5(text)
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


def move() -> bytes:
    return json.dumps({"op": "publish", "topic": "/cmd_vel", "time": time.time(), "data": twist(0.5)}).encode()


class Heard:
    def __init__(self, session: zenoh.Session, where: str) -> None:
        self._samples: list[zenoh.Sample] = []
        session.declare_subscriber(where, self._samples.append)

    def something(self) -> bool:
        return bool(self._samples)


def test_who_has_the_right_certificate_reads_and_who_is_allowed_to_drives(tmp_path: Path, certificates: Path) -> None:
    gateways = documented("yaml", certificates).removeprefix("gateways:\n")
    with (
        scene(tmp_path, gateways) as now,
        RosPeer({"/cmd_vel": "geometry_msgs/msg/Twist"}) as peer,
        station(now, certificates) as driver,
        station(now, certificates, "guest") as guest,
    ):
        now.peer.open("/gw/word", "std_msgs/msg/String", keeps=True)
        for session in (driver, guest):
            heard = Heard(session, f"{KEY}/data/gw/word")
            with repeating(partial(now.peer.say, "/gw/word", {"data": "x"})):
                wait_until(heard.something, "a value")
            answers = [reply.ok for reply in session.get(f"{KEY}/**", timeout=10.0)]
            assert f"{KEY}/schema/std_msgs/msg/String" in [str(answer.key_expr) for answer in answers if answer]
        received = key("datagrams_received", listener="earth")
        for _ in range(5):
            guest.put(f"{KEY}/inbound/cmd_vel", move())
            guest.put(f"{KEY}/data/gw/word", b"forged")
        with repeating(lambda: driver.put(f"{KEY}/inbound/cmd_vel", move())):
            at_start = ("/cmd_vel", twist(0.0))
            assert next(heard for heard in iter(peer.receive, None) if heard != at_start) == ("/cmd_vel", twist(0.5))
        before = now.site.scrape()[received]
        for _ in range(5):
            guest.put(f"{KEY}/inbound/cmd_vel", move())
        time.sleep(0.5)
        assert now.site.scrape()[received] == before


@pytest.mark.parametrize("stranger", ["without", "of another authority", "by tcp"])
def test_who_has_no_certificate_of_the_authority_does_not_get_in(
    tmp_path: Path, certificates: Path, stranger: str
) -> None:
    gateways = documented("yaml", certificates).removeprefix("gateways:\n")
    with scene(tmp_path, gateways) as now, ExitStack() as opened:
        assert list(opened.enter_context(station(now, certificates)).get(f"{KEY}/data/x", timeout=10.0)) == []
        config: zenoh.Config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        protocol = "tcp" if stranger == "by tcp" else "tls"
        config.insert_json5("connect/endpoints", f'["{protocol}/127.0.0.1:{now.ports["PORT"]}"]')
        tls = "transport/link/tls"
        config.insert_json5(f"{tls}/root_ca_certificate", f'"{certificates}/ca.pem"')
        if stranger == "of another authority":
            config.insert_json5(f"{tls}/enable_mtls", "true")
            config.insert_json5(f"{tls}/connect_certificate", f'"{certificates}/others/station.pem"')
            config.insert_json5(f"{tls}/connect_private_key", f'"{certificates}/others/station.key"')
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(config)


WAITS = "another gateway has the Zenoh key: this gateway waits until it is free"
PASSWORD = "fjord-4711"  # noqa: S105 - of nobody
ENVIRONMENT = {"ZENOH_PASSWORD": PASSWORD}


def test_a_password_from_the_environment_lets_in_and_is_printed_nowhere(tmp_path: Path) -> None:
    (tmp_path / "users").write_text(f"rover:{PASSWORD}\n")
    listening = ZENOH.replace(
        '["tcp/127.0.0.1:PORT"]',
        f'["tcp/127.0.0.1:PORT"], config: {{transport: {{auth: {{usrpwd: {{dictionary_file: {tmp_path}/users}}}}}}}}',
    )
    with scene(tmp_path, listening) as now:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{now.ports["PORT"]}"]')
        config.insert_json5("transport/auth/usrpwd", f'{{user: "rover", password: "{PASSWORD}x"}}')
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(config)
        second = now.site.folder / "second.yaml"
        login = 'transport: {auth: {usrpwd: {user: rover, password: "${ZENOH_PASSWORD}"}}}'
        second.write_text(connecting(now.ports["PORT"], login))
        folder = tmp_path / "second"
        folder.mkdir()
        with RouterProcess(folder, second, **ENVIRONMENT) as router:
            wait_until(lambda: bool(router.events(WAITS)))
            assert PASSWORD not in router.text()
        assert PASSWORD not in now.router.text()


def connecting(port: int, config: str = "") -> str:
    """A table with nothing but a gateway that connects to another one with the same key."""
    return f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
node: {{name: second}}
listen: {{here: {{address: 127.0.0.1:{free_port()}}}}}
routes: {{}}
gateways:
  earth:
    transport: {{zenoh: {{key: rovers/loki, mode: client, connect: [tcp/127.0.0.1:{port}], config: {{{config}}}}}}}
"""


def test_the_second_router_routes_while_its_gateway_waits_for_the_key(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("first", "second")]
    for folder in folders:
        folder.mkdir()
    with ExitStack() as opened:
        first = opened.enter_context(scene(folders[0], ZENOH))
        place = f'mode: client, connect: ["tcp/127.0.0.1:{first.ports["PORT"]}"]'
        there = ZENOH.replace('listen: ["tcp/127.0.0.1:PORT"]', place)
        second = opened.enter_context(scene(folders[1], there))
        conflicts = key("gateway_key_conflicts", route="earth")
        assert (second.site.scrape()[conflicts], first.site.scrape()[conflicts]) == (1, 0)
        [told] = second.router.events(WAITS)
        assert told["level"] == "error"
        assert f"pid {first.router.process.pid} on " in told["other"]
        clients = 'gateway_clients{route="earth"}'
        assert (second.site.samples()[clients], first.site.samples()[clients]) == (0, 1)
        imu = next(generated("imu_info")).datagram
        before = second.site.scrape()
        second.site.send("sensor_board", imu)
        changes = second.site.settle(before, 1)
        assert changes[key("messages_received", route="imu_info", source="sensor_board")] == 1
        first.router.stop(signal.SIGKILL)
        wait_until(lambda: second.site.samples()[clients] == 1, "its turn")
        assert second.site.scrape()[conflicts] == 1


def test_what_zenoh_refuses_when_it_opens_ends_the_start_and_names_the_line(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    config = "transport: {link: {tls: {listen_certificate: /nowhere.pem, listen_private_key: /nowhere.key}}}"
    text = connecting(1, config).replace("mode: client, connect: [tcp/127.0.0.1:1]", "listen: [tls/127.0.0.1:0]")
    table.write_text(text)
    router = RouterProcess(tmp_path, table)
    assert router.wait() == 78
    assert f"{table.name}:8:" in router.text()
    assert "No such file" in router.text()
    assert "Traceback" not in router.text()
