"""A board on a serial line, which is a pty: frames in both directions, and what happens when it is unplugged."""

from __future__ import annotations

import marshal
import os
import tty
from collections.abc import Iterator
from fcntl import LOCK_EX, LOCK_NB, LOCK_UN, flock
from pathlib import Path
from time import monotonic, sleep

import pytest
from structlog.testing import capture_logs

from router.app import Router
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.image.image import Image
from router.image.writer import write_image
from router.observe.senders import Senders
from router.observe.snapshot import snapshot
from router.startup_image.head_start import HeadStart
from tests.acceptance.site import wait_until
from tests.app.conftest import BRAKE, DRIVE, let_rest, numbered, udp
from tests.oracles.framings import BAD, Framing, decoded, encoded
from tests.ports import free_port
from tests.readable import readable
from tests.tables import PROTOS

COBS = Framing("cobs", "crc16_ccitt_false")
LIMIT = 16384


class Board:
    """What is at the other end of a pty, which is at `path` while it is plugged in."""

    def __init__(self, path: Path, framing: Framing = COBS) -> None:
        self.path, self.framing = path, framing
        self.plug_in()

    def plug_in(self) -> None:
        self.received = b""
        self.fd, device = os.openpty()
        tty.setraw(self.fd)
        self.path.symlink_to(os.ttyname(device))
        os.close(device)

    def unplug(self) -> None:
        self.path.unlink()
        os.close(self.fd)

    def send(self, *payloads: bytes) -> None:
        for payload in payloads:
            os.write(self.fd, encoded(self.framing, payload))

    def write(self, data: bytes) -> None:
        os.write(self.fd, data)

    def frames(self, timeout: float = 0.0) -> list[bytes | str]:
        """What has arrived since it was plugged in."""
        until = monotonic() + timeout
        while readable(self.fd, until - monotonic()):
            try:
                self.received += os.read(self.fd, 65536)
            except OSError:  # the router has not opened it yet
                break
        return decoded(self.framing, self.received, LIMIT)[0]

    def await_frames(self, count: int) -> list[bytes | str]:
        wait_until(lambda: len(self.frames()) >= count)
        return self.frames()


class Site:
    """A board on a serial line, an operator and a basestation on UDP."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.board = Board(folder / "uart")
        self.operator, self.basestation = udp("127.0.0.30"), udp("127.0.0.1")
        self.port = free_port()
        self.uart = f"serial: {self.board.path}, baud: 460800"

    def program(self, line: str = "framing: cobs, checksum: crc16_ccitt_false", deadman: str = "") -> CompiledTable:
        path = self.folder / "table.yaml"
        basestation = self.basestation.getsockname()[1]
        path.write_text(f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen:
  rover: {{address: "127.0.0.1:{self.port}"}}
  uart: {{{self.uart}, {line}}}
endpoints:
  operator: {{address: 127.0.0.30:8, kind: tool}}
  basestation: {{address: "127.0.0.1:{basestation}", kind: basestation}}
  board: {{listener: uart, kind: board}}
routes:
  ph_info: {{source: board, destinations: [basestation]}}
  manual_drive:
    source: operator
    destinations: [board]
    deadman: {{timeout: 200ms, repeat: 50ms, send: {{manual_brake: {{brake: true}}}}, to: [board]{deadman}}}
""")
        checked = check_table(path, {})
        assert checked.program is not None, "\n".join(map(str, checked.diagnostics))
        return checked.program

    def drive(self) -> None:
        self.operator.sendto(DRIVE, ("127.0.0.1", self.port))

    def close(self) -> None:
        self.operator.close()
        self.basestation.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    yield site
    site.close()


def counted(router: Router, metric: str, *labels: str) -> int:
    return int(snapshot(router.collect(), 0).counts(metric).get(labels, 0))


def test_frames_of_the_board_are_forwarded_as_datagrams(site: Site) -> None:
    with Router(site.program()) as router:
        site.board.await_frames(1)
        site.board.send(numbered(1), numbered(2))
        assert [site.basestation.recv(100) for _ in range(2)] == [numbered(1), numbered(2)]
        assert counted(router, "datagrams_received", "uart") == 2
        assert counted(router, "link_up", "board") == 1


def test_replies_to_the_board_are_frames(site: Site) -> None:
    site.program()
    path = site.folder / "table.yaml"
    replying = "ph_info: {source: board, reply: {ph_info: auto}, deadman: {none: replies move nothing}}"
    path.write_text(path.read_text().replace("ph_info: {source: board, destinations: [basestation]}", replying))
    program = check_table(path, {}).program
    assert program is not None
    with Router(program) as router:
        site.board.await_frames(1)
        site.board.received = b""
        site.board.send(numbered(7))
        wait_until(lambda: numbered(7) in site.board.frames())
        assert counted(router, "datagrams_sent", "ph_info", "board") == 1


