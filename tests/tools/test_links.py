"""Both ends of a serial line: the device as the router opens it, and the pty at which the other end is played."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest

from router.app import Router
from router.carrier.frames import Frame
from router.cli import main
from router.compiler import check_table
from router.datagrams import Wire
from router.errors import UsageError
from router.recording.mirror import Mirrored, MirroredDatagram
from router.table import read_table
from router.table.model.endpoints import Listener
from router.tools.board import State
from router.tools.links import Device, Pty
from router.tools.simulator import Simulator, parse_silence
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.tables import PROTOS

EMPTY_PLAIN, EVERY_KIND = bytes.fromhex("1200"), bytes.fromhex("0a021005")


@pytest.fixture
def line(line_path: Path) -> Listener:
    return read_table(line_path).lines[0]


def received(end: Device | Pty, count: int) -> list[Frame]:
    frames: list[Frame] = []

    def are_there() -> bool:
        frames.extend(end.receive())
        return len(frames) >= count

    wait_until(are_there)
    return frames


def test_frames_go_from_one_end_to_the_other(line: Listener) -> None:
    with closing(Pty(line)) as pty, closing(Device(line)) as device:
        assert pty.is_open
        device.send(EMPTY_PLAIN)
        device.send(EVERY_KIND)
        assert received(pty, 2) == [Frame(EMPTY_PLAIN), Frame(EVERY_KIND)]
        pty.send(EMPTY_PLAIN)
        assert received(device, 1) == [Frame(EMPTY_PLAIN)]
        assert device.receive() == []


def test_a_pty_that_nobody_has_opened_takes_nothing(line: Listener) -> None:
    with closing(Pty(line)) as pty:
        assert not pty.is_open
        with pytest.raises(OSError, match="nobody has opened"):
            pty.send(EMPTY_PLAIN)
        Device(line).close()
        with pytest.raises(OSError, match="nobody has opened"):
            pty.send(EMPTY_PLAIN)


def test_a_full_line_says_so_and_no_frame_is_cut(line: Listener) -> None:
    with closing(Pty(line)) as pty, closing(Device(line)) as device:
        sent = 0
        with suppress(BlockingIOError):
            while True:
                pty.send(bytes(1000) + b"frame")
                sent += 1
        frames: list[Frame] = []
        while len(frames) < sent:
            frames += device.receive()
            with suppress(BlockingIOError):
                pty.send(EMPTY_PLAIN)
        assert {*frames} <= {Frame(bytes(1000) + b"frame"), Frame(EMPTY_PLAIN)}


def test_a_link_that_a_killed_simulator_left_is_replaced(line: Listener) -> None:
    Path(line.address.value.host).symlink_to("/dev/pts/none")
    with closing(Pty(line)), closing(Device(line)):
        pass
    assert not Path(line.address.value.host).is_symlink()


def test_a_folder_without_permission_is_told(line_path: Path) -> None:
    line_path.write_text(line_path.read_text().replace(f"{line_path.parent}/uart", "/dev/no/folder/uart"))
    with pytest.raises(UsageError, match=r"cannot make /dev/no/folder/uart.*: No such file") as raised:
        Pty(read_table(line_path).lines[0])
    assert "such as /tmp/uart" in raised.value.hint


def test_a_device_that_another_has_is_told_with_its_name(line: Listener) -> None:
    taking = "import sys; from tests.tools.test_links import take; take(*sys.argv[1:])"
    with closing(Pty(line)):
        command = [sys.executable, "-c", taking, str(line.address.value.host)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == "taken\n"
            with pytest.raises(UsageError, match=rf"'uart': cannot open .*: \S+ \(pid {other.pid}\) has it"):
                Device(line)
            other.communicate("")


def take(device: str) -> None:
    """Have a device until the input ends."""
    from fcntl import LOCK_EX, flock

    with Path(device).open("rb", buffering=0) as file:
        flock(file, LOCK_EX)
        print("taken", flush=True)
        sys.stdin.read()


@contextmanager
def verb(*words: str | Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "router", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def opened(line: Listener) -> Device:
    """Open the device of a line like the router, as soon as it is there."""
    wait_until(Path(line.address.value.host).exists)
    return Device(line)


def test_send_plays_the_board_for_the_router(line: Listener, line_path: Path) -> None:
    words = ["send", "every_kind", "i32=5", "--to", "uart", "--count", "3"]
    with verb(*words, "-t", line_path) as sender, closing(opened(line)) as device:
        assert received(device, 3) == [Frame(EVERY_KIND)] * 3
        out, err = sender.communicate(timeout=30)
    assert out.startswith("sent every_kind to uart 3 times")
    assert err == f"waiting for the router to open {line.address.value.host}; press Ctrl-C to stop\n"
    assert sender.returncode == 0


def test_send_sends_to_the_board_as_the_router_does(
    line: Listener, line_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["send", "plain", "--to", "board", "-t", str(line_path)]
    assert main(words) == 2
    assert "'uart': cannot open" in capsys.readouterr().err
    with closing(Pty(line)) as board:
        assert main(words) == 0
        assert received(board, 1) == [Frame(EMPTY_PLAIN)]
    assert capsys.readouterr().out == "sent plain to board: 2 bytes 1200\n"
    assert main([*words, "--from", "station"]) == 2
    assert "what is sent to 'board' is not from station" in capsys.readouterr().err


def test_listen_shows_what_the_board_gets(line: Listener, line_path: Path) -> None:
    words = ["listen", "envelope://board", "--count", "1"]
    with verb(*words, "-t", line_path) as tap, closing(opened(line)) as device:
        device.send(EMPTY_PLAIN)
        out, _ = tap.communicate(timeout=30)
    assert out.split(" ", 1)[1] == "uart plain (all default)\n"


def test_listen_shows_what_the_board_sends_also_bad_frames(line: Listener, line_path: Path) -> None:
    with closing(Pty(line)) as board, verb("listen", "envelope://uart", "-t", line_path, "--count", "2") as tap:
        wait_until(lambda: board.is_open)
        os.write(board.fileno(), b"\x05\x01\x00")
        board.send(EMPTY_PLAIN)
        out, err = tap.communicate(timeout=30)
    shown = [line.split(" ", 1)[1] for line in out.splitlines()]
    assert shown == ["board undecodable (bad_frame): 050100", "board plain (all default)"]
    assert err == f"listening to {line.address.value.host}; press Ctrl-C to stop\n"


def test_listen_ends_when_the_device_is_unplugged(line: Listener, line_path: Path) -> None:
    board = Pty(line)
    with verb("listen", "envelope://uart", "-t", line_path) as tap:
        wait_until(lambda: board.is_open)
        board.close()
        _, err = tap.communicate(timeout=30)
    assert "'uart' is closed: its device was unplugged" in err
    assert tap.returncode != 0


def test_a_router_and_a_simulated_board_on_one_machine(tmp_path: Path) -> None:
    """The board sends and obeys, and halts when the commands stop. What the router receives can be recorded."""
    (tmp_path / "table.yaml").write_text(f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen:
  rover: {{address: "127.0.0.1:{free_port()}"}}
  uart: {{serial: {tmp_path}/uart, baud: 460800, framing: {{length: u16be}}, checksum: crc32}}
endpoints:
  operator: {{address: "127.0.6.10:{free_port("127.0.6.10")}", kind: tool}}
  lander: {{listener: uart, kind: board}}
routes:
  ph_info: {{source: lander, destinations: [operator]}}
  manual_drive:
    source: operator
    destinations: [lander]
    deadman: {{timeout: 200ms, repeat: 50ms, send: {{manual_brake: {{brake: true}}}}, to: [lander]}}
""")
    program = check_table(tmp_path / "table.yaml", {}).program
    assert program is not None
    wire, silence = Wire(program.envelopes), parse_silence("operator:2-30")
    simulator = Simulator(wire, program.table, 1, deadmen=program.deadmen, silences=[silence])
    inboxes, mirrored = simulator.statistics.inboxes, list[Mirrored]()

    def look(_: float) -> None:
        states = [change.state for change in simulator.statistics.changes]
        if inboxes["operator"].arrivals and State.OBEYING in states and states[-1] is State.HALTED:
            simulator.stop()

    with closing(simulator), Router(program) as router:
        detach = router.mirror.attach(mirrored.extend)
        assert simulator.run(20, 0.05, look) < 20
        detach()
    assert ("uart", "lander") in {
        (datagram.listener, datagram.endpoint) for datagram in map(MirroredDatagram._make, mirrored)
    }
    assert inboxes["lander"].undecodable == 0
