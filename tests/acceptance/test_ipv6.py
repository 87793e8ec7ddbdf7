"""A running router with IPv6: boards, groups, names, TCP, link-local addresses, in networks with real interfaces."""

from __future__ import annotations

import marshal
import re
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest

from router.compiler import check_table
from router.image.image import Image
from router.image.writer import write_image
from router.net.addresses import socket_address
from router.startup_image.head_start import HeadStart
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import key, wait_until
from tests.acceptance.test_multicast import DIAG, JOINED
from tests.acceptance.test_networks import THERE, WAITS, reload
from tests.acceptance.two_networks import BASESTATION, BRAKE, DRIVE, Rover, rover_with_networks, udp
from tests.namespaces import Computer

BOARD, STATION, STRANGER = "fd00:78:1::222", "fd00:78:2::10", "fd00:78:2::bad"
LAN, RADIO = ("fd00:78:1::1", 5000), ("fd00:78:2::1", 5000)
"""The rover's address in each network."""

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen: {{rover: {{address: "[::]:5000"}}}}
endpoints:
  driving_board: {{address: "[fd00:78:1::222]:8", kind: board}}
  basestation: {{address: "[fd00:78:2::10]:9000", kind: basestation}}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    deadman: {{timeout: 1200ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], repeat: 10s}}
  drive_diag: {{source: driving_board, destinations: [basestation]}}