def test_commands_reach_the_board_as_frames_and_its_deadman_brakes_when_they_stop(site: Site) -> None:
    with Router(site.program()):
        assert site.board.await_frames(1)[0] == BRAKE
        site.board.received = b""
        sent = monotonic()
        site.drive()
        assert site.board.await_frames(1) == [DRIVE]
        assert site.board.await_frames(2)[:2] == [DRIVE, BRAKE]
        assert monotonic() - sent >= 0.2


def test_bad_frames_are_counted_and_the_next_one_is_read(site: Site) -> None:
    flipped = bytearray(encoded(COBS, numbered(1)))
    flipped[2] ^= 0x55
    with Router(site.program()) as router:
        site.board.await_frames(1)
        site.board.write(bytes(flipped) + b"\x05\x01\x00" + b"\x01" * 20000 + b"\x00")
        site.board.send(numbered(2))
        assert site.basestation.recv(100) == numbered(2)
        assert counted(router, "datagrams_rejected", "uart", "bad_checksum") == 1
        assert counted(router, "datagrams_rejected", "uart", "bad_frame") == 2


def test_a_line_that_is_plugged_in_again_is_braked_first_and_gets_nothing_that_waited(site: Site) -> None:
    with capture_logs() as log, Router(site.program()) as router:
        site.board.await_frames(1)
        site.board.write(encoded(COBS, numbered(1))[:5])
        site.board.unplug()
        wait_until(lambda: not counted(router, "link_up", "board"))
        site.drive()
        wait_until(lambda: counted(router, "messages_dropped", "manual_drive", "board", "send_error") == 1)
        site.board.plug_in()
        assert site.board.await_frames(1)[0] == BRAKE
        wait_until(lambda: counted(router, "link_up", "board") == 1)
        assert counted(router, "link_openings", "board") == 2
        site.board.send(numbered(2))
        assert site.basestation.recv(100) == numbered(2)
        assert counted(router, "datagrams_rejected", "uart", "bad_frame") == 0
        assert DRIVE not in site.board.frames()
        site.drive()
        wait_until(lambda: DRIVE in site.board.frames())
    changes = [(each["event"].split(";")[0], each["endpoint"]) for each in log if "the link is" in each["event"]]
    closed, opened = ("the link is closed", "board"), ("the link is open", "board")
    assert changes[0] == changes[-1] == opened
    assert {*changes[1:-1]} == {closed}


def test_a_board_that_is_braked_when_it_is_plugged_in_need_not_have_been_commanded(site: Site) -> None:
    with Router(site.program()) as router:
        site.board.await_frames(1)
        site.board.unplug()
        wait_until(lambda: not counted(router, "link_up", "board"))
        site.board.plug_in()
        assert site.board.await_frames(1)[0] == BRAKE


def test_a_line_that_never_opens_keeps_nobody_else_waiting(site: Site) -> None:
    site.board.unplug()
    with Router(site.program()) as router:
        assert counted(router, "link_up", "board") == 0
        site.drive()
        wait_until(lambda: counted(router, "messages_dropped", "manual_drive", "board", "send_error") == 1)
        assert counted(router, "deadman_trips", "manual_drive") == 0  # what did not leave feeds nothing


def test_a_board_that_does_not_read_loses_its_own_commands_only_and_is_braked_first(site: Site) -> None:
    """What was half written is completed, then the deadman's frame comes: no frame is bad."""
    with Router(site.program()) as router:
        site.board.await_frames(1)
        while not counted(router, "messages_dropped", "manual_drive", "board", "send_buffer_full"):
            site.drive()
        wait_until(lambda: counted(router, "deadman_active", "manual_drive") == 1)
        sent = counted(router, "datagrams_sent", "manual_drive", "board")
        site.board.send(numbered(1))
        assert site.basestation.recv(100) == numbered(1)
        wait_until(lambda: site.board.frames()[-1] == BRAKE)
        frames = site.board.frames()
        assert BAD not in frames
        assert frames.count(DRIVE) == sent
        site.drive()
        wait_until(lambda: DRIVE in site.board.frames()[len(frames) :])


def test_a_payload_that_only_others_may_send_is_told_by_the_name_of_the_board(site: Site) -> None:
    with capture_logs() as log, Router(site.program()) as router:
        site.board.await_frames(1)
        site.board.send(DRIVE)
        wait_until(lambda: any("from the serial line" in each.get("detail", "") for each in log))
        senders = Senders(router.program, router.mismatches().keys(), {})
        assert senders.of("manual_drive") == [f"board ({site.board.path})"]


def test_a_frame_is_as_old_as_its_first_byte(site: Site) -> None:
    program = site.program()
    path = program.table.path
    path.write_text(path.read_text().replace("{source: board,", "{source: board, ttl: 100ms,"))
    checked = check_table(path, {})
    assert checked.program is not None
    frame = encoded(COBS, numbered(1))
    with Router(checked.program) as router:
        site.board.await_frames(1)
        site.board.write(frame[:3])
        sleep(0.15)
        site.board.write(frame[3:] + encoded(COBS, numbered(2)))
        assert site.basestation.recv(100) == numbered(2)
        assert counted(router, "messages_dropped", "ph_info", "basestation", "stale") == 1


