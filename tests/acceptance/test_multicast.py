"""Multicast groups of a running router, in networks that come late, go away and return."""

from __future__ import annotations

import marshal
import os
import socket
from contextlib import closing

import pytest

from router.compiler import check_table
from router.image.image import Image
from router.image.writer import write_image
from router.startup_image.head_start import HeadStart
from tests.acceptance.payloads import WIRE
from tests.acceptance.site import ROOT, wait_until
from tests.acceptance.test_networks import THERE, WAITS, reload, status
from tests.acceptance.two_networks import Rover, udp
from tests.namespaces import cable

GROUP = "224.5.23.2", 10006
TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen: {{vision: {{address: 0.0.0.0:10006, groups: [224.5.23.2], interface: lan0}}}}
endpoints:
  camera: {{address: 10.78.1.222:8, kind: tool}}
  basestation: {{address: 10.78.2.10:9000, kind: basestation}}
routes:
  drive_diag: {{source: camera, destinations: [basestation]}}
"""
BY_ROUTE = TABLE.replace(", interface: lan0", "")
DIAG = WIRE.encode(WIRE.case("drive_diag"), WIRE.case("drive_diag").message_class())
NOT_JOINED = "multicast group not joined: the listener does not receive it; the router tries each second"
JOINED = "multicast groups joined"


def camera_sends(site: Rover, source: str = "10.78.1.222", to: tuple[str, int] = GROUP) -> None:
    site.lan.ip("route", "replace", "224.0.0.0/4", "dev", "eth0")
    with udp(site.lan, (source, 0)) as camera:
        camera.sendto(DIAG, to)


def is_received(site: Rover) -> bool:
    camera_sends(site)
    site.basestation.settimeout(0.3)
    try:
        return site.basestation.recv(1000) == DIAG
    except TimeoutError:
        return False


def doctor(site: Rover) -> str:
    table = site.folder / "table.yaml"
    return site.rover.run(ROOT / ".venv/bin/python", "-m", "router", "doctor", "-t", table, check=False)


def replug(site: Rover) -> None:
    cable(site.rover, "lan0", "10.78.1.1/24", site.lan, "eth0", "10.78.1.222/24")
    site.lan.ip("address", "add", "10.78.1.60/24", "dev", "eth0")


def test_a_group_is_received_from_known_senders_beside_another_program(site: Rover) -> None:
    other = site.rover.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    with other, site.router(TABLE) as router:
        other.bind(("0.0.0.0", 10006))
        other.settimeout(5)
        found = doctor(site)
        assert f"python (pid {os.getpid()})" in found
        assert f"{router.process.pid}) have udp port 10006 open" in found or f"(pid {router.process.pid}) and" in found
        camera_sends(site)
        assert (site.basestation.recv(1000), other.recv(1000)) == (DIAG, DIAG)
        camera_sends(site, source="10.78.1.60")
        wait_until(lambda: site.mismatches("vision") == 1, "the stranger's datagram")
        assert site.count("messages_received_total", route="drive_diag", source="camera") == 1
        assert site.count("groups_not_joined", listener="vision") == 0


def test_a_group_is_joined_on_an_interface_that_comes_late_and_again_when_it_returns(site: Rover) -> None:
    site.rover.ip("link", "del", "lan0")
    with site.router(TABLE) as router:
        assert [warning["listener"] for warning in router.events(WAITS)] == ["vision"]
        for times in (1, 2):
            replug(site)
            wait_until(lambda times=times: len(router.events(THERE)) == times, "the interface")  # type: ignore[misc]
            assert is_received(site)
            site.rover.ip("link", "del", "lan0")
            wait_until(lambda: site.count("listener_waiting", listener="vision") == 1, "its loss")


def test_without_an_interface_a_group_follows_the_route_to_it(site: Rover) -> None:
    with site.router(BY_ROUTE) as router:
        [warning] = router.events(NOT_JOINED)
        assert (warning["listener"], warning["group"]) == ("vision", GROUP[0])
        assert site.count("groups_not_joined", listener="vision") == 1
        assert "vision has not joined all of its multicast groups, 1 of them missing" in status(site)
        assert "listener 'vision' cannot join 224.5.23.2: no route leads to it" in doctor(site)
        assert not is_received(site)
        site.rover.ip("route", "add", "224.0.0.0/4", "dev", "lan0")
        wait_until(lambda: len(router.events(JOINED)) == 1, "the group")
        assert is_received(site)
        assert "listener 'vision' joins 224.5.23.2 on lan0\n" in doctor(site)
        site.rover.ip("link", "del", "lan0")
        wait_until(lambda: len(router.events(NOT_JOINED)) == 2, "the loss")
        replug(site)
        site.rover.ip("route", "add", "224.0.0.0/4", "dev", "lan0")
        wait_until(lambda: len(router.events(JOINED)) == 2, "the return")
        assert is_received(site)


@pytest.mark.slow
def test_a_reload_joins_and_leaves_groups(site: Rover) -> None:
    without = TABLE.replace(", groups: [224.5.23.2]", "")
    with site.router(without) as router:
        assert not is_received(site)
        reload(site, router, TABLE)
        assert is_received(site)
        reload(site, router, without)
        assert not is_received(site)
        assert len(router.events("router started")) == 1


def test_a_head_start_joins_the_groups(site: Rover) -> None:
    program = check_table(site.table(TABLE), {}).program or pytest.fail("the table has errors")
    image = Image(**marshal.loads(marshal.dumps(write_image(program).parts())))  # noqa: S302 - written here
    with closing(site.rover.inside(lambda: HeadStart(image, ()))):
        assert is_received(site)