"""


def udp6(computer: Computer, host: str, port: int, interface: str = "") -> socket.socket:
    def open_it() -> socket.socket:
        opened = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
        opened.bind((host, port, 0, socket.if_nametoindex(interface) if interface else 0))
        opened.settimeout(PATIENCE)
        return opened

    return computer.inside(open_it)


def connect(site: Rover, interface: str) -> None:
    """Give both ends of a network IPv6 addresses, which are usable at once."""
    network, other = ("1", site.lan) if interface == "lan0" else ("2", site.radio)
    site.rover.ip("address", "add", f"fd00:78:{network}::1/64", "dev", interface, "nodad")
    for host in ("222", "60") if interface == "lan0" else ("10", "bad"):
        other.ip("address", "add", f"fd00:78:{network}::{host}/64", "dev", "eth0", "nodad")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Rover]:
    with rover_with_networks(tmp_path) as site:
        connect(site, "lan0")
        connect(site, "radio0")
        for opened in (site.board, site.basestation):
            opened.close()
        with udp6(site.lan, BOARD, 8) as site.board, udp6(site.radio, STATION, 9000) as site.basestation:
            yield site


def drives(site: Rover) -> None:
    site.basestation.sendto(DRIVE, RADIO)
    wait_until(lambda: site.board_gets() == [DRIVE], "the command")


def test_datagrams_pass_both_ways_and_replies_find_the_listener(site: Rover) -> None:
    with site.router(TABLE) as router:
        assert site.board.recvfrom(100)[0] == BRAKE
        drives(site)
        site.basestation.sendto(DRIVE, RADIO)
        data, sender = site.board.recvfrom(100)
        assert (data, sender[:2]) == (DRIVE, LAN)
        site.board.sendto(DIAG, sender)
        data, sender = site.basestation.recvfrom(100)
        assert (data, sender[:2]) == (DIAG, RADIO)
        assert [site.seen(each) for each in ("driving_board", "basestation")] == [True, True]
        assert f"[{RADIO[0]}]:5000" not in router.text(), "no warning about it"


def test_the_brake_follows_silence_and_a_killed_station(site: Rover) -> None:
    with site.router(TABLE) as router:
        assert site.board.recv(100) == BRAKE
        site.basestation.sendto(DRIVE, RADIO)
        assert site.board.recv(100) == DRIVE
        assert site.board.recv(100) == BRAKE
        site.basestation.sendto(DRIVE, RADIO)
        assert site.board.recv(100) == DRIVE
        assert router.stop(signal.SIGTERM) == 0
        assert site.board.recv(100) == BRAKE


def test_a_stranger_is_named_and_gets_nothing_through(site: Rover) -> None:
    with udp6(site.radio, STRANGER, 9000) as stranger, site.router(TABLE) as router:
        assert site.board.recv(100) == BRAKE
        stranger.sendto(DRIVE, RADIO)
        wait_until(lambda: site.mismatches("rover") == 1, "the stranger's datagram")
        drives(site)
        wait_until(lambda: f"[{STRANGER}]:9000" in router.text(), "its address in the log")


def test_both_families_share_a_port(site: Rover) -> None:
    text = TABLE.replace(
        'listen: {{rover: {{address: "[::]:5000"}}}}',
        'listen: {{rover: {{address: "[::]:5000"}}, old: {{address: 0.0.0.0:5000}}}}',
    ).replace("routes:", "  camera: {{address: 10.78.1.60:8, kind: tool}}\nroutes:")
    text = text.replace("source: driving_board", "source: [driving_board, camera]")
    with site.router(text):
        camera = site.lan.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        with camera:
            camera.bind(("10.78.1.60", 8))
            camera.sendto(DIAG, ("10.78.1.1", 5000))
        assert site.basestation.recv(100) == DIAG
        drives(site)


def test_a_refused_datagram_is_counted_and_a_board_that_returns_is_served(site: Rover) -> None:
    lost = key("messages_dropped_total", route="manual_drive", target="driving_board", reason="send_error")
    with site.router(TABLE):
        drives(site)
        site.board.close()

        def is_refused() -> bool:
            site.basestation.sendto(DRIVE, RADIO)
            return site.samples()[lost] > 0

        wait_until(is_refused, "the refusal")
        with udp6(site.lan, BOARD, 8) as site.board:
            drives(site)


def refusal(sender: tuple[str, int], receiver: tuple[str, int]) -> bytes:
    """Port unreachable, about a datagram between them. The kernel adds the checksum."""
    hosts = b"".join(socket.inet_pton(socket.AF_INET6, host) for host, _ in (sender, receiver))
    quoted = bytes.fromhex("60000000 000d 11 40") + hosts + struct.pack("!4H", sender[1], receiver[1], 13, 0)
    return bytes.fromhex("0104 0000 00000000") + quoted


def test_a_flood_of_forged_errors_keeps_no_datagram_away_and_no_brake(site: Rover) -> None:
    def raw_icmp() -> socket.socket:
        return socket.socket(socket.AF_INET6, socket.SOCK_RAW, socket.IPPROTO_ICMPV6)

    with site.router(TABLE), site.radio.inside(raw_icmp) as forging:
        assert site.board.recv(100) == BRAKE
        for _ in range(20):
            for _ in range(500):
                forging.sendto(refusal(RADIO, (STATION, 9000)), (RADIO[0], 0))
            forging.sendto(refusal(LAN, (BOARD, 8)), (RADIO[0], 0))
            site.basestation.sendto(DRIVE, RADIO)
            while (data := site.board.recv(100)) == BRAKE:  # it was not fed
                pass
            assert data == DRIVE
        assert site.count("kernel_drops_total", listener="rover") == 0
        assert site.board.recv(100) == BRAKE
        site.board.sendto(DIAG, LAN)
        assert site.basestation.recv(100) == DIAG
        for route, target in (("manual_drive", "driving_board"), ("drive_diag", "basestation")):
            lost = key("messages_dropped_total", route=route, target=target, reason="send_error")
            wait_until(lambda lost=lost: site.samples()[lost] > 0, "the report of what they say")  # type: ignore[misc]


@pytest.mark.slow
def test_an_address_that_comes_later_and_a_reload(site: Rover) -> None:
    site.rover.ip("address", "del", f"{RADIO[0]}/64", "dev", "radio0")
    text = TABLE.replace("[::]:5000", f"[{RADIO[0]}]:5000")
    with site.router(text) as router:
        assert [each["listener"] for each in router.events(WAITS)] == ["rover"]
        site.rover.ip("address", "add", f"{RADIO[0]}/64", "dev", "radio0", "nodad")
        wait_until(lambda: bool(router.events(THERE)), "the address")
        site.rover.ip("route", "add", f"{BOARD}/128", "dev", "lan0")
        site.lan.ip("route", "add", f"{RADIO[0]}/128", "dev", "eth0")
        drives(site)
        reload(site, router, TABLE)
        drives(site)
        reload(site, router, text)
        drives(site)


# ---- learned, names


def test_a_tablet_is_learned_at_either_kind_of_address(site: Rover) -> None:
    text = TABLE.replace(
        'address: "[fd00:78:2::10]:9000", kind: basestation',
        "address: learned, kind: basestation, stale_after: 300ms, networks: [10.78.2.0/24, 'fd00:78:2::/64']",
    ).replace(
        'listen: {{rover: {{address: "[::]:5000"}}}}',
        'listen: {{rover: {{address: "[::]:5000"}}, old: {{address: 0.0.0.0:5000}}}}',
    )
    with site.router(text), udp(site.radio, BASESTATION) as old:
        for tablet, to in ((site.basestation, RADIO), (old, ("10.78.2.1", 5000)), (site.basestation, RADIO)):

            def takes_over(tablet: socket.socket = tablet, to: tuple[str, int] = to) -> bool:
                tablet.sendto(DRIVE, to)
                return DRIVE in site.board_gets()

            wait_until(takes_over, "the command")
            site.board.sendto(DIAG, LAN)
            assert tablet.recv(100) == DIAG


def test_a_tablet_is_learned_within_its_networks(site: Rover) -> None:
    text = TABLE.replace(
        'address: "[fd00:78:2::10]:9000", kind: basestation',
        "address: learned, kind: basestation, networks: ['fd00:78:2::/124']",
    )
    with udp6(site.radio, STRANGER, 9000) as stranger, site.router(text) as router:
        assert site.board.recv(100) == BRAKE
        stranger.sendto(DRIVE, RADIO)
        wait_until(lambda: site.mismatches("rover") == 1, "a tablet outside of the networks")
    text = text.replace("/124", "/64")
    with udp6(site.radio, STRANGER, 9001) as tablet, site.router(text) as router:
        site.board_gets()
        tablet.sendto(DRIVE, RADIO)
        wait_until(lambda: site.board_gets() == [DRIVE], "the command")
        site.board.sendto(DIAG, LAN)
        assert tablet.recv(100) == DIAG
        assert f"[{STRANGER}]:9001" in router.text()
        site.basestation.sendto(DRIVE, RADIO)
        wait_until(lambda: site.mismatches("rover") == 1, "another one meanwhile")
        flood(site)
        wait_until(lambda: site.mismatches("rover") > 4096, "strangers")
        site.board.sendto(DIAG, LAN)
        assert tablet.recv(100) == DIAG, "its address is still known"


def flood(site: Rover) -> None:
    """Send from more addresses than the router remembers."""
    site.radio.run("sysctl", "-qw", "net.ipv6.ip_nonlocal_bind=1")

    def send() -> None:
        for number in range(1, 5001):
            with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as stranger:
                stranger.bind((f"fd00:bad::{number:x}", 0))
                stranger.sendto(DRIVE, RADIO)

    site.radio.inside(send)


# ---- link-local addresses


def link_local(computer: Computer, interface: str) -> str:
    def is_there() -> bool:
        return "scope link" in shown() and "tentative" not in shown()

    def shown() -> str:
        return computer.ip("-6", "address", "show", "dev", interface)

    wait_until(is_there, "the link-local address")
    (found,) = re.findall(r"inet6 (fe80::[0-9a-f:]+)", shown())
    return str(found)


@contextmanager
def local_board(site: Rover) -> Iterator[tuple[socket.socket, str]]:
    """The board at its link-local address, and the rover's in that network."""
    mine, own = link_local(site.lan, "eth0"), link_local(site.rover, "lan0")
    with udp6(site.lan, mine, 8, "eth0") as board:
        yield board, own