@pytest.mark.parametrize(
    ("line", "framing"),
    [
        ("framing: slip", Framing("slip")),
        ("framing: hdlc", Framing("hdlc", "crc32")),
        ("framing: {hdlc: 7}, parity: even, stop_bits: 2", Framing("hdlc", "crc32", address=7)),
        ("framing: varint, checksum: crc8", Framing("varint", "crc8")),
        ("framing: {length: u16be}, checksum: {crc32: be}", Framing("u16be", "crc32", is_big_endian=True)),
    ],
    ids=str,
)
def test_framings_of_the_table(site: Site, line: str, framing: Framing) -> None:
    site.board.framing = framing
    with Router(site.program(line)):
        site.board.await_frames(1)
        site.board.send(numbered(1), numbered(2))
        assert [site.basestation.recv(100) for _ in range(2)] == [numbered(1), numbered(2)]
        site.drive()
        wait_until(lambda: DRIVE in site.board.frames())


def test_without_delimiters_a_bad_frame_has_the_line_opened_again(site: Site) -> None:
    site.board.framing = Framing("u16le")
    with Router(site.program("framing: {length: u16le}")) as router:
        site.board.await_frames(1)
        site.board.write(b"\xff\xff")
        wait_until(lambda: counted(router, "link_openings", "board") == 2)
        site.board.send(numbered(1))
        assert site.basestation.recv(100) == numbered(1)
        assert counted(router, "datagrams_rejected", "uart", "bad_frame") == 1


def test_a_device_that_another_process_has_is_not_opened(site: Site) -> None:
    with site.board.path.open("rb", buffering=0) as other:
        flock(other, LOCK_EX)
        with capture_logs() as log, Router(site.program()) as router:
            wait_until(lambda: any("another process has its device" in each.get("why", "") for each in log))
            assert counted(router, "link_up", "board") == 0
            flock(other, LOCK_UN)
            assert site.board.await_frames(1)[0] == BRAKE


def test_a_reload_opens_the_line_with_its_new_settings(site: Site) -> None:
    with Router(site.program()) as router:
        site.board.await_frames(1)
        path = site.program("framing: slip").table.path
        let_rest(path)
        router.reload()
        site.board.framing = Framing("slip")
        wait_until(lambda: counted(router, "link_openings", "board") == 2)
        site.board.received = b""
        site.board.send(numbered(1))
        assert site.basestation.recv(100) == numbered(1)
        site.drive()
        wait_until(lambda: DRIVE in site.board.frames())


def test_armed_deadmen_send_at_the_stop(site: Site) -> None:
    with Router(site.program()):
        site.board.await_frames(1)
        site.drive()
        wait_until(lambda: DRIVE in site.board.frames())
    assert site.board.frames()[-1] == BRAKE


def test_a_head_start_opens_the_line_and_the_router_goes_on_with_it(site: Site) -> None:
    program = site.program()
    image = Image(**marshal.loads(marshal.dumps(write_image(program).parts())))  # noqa: S302 - written here
    head_start = HeadStart(image, ())
    assert site.board.await_frames(1)[0] == BRAKE
    site.board.send(numbered(1))
    assert site.basestation.recv(100) == numbered(1)
    with Router(program, head_start=head_start) as router:
        site.board.send(numbered(2))
        assert site.basestation.recv(100) == numbered(2)
        assert counted(router, "link_openings", "board") == 1
        site.drive()
        wait_until(lambda: DRIVE in site.board.frames())
    assert site.board.frames()[-1] == BRAKE


def test_a_head_start_that_ends_closes_the_line(site: Site) -> None:
    head_start = HeadStart(write_image(site.program()), ())
    assert site.board.await_frames(1)[0] == BRAKE
    head_start.close()
    with site.board.path.open("rb", buffering=0) as other:
        flock(other, LOCK_EX | LOCK_NB)


def test_nothing_of_a_board_is_lost_while_another_line_flaps(site: Site, tmp_path: Path) -> None:
    """Nor is a datagram over UDP."""
    other = Board(tmp_path / "other")
    path = site.program().table.path
    text = path.read_text().replace(
        "listen:\n", f"listen:\n  flaps: {{serial: {other.path}, baud: 9600, framing: slip}}\n"
    )
    path.write_text(text.replace("endpoints:\n", "endpoints:\n  lander: {listener: flaps, kind: board}\n"))
    program = check_table(path, {}).program
    assert program is not None
    with Router(program) as router:
        wait_until(lambda: counted(router, "link_up", "lander") == counted(router, "link_up", "board") == 1)
        site.board.await_frames(1)
        for number in range(300):
            if number % 100 == 50:
                other.unplug()
                other.plug_in()
            site.board.send(numbered(number))
            site.drive()
            assert site.basestation.recv(100) == numbered(number)
        wait_until(lambda: site.board.frames().count(DRIVE) == 300)
        assert counted(router, "datagrams_rejected", "uart", "bad_frame") == 0
