"""Zenoh gateways of running routers: a fleet behind a hub, passwords, and two gateways that have one key.

Certificates, rules, hub and table of the fleet are those of docs/guides/fleet.md. All of it on the loopback interface,
without multicast.
"""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path

import pytest
import zenoh

from tests.acceptance.gateway_clients import Scene, scene
from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.site import RouterProcess, key, wait_until
from tests.docs_commands import typed, written
from tests.ports import free_port
from tests.repeating import repeating
from tests.tables import PROTOS

pytestmark = pytest.mark.slow  # discovery between three programs, with TLS

ZENOH = """\
  earth:
    transport: {zenoh: {key: rovers/loki, listen: ["tcp/127.0.0.1:PORT"]}}
    topics: {include: ["/gw/**"]}
    publish_period: 50ms
    discovery_period: 200ms
    inbound: [{topic: /gw/set, type: std_msgs/msg/Int32}]
"""


PAGE = Path(__file__).parents[2] / "docs" / "guides" / "fleet.md"
MINE = "rovers/rover_1"
DRIVE = {"/drive_motor": "comms/msg/DrivingBoardMotorMessage"}
MOVE = ("/drive_motor", {"distance_to_go": 1.0, "turning_radius": 0.0})


CA = """\
[ca]
default_ca = here
[here]
new_certs_dir = new
database = index
rand_serial = yes
certificate = ../ca.pem
private_key = ../ca.key
default_md = sha256
policy = names
copy_extensions = copy
[names]
commonName = supplied
"""
"""For `openssl ca`, which signs for seconds."""