def test_a_board_on_a_cable_needs_no_address_but_its_own(site: Rover) -> None:
    site.board.close()
    with local_board(site) as (board, own):
        text = TABLE.replace("[fd00:78:1::222]", f"[{link_local(site.lan, 'eth0')}%lan0]")
        with site.router(text):
            assert board.recv(100) == BRAKE
            site.basestation.sendto(DRIVE, RADIO)
            data, sender = board.recvfrom(100)
            assert (data, sender[0].partition("%")[0], sender[1]) == (DRIVE, own, 5000)
            board.sendto(DIAG, sender)
            assert site.basestation.recv(100) == DIAG
        with site.router(text.replace("%lan0", "%radio0")):
            board.sendto(DIAG, sender)
            wait_until(lambda: site.mismatches("rover") == 1, "the same address on another cable")


@pytest.mark.slow
def test_a_cable_that_is_pulled_and_plugged_in_again(site: Rover) -> None:
    site.board.close()
    text = TABLE.replace("[fd00:78:1::222]", "[fe80::8%lan0]")
    site.rover.ip("link", "del", "lan0")
    with site.router(text):
        for _ in range(2):
            site.rover.ip("link", "add", "lan0", "type", "veth", "peer", "name", "eth0", "netns", site.lan.namespace)
            site.lan.ip("link", "set", "eth0", "addrgenmode", "none")
            site.lan.ip("address", "add", "fe80::8/64", "dev", "eth0", "nodad")
            site.lan.ip("link", "set", "eth0", "up")
            site.rover.ip("link", "set", "lan0", "up")
            with udp6(site.lan, "fe80::8", 8, "eth0") as board:
                board.settimeout(0.3)

                def obeys(board: socket.socket = board) -> bool:
                    site.basestation.sendto(DRIVE, RADIO)
                    with suppress(TimeoutError):
                        return board.recv(100) == DRIVE
                    return False

                wait_until(obeys, "the command")
                before = site.count("messages_received_total", route="drive_diag", source="driving_board")

                def is_known(board: socket.socket = board, before: float = before) -> bool:
                    board.sendto(DIAG, (link_local(site.rover, "lan0"), 5000, 0, 0))
                    return site.count("messages_received_total", route="drive_diag", source="driving_board") > before

                wait_until(is_known, "its answer")
            site.rover.ip("link", "del", "lan0")


