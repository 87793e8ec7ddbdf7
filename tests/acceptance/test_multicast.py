"""Multicast groups of a running router, in networks that come late, go away and return."""

from __future__ import annotations

import marshal
import os
import socket
import struct
import subprocess
from contextlib import closing, suppress

import pytest

from router.compiler import check_table
from router.image.image import Image
from router.image.writer import write_image
from router.startup_image.head_start import HeadStart
from tests.acceptance.payloads import WIRE
from tests.acceptance.site import ROOT, wait_until
from tests.acceptance.test_networks import THERE, UNREACHABLE, WAITS, reload, status
from tests.acceptance.two_networks import LAN, Rover, udp
from tests.namespaces import Computer, cable

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


OUT = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen: {{rover: {{address: 0.0.0.0:5000}}}}
endpoints:
  driving_board: {{address: 10.78.1.222:8, kind: board}}
  tracker: {{group: "224.5.23.2:10010", interface: radio0, kind: tool}}
  all: {{broadcast: "10.78.2.255:4444", kind: tool}}
routes:
  drive_diag: {{source: driving_board, destinations: [tracker, all]}}
"""


def member(computer: Computer, interface: str, port: int, group: str | None = None) -> socket.socket:
    """A program that receives a group, or without one all datagrams to its port."""

    def open_it() -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((group or "0.0.0.0", port))
        opened.settimeout(5)
        if group is not None:
            membership = struct.pack("@4sii", socket.inet_aton(group), 0, socket.if_nametoindex(interface))
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        return opened

    return computer.inside(open_it)


def test_one_datagram_reaches_all_members_of_a_group_and_a_whole_network(site: Rover) -> None:
    inside, outside = member(site.rover, "radio0", 10010, GROUP[0]), member(site.radio, "eth0", 10010, GROUP[0])
    elsewhere, every = member(site.lan, "eth0", 10010, GROUP[0]), member(site.radio, "eth0", 4444)
    with inside, outside, elsewhere, every, site.router(OUT):
        site.board.sendto(DIAG, LAN)
        assert outside.recvfrom(1000) == (DIAG, ("10.78.2.1", 5000))
        assert (inside.recv(1000), every.recvfrom(1000)) == (DIAG, (DIAG, ("10.78.2.1", 5000)))
        assert site.count("messages_dropped_total", route="drive_diag", target="tracker", reason="send_error") == 0
        elsewhere.settimeout(0.2)
        with pytest.raises(TimeoutError):
            elsewhere.recv(1000)


@pytest.mark.parametrize("name", ["tracker", "all"])
def test_verbs_send_to_them_and_listen_there(site: Rover, name: str) -> None:
    table = site.table(OUT.replace("radio0", "lo").replace("10.78.2.255", "127.255.255.255"))
    router = str(ROOT / ".venv/bin/python"), "-m", "router"
    inside = "ip", "netns", "exec", site.rover.namespace, *router
    command = *inside, "listen", f"envelope://{name}", "-t", str(table), "--count", "1"
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as listening:
        assert listening.stderr is not None
        assert "listening on" in listening.stderr.readline()
        site.rover.run(*router, "send", "drive_diag", "-t", table, "--to", name)
        assert "drive_diag" in listening.communicate(timeout=20)[0]


def test_the_router_does_not_receive_what_it_sends_to_a_group_of_its_own(site: Rover) -> None:
    text = OUT.replace("0.0.0.0:5000}}", "0.0.0.0:5000}}, peers: {{address: 0.0.0.0:10010, groups: [224.5.23.2]}}")
    site.rover.ip("route", "add", "224.0.0.0/4", "dev", "radio0")
    with member(site.radio, "eth0", 10010, GROUP[0]) as outside, site.router(text):
        site.board.sendto(DIAG, LAN)
        assert outside.recv(1000) == DIAG
        with udp(site.radio, ("10.78.2.10", 0)) as peer:
            site.radio.ip("route", "add", "224.0.0.0/4", "dev", "eth0")
            peer.sendto(DIAG, ("224.5.23.2", 10010))
        wait_until(lambda: site.count("datagrams_received_total", listener="peers") == 1, "the other's datagram")


def test_nothing_leaves_through_another_interface_while_that_of_the_group_is_missing(site: Rover) -> None:
    site.rover.ip("link", "del", "radio0")
    site.rover.ip("route", "add", "224.0.0.0/4", "dev", "lan0")
    lost = {"route": "drive_diag", "target": "tracker", "reason": "send_error"}
    with member(site.lan, "eth0", 10010, GROUP[0]) as elsewhere, site.router(OUT) as router:
        elsewhere.settimeout(0.2)
        for times in (1, 2):
            before = site.count("messages_dropped_total", **lost)
            site.board.sendto(DIAG, LAN)
            wait_until(lambda before=before: site.count("messages_dropped_total", **lost) > before, "the loss")  # type: ignore[misc]
            with pytest.raises(TimeoutError):
                elsewhere.recv(1000)
            cable(site.rover, "radio0", "10.78.2.1/24", site.radio, "eth0", "10.78.2.10/24")

            def arrives(outside: socket.socket) -> bool:
                site.board.sendto(DIAG, LAN)
                outside.settimeout(0.3)
                with suppress(TimeoutError):
                    return outside.recv(1000) == DIAG
                return False

            with member(site.radio, "eth0", 10010, GROUP[0]) as outside:
                wait_until(lambda outside=outside: arrives(outside), f"the group, time {times}")  # type: ignore[misc]
            site.rover.ip("link", "del", "radio0")
        [warning] = [each for each in router.events(UNREACHABLE) if each["endpoint"] == "tracker"]
        assert warning["why"] == "there is no such network interface"