@dataclass(frozen=True)
class Fleet:
    """What the commands of docs/guides/fleet.md make in a folder: certificates, and configurations of Zenoh."""

    folder: Path
    port: int

    @property
    def gateways(self) -> str:
        """Of the table of all rovers."""
        return written(PAGE)["rover.yaml"].partition("gateways:\n")[2].replace("7447", str(self.port))

    @contextmanager
    def hub(self) -> Iterator[subprocess.Popen[bytes]]:
        """The hub, by the page's command. Gateways and operators wait for it."""
        [command] = [command for command in typed(PAGE) if "python hub.py" in command]
        environment, _, rest = command.removesuffix(" &").partition("python")
        shell = f"{environment} exec {sys.executable}{rest}"
        running = subprocess.Popen(["/bin/sh", "-c", shell], cwd=self.folder)
        try:
            yield running
        finally:
            running.kill()
            running.wait(PATIENCE)

    @contextmanager
    def operator(self, name: str, others: str = "") -> Iterator[zenoh.Session]:
        """A session with the certificate of `name`, an operator or rover, of the authority in `others`."""
        text = (self.folder / "ann.json5").read_text().replace("/ann.", f"{others}/{name}.")
        config: zenoh.Config = zenoh.Config.from_json5(text)
        config.insert_json5("scouting/multicast/enabled", "false")
        with zenoh.open(config) as session:
            yield session

    def sign_for(self, name: str, seconds: int) -> str:
        """Give `name` a certificate that is valid for that long. Return its folder, for `operator`."""
        place = self.folder / "short"
        (place / "new").mkdir(parents=True)
        (place / "index").touch()
        (place / "ca.cnf").write_text(CA)
        until = datetime.now(timezone.utc) + timedelta(seconds=seconds)
        sign = f"openssl ca -batch -config ca.cnf -in ../{name}.csr -out {name}.pem -enddate {until:%Y%m%d%H%M%SZ}"
        command = f"{sign} && cp ../{name}.key ."
        subprocess.run(["/bin/sh", "-e", "-c", command], cwd=place, check=True, capture_output=True)
        return "/short"

    def drive(self, name: str, rover: str) -> None:
        """The page's program, to its end."""
        words = [sys.executable, "drive.py", f"{name}.json5", rover]
        subprocess.run(words, cwd=self.folder, check=True, timeout=PATIENCE)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    """In `others` there are the same certificates of another authority."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    made = Fleet(tmp_path_factory.mktemp("fleet"), free_port(kind=socket.SOCK_STREAM))
    for name in ("fleet.py", "hub.py", "drive.py"):
        (made.folder / name).write_text(written(PAGE)[name].replace("7447", str(made.port)))
    certificates = [command for command in typed(PAGE) if "openssl" in command]
    for place in (made.folder, made.folder / "others"):
        place.mkdir(exist_ok=True)
        for command in certificates:
            subprocess.run(["/bin/sh", "-e", "-c", command], cwd=place, check=True, capture_output=True)
    subprocess.run([sys.executable, "fleet.py"], cwd=made.folder, check=True)
    return made


@contextmanager
def rover_1(fleet: Fleet, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    monkeypatch.setenv("ROVER", "rover_1")
    monkeypatch.setenv("CERTIFICATES", str(fleet.folder))
    with scene(folder, fleet.gateways) as now:
        now.await_clients("fleet", 1)
        yield now


class Heard:
    def __init__(self, session: zenoh.Session, where: str) -> None:
        self._samples: list[zenoh.Sample] = []
        session.declare_subscriber(where, self._samples.append)

    def payloads(self) -> list[str]:
        return [sample.payload.to_string() for sample in self._samples]

    def await_one(self, send: Callable[[], object], count: int = 1) -> None:
        """Repeat `send` until something has come, or `count` values."""
        with repeating(send):
            wait_until(lambda: len(self._samples) >= count, "a value")


def test_an_operator_reads_all_rovers_and_drives_his_own(
    tmp_path: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    with fleet.hub(), rover_1(fleet, tmp_path, monkeypatch) as now, RosPeer(DRIVE) as peer:
        now.peer.open("/gw/word", "std_msgs/msg/String", keeps=True)
        with fleet.operator("ann") as ann, fleet.operator("ben") as ben:
            for session, rovers in ((ann, "rovers/*"), (ben, MINE)):  # all first: reads by name would open the way
                heard = Heard(session, f"{rovers}/data/gw/word")
                heard.await_one(partial(now.peer.say, "/gw/word", {"data": "x"}), count=3)  # the first always comes
                answers = [reply.ok for reply in session.get(f"{rovers}/**", timeout=10.0)]
                assert f"{MINE}/schema/std_msgs/msg/String" in [str(answer.key_expr) for answer in answers if answer]
        received = key("datagrams_received", listener="fleet")
        fleet.drive("ben", "rover_1")
        assert now.site.scrape()[received] == 0
        fleet.drive("ann", "rover_1")
        assert now.site.scrape()[received] > 0
        assert peer.receive() == MOVE


def test_a_rover_publishes_below_its_own_key_only(tmp_path: Path, fleet: Fleet) -> None:
    with fleet.hub(), fleet.operator("ann") as ann, fleet.operator("rover_1") as rover:
        with fleet.operator("rover_2") as forger, fleet.operator("ben") as reader:
            forged, own = Heard(ann, f"{MINE}/**"), Heard(ann, "rovers/rover_2/data/**")
            commands = Heard(rover, f"{MINE}/inbound/**")
            forger.liveliness().declare_token(f"{MINE}/owner/1/forger/host/1")

            def forge() -> None:
                for session in (forger, reader):
                    session.put(f"{MINE}/data/word", "forged")
                    session.put(f"{MINE}/inbound/drive_motor", "forged")
                forger.put("rovers/rover_2/data/word", "its own")

            own.await_one(forge)
            time.sleep(0.5)  # for what would have come as well
            assert (forged.payloads(), commands.payloads()) == ([], [])
            assert [*rover.liveliness().get(f"{MINE}/owner/**", timeout=10.0)] == []
        forged.await_one(lambda: rover.put(f"{MINE}/data/word", "real"))
        assert set(forged.payloads()) == {"real"}
        commands.await_one(lambda: ann.put(f"{MINE}/inbound/drive_motor", "real"))
        assert set(commands.payloads()) == {"real"}


def test_wildcards_open_no_other_rover(fleet: Fleet) -> None:
    """While an operator reads all rovers, neither a rover nor an operator gets at one that is not his by a wildcard."""
    others = (f"{MINE}/**", "rovers/*/**", "rovers/**", "**")
    with fleet.hub(), fleet.operator("ann") as ann, fleet.operator("rover_1") as rover, ExitStack() as opened:
        read, commands = Heard(ann, "rovers/*/data/**"), Heard(rover, f"{MINE}/inbound/**")
        rover.declare_queryable(f"{MINE}/**", lambda query: query.reply(f"{MINE}/data/word", "real"))
        attackers = [opened.enter_context(fleet.operator(name)) for name in ("rover_2", "ben")]
        spy = opened.enter_context(fleet.operator("rover_2"))
        spied = [Heard(spy, where) for where in others]
        asked: list[str] = []

        def answer_falsely(query: zenoh.Query) -> None:
            asked.append(str(query.key_expr))
            query.reply(f"{MINE}/data/word", "forged")

        for where in others:
            attackers[0].declare_queryable(where, answer_falsely)
        attackers[0].liveliness().declare_token("rovers/*/owner/1/forger/host/1")

        def attack() -> None:
            for session in attackers:
                for where in ("rovers/*/data/word", "rovers/*/inbound/drive_motor", f"{MINE}/**", "rovers/**"):
                    session.put(where, "forged")
                    session.delete(where)
                session.delete(f"{MINE}/inbound/drive_motor")
            rover.put(f"{MINE}/data/word", "real")
            ann.put(f"{MINE}/inbound/drive_motor", "real")

        read.await_one(attack)
        time.sleep(0.5)  # for what would have come as well
        assert {*read.payloads()} == {*commands.payloads()} == {"real"}
        assert [heard.payloads() for heard in spied] == [[]] * len(spied)
        assert [reply.ok.payload.to_string() for reply in ann.get("rovers/**", timeout=10.0) if reply.ok] == ["real"]
        assert asked == []
        assert [*spy.get("rovers/**", timeout=10.0)] == []
        assert [*rover.liveliness().get(f"{MINE}/owner/**", timeout=10.0)] == []


@pytest.mark.parametrize("stranger", ["without", "of another authority", "by tcp"])
def test_who_has_no_certificate_of_the_authority_does_not_get_in(fleet: Fleet, stranger: str) -> None:
    with fleet.hub(), ExitStack() as opened:
        assert list(opened.enter_context(fleet.operator("ann")).get(f"{MINE}/data/x", timeout=10.0)) == []
        if stranger == "of another authority":
            with pytest.raises(zenoh.ZError, match="Unable to connect"), fleet.operator("ann", "/others"):
                pass
            return
        config: zenoh.Config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        protocol = "tcp" if stranger == "by tcp" else "tls"
        config.insert_json5("connect/endpoints", f'["{protocol}/127.0.0.1:{fleet.port}"]')
        config.insert_json5("transport/link/tls/root_ca_certificate", f'"{fleet.folder}/ca.pem"')
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(config)


def test_an_operator_whose_certificate_expires_while_driving_drives_no_longer(fleet: Fleet) -> None:
    with fleet.hub(), fleet.operator("rover_1") as rover:
        commands = Heard(rover, f"{MINE}/inbound/**")
        with fleet.operator("ann", fleet.sign_for("ann", 15)) as ann:
            commands.await_one(lambda: ann.put(f"{MINE}/inbound/drive_motor", "go"), count=3)
            with repeating(lambda: ann.put(f"{MINE}/inbound/drive_motor", "go")):
                wait_until(lambda: not ann.info.routers_zid(), "the end of the link")
                driven = len(commands.payloads())
                time.sleep(3.0)  # Zenoh tries again after 1 s and 2 s
                assert len(commands.payloads()) == driven
    log = (fleet.folder / "hub.log").read_text()
    assert "remote certificate chain expired" in log
    assert "certificate expired" in log  # what the hub said of each further attempt


def test_the_hub_drops_what_is_too_large(fleet: Fleet) -> None:
    with fleet.hub(), fleet.operator("rover_1") as rover, fleet.operator("ann") as ann:
        commands, data = Heard(rover, f"{MINE}/inbound/**"), Heard(ann, f"{MINE}/data/**")

        def send() -> None:
            for session, key in ((ann, f"{MINE}/inbound/drive_motor"), (rover, f"{MINE}/data/picture")):
                session.put(key, "x" * 70_000)
                session.put(key, "x")

        for heard in (commands, data):
            heard.await_one(send, count=4)
        assert {*map(len, commands.payloads())} == {1}
        assert {*map(len, data.payloads())} == {1, 70_000}


def test_rovers_and_operators_find_a_hub_that_comes_back(
    tmp_path: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as opened, fleet.hub() as hub, rover_1(fleet, tmp_path, monkeypatch) as now:
        now.peer.open("/gw/word", "std_msgs/msg/String", keeps=True)
        ann = opened.enter_context(fleet.operator("ann"))
        hub.kill()
        hub.wait(PATIENCE)
        connections = key("gateway_connections", route="fleet", mode="client")
        wait_until(lambda: now.site.samples()[connections] == 0, "the loss")
        opened.enter_context(fleet.hub())
        Heard(ann, f"{MINE}/data/gw/word").await_one(partial(now.peer.say, "/gw/word", {"data": "x"}))
        before = now.site.scrape()
        fleet.drive("ann", "rover_1")
        assert now.site.changes(before)[key("messages_published", route="fleet", topic="/drive_motor")] > 0


WAITS = "another gateway uses the Zenoh key: this gateway waits until the key is free"
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