# ---- groups


GROUP = "ff12::5:23"
GROUPS = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen: {{vision: {{address: "[::]:10006", groups: ["ff12::5:23"], interface: lan0}}}}
endpoints:
  camera: {{address: "[fd00:78:1::222]:8", kind: tool}}
  tracker: {{group: "[ff12::7]:10010", interface: radio0, kind: tool}}
routes:
  drive_diag: {{source: camera, destinations: [tracker]}}
"""


def send_to_group(opened: socket.socket, computer: Computer, data: bytes) -> None:
    index = computer.inside(lambda: socket.if_nametoindex("eth0"))
    opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
    opened.sendto(data, (GROUP, 10006, 0, index))


@contextmanager
def tracker(site: Rover) -> Iterator[socket.socket]:
    with closing(udp6(site.radio, "::", 10010)) as opened:
        index = site.radio.inside(lambda: socket.if_nametoindex("eth0"))
        group = socket.inet_pton(socket.AF_INET6, "ff12::7") + struct.pack("@I", index)
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, group)
        yield opened


def test_groups_are_received_and_sent_to(site: Rover) -> None:
    with tracker(site) as members, site.router(GROUPS):
        send_to_group(site.board, site.lan, DIAG)
        data, sender = members.recvfrom(100)
        assert (data, sender[1]) == (DIAG, 10006), "it leaves from the listener's port"
        assert site.count("groups_not_joined", listener="vision") == 0
        with udp6(site.lan, "fd00:78:1::60", 8) as other:
            send_to_group(other, site.lan, DIAG)
            wait_until(lambda: site.mismatches("vision") == 1, "the stranger's datagram")


@pytest.mark.slow
def test_a_group_is_joined_when_its_interface_comes_late(site: Rover) -> None:
    site.board.close()
    site.rover.ip("link", "del", "lan0")
    with tracker(site) as members, site.router(GROUPS) as router:
        assert [each["listener"] for each in router.events(WAITS)] == ["vision"]
        site.rover.ip("link", "add", "lan0", "type", "veth", "peer", "name", "eth0", "netns", site.lan.namespace)
        for computer, interface in ((site.rover, "lan0"), (site.lan, "eth0")):
            computer.ip("link", "set", interface, "up")
        connect(site, "lan0")
        wait_until(lambda: bool(router.events(THERE) or router.events(JOINED)), "the interface")
        with udp6(site.lan, BOARD, 8) as site.board:
            members.settimeout(0.3)

            def arrives() -> bool:
                send_to_group(site.board, site.lan, DIAG)
                with suppress(TimeoutError):
                    return members.recv(100) == DIAG
                return False

            wait_until(arrives, "the group")


# ---- TCP


TCP = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen:
  box: {{connect: "[fd00:78:1::222]:4000", framing: varint}}
  boards: {{accept: "[::]:4444", framing: varint}}
endpoints:
  one: {{listener: box, kind: board}}
  two: {{listener: boards, address: "fd00:78:2::10", kind: board}}
routes:
  drive_diag: {{source: one, destinations: [two]}}
  imu_info: {{source: two, destinations: [one]}}
"""


def stream(computer: Computer) -> socket.socket:
    opened = computer.inside(lambda: socket.socket(socket.AF_INET6, socket.SOCK_STREAM))
    opened.settimeout(PATIENCE)
    return opened


def test_tcp_in_both_roles(site: Rover) -> None:
    with stream(site.lan) as server, stream(site.radio) as client, stream(site.radio) as stranger:
        server.bind((BOARD, 4000))
        server.listen()
        with site.router(TCP):
            one, peer = server.accept()
            one.settimeout(PATIENCE)
            assert peer[0] == LAN[0]
            stranger.bind((STRANGER, 0))
            with suppress(ConnectionResetError):  # before `connect` has returned, too
                stranger.connect((RADIO[0], 4444))
                assert stranger.recv(1) == b""
            client.bind((STATION, 0))
            client.connect((RADIO[0], 4444))
            wait_until(lambda: site.count("link_up", endpoint="two") == 1, "the connection")
            with one:
                one.sendall(bytes([len(DIAG)]) + DIAG)
                assert client.recv(100) == bytes([len(DIAG)]) + DIAG
            assert site.mismatches("boards") == 1


def plug_in(site: Rover) -> None:
    """Connect the rover and the board by a new cable, with link-local addresses."""
    site.rover.ip("link", "add", "lan0", "type", "veth", "peer", "name", "eth0", "netns", site.lan.namespace)
    for computer, interface, host in ((site.rover, "lan0", "fe80::1"), (site.lan, "eth0", "fe80::8")):
        computer.ip("link", "set", interface, "addrgenmode", "none")
        computer.ip("address", "add", f"{host}/64", "dev", interface, "nodad")
        computer.ip("link", "set", interface, "up")


@pytest.mark.slow
def test_tcp_over_a_cable_that_is_pulled_and_plugged_in_again(site: Rover) -> None:
    site.board.close()
    site.rover.ip("link", "del", "lan0")
    table = TCP.replace("[fd00:78:1::222]", "[fe80::8%lan0]").replace("[::]", "[fe80::1%lan0]")

    def board() -> socket.socket:
        return socket.create_server(socket_address("fe80::8%eth0", 4000), family=socket.AF_INET6)

    def connects() -> bool:
        try:
            site.lan.inside(lambda: socket.create_connection(("fe80::1%eth0", 4444), PATIENCE)).close()
        except OSError:
            return False
        return True

    with site.router(table.replace("fd00:78:2::10", "fe80::8%lan0")) as router:
        for turn in (1, 2):
            plug_in(site)
            with site.lan.inside(board) as server:
                server.settimeout(PATIENCE)
                server.accept()[0].close()
            wait_until(connects, "a connection to the rover")
            for endpoint in ("one", "two"):
                opened = partial(site.count, "link_openings_total", endpoint=endpoint)
                wait_until(lambda opened=opened, turn=turn: opened() >= turn, "its link")  # type: ignore[misc]
            site.rover.ip("link", "del", "lan0")
        assert "its network interface is not there" in router.text()
        assert "baud" not in router.text()


# ---- starts


def test_a_head_start_knows_the_boards(site: Rover) -> None:
    program = check_table(site.table(TABLE), {}).program or pytest.fail("the table has errors")
    image = Image(**marshal.loads(marshal.dumps(write_image(program).parts())))  # noqa: S302 - written here
    with closing(site.rover.inside(lambda: HeadStart(image, ()))):
        assert site.board.recv(100) == BRAKE
        drives(site)
