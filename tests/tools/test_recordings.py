"""`router record` beside a router, and `router replay`: what is in the file, what is sent, what is said otherwise."""

from __future__ import annotations

import math
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from router.cli import main
from router.errors import UsageError
from router.observe.tap import Lost
from router.recording.reader import Recorded, Recording
from router.table import read_table
from router.tools import recordings
from router.tools.links import Device, boards_at, router_ends
from router.tools.recordings import TapRecording, on_time
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.recording.recorder_rig import MILLISECOND, START, again, imu, read, recorded, seen, wire
from tests.recording.recorder_rig import table as rig_table
from tests.tables import PROTOS
from tests.tools.conftest import place

BOARD, STRANGER = ("127.0.6.30", 40001), ("127.0.6.99", 40002)
ELSEWHERE = ("198.51.100.7", 5000)
BATCHES = (
    seen(imu(1), b"no envelope", imu(2).rstrip(b"\0") + bytes(7), peer=BOARD),
    seen(imu(3), b"", imu(4), at=START + 50 * MILLISECOND, peer=STRANGER, reason="source_mismatch"),
)
SENT = [each.data for batch in BATCHES for each in batch]
TAPPED = seen(imu(1), b"bad", imu(2))

TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
  {listener}: {{address: 0.0.0.0:{port}}}
endpoints:
  sensor_board: {{address: 127.0.6.31:8, kind: board}}
routes: {{}}
"""


def received(receiver: socket.socket, count: int) -> list[tuple[bytes, str]]:
    return [(data, host) for data, (host, _) in (receiver.recvfrom(65536) for _ in range(count))]


def table(folder: Path, port: int, listener: str = "rover") -> str:
    path = folder / "table.yaml"
    path.write_text(TABLE.format(protos=PROTOS, port=port, listener=listener))
    return str(path)


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)  # where there is no table
    return recorded(tmp_path / "it.mcap", *BATCHES)


def test_every_datagram_is_sent_again_from_where_it_came(
    path: Path, receiver: socket.socket, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(path), "--to", place(receiver), "--speed", "max"]) == 0
    assert received(receiver, 6) == [(data, BOARD[0]) for data in SENT[:3]] + [(data, STRANGER[0]) for data in SENT[3:]]
    captured = capsys.readouterr()
    assert captured.out == "sent 6 datagrams\n"
    assert captured.err == ""


def test_a_table_says_where_to_and_where_its_endpoints_are(
    tmp_path: Path, receiver: socket.socket, capsys: pytest.CaptureFixture[str]
) -> None:
    receiver.close()
    path = recorded(tmp_path / "it.mcap", seen(imu(), b"bad"), seen(imu(), peer=STRANGER))  # the rig's sensor_board
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5)
        words = ["--table", table(tmp_path, listener.getsockname()[1]), "--speed", "max"]
        assert main(["replay", str(path), *words]) == 0
        assert [host for _, host in received(listener, 3)] == ["127.0.6.31", "127.0.6.31", STRANGER[0]]


def test_ipv6_senders_are_recorded_and_sent_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One is link-local, and has no such address on this computer."""
    monkeypatch.chdir(tmp_path)  # where there is no table
    ours, other = ("::1", free_port("::1")), ("fe80::7%lo", 40002)
    path = recorded(
        tmp_path / "it.mcap",
        seen(imu(1), b"bad", peer=ours),
        seen(imu(2), b"worse", at=START + MILLISECOND, peer=other),
    )
    with closing(Recording(path)) as recording:
        assert [each.peer for each in recording.datagrams()] == [ours, ours, other, other]
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as listener:
        listener.bind(("::1", 0))
        listener.settimeout(5)
        assert main(["replay", str(path), "--to", place(listener), "--speed", "max"]) == 0
        arrived = [listener.recvfrom(65536) for _ in range(4)]
    assert [data for data, _ in arrived] == [imu(1), b"bad", imu(2), b"worse"]
    assert [address[:2] == ours for _, address in arrived] == [True, True, False, False]
    assert "does not have the addresses of [fe80::7%lo]:40002 (fe80::7%lo)" in capsys.readouterr().err


def test_one_address_for_all_senders(path: Path, receiver: socket.socket) -> None:
    assert main(["replay", str(path), "--to", place(receiver), "--speed", "max", "--from", "127.0.6.77"]) == 0
    assert {host for _, host in received(receiver, 6)} == {"127.0.6.77"}


def test_an_address_that_this_computer_lacks_is_told(
    tmp_path: Path, receiver: socket.socket, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = recorded(tmp_path / "it.mcap", seen(imu(), peer=ELSEWHERE))
    assert main(["replay", str(path), "--to", place(receiver), "--speed", "max"]) == 0
    assert [data for data, _ in received(receiver, 1)] == [imu()]
    assert "does not have the addresses of 198.51.100.7:5000 (198.51.100.7)" in capsys.readouterr().err


def test_nobody_who_listens_is_an_error(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(path), "--to", f"127.0.6.5:{free_port('127.0.6.5')}", "--speed", "max"]) == 1
    assert "nobody listened" in capsys.readouterr().err


def test_a_listener_that_the_table_lacks_is_told(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(path), "--table", table(tmp_path, 5000, "rovers")]) == 2
    assert (
        "the table does not have the listener 'rover' of the recording\nhelp: did you mean 'rovers'?"
        in capsys.readouterr().err
    )
    assert main(["replay", str(path)]) == 2
    assert "give --to" in capsys.readouterr().err


def test_a_recording_that_was_cut_is_sent_as_far_as_it_goes(
    path: Path, receiver: socket.socket, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = recorded(path.parent / "cut.mcap", *BATCHES, finish=False)
    assert main(["replay", str(cut), "--to", place(receiver), "--speed", "max"]) == 0
    assert len(received(receiver, 6)) == 6
    assert "was not finished" in capsys.readouterr().err


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Its only element is what `time.monotonic` says, which moves while somebody sleeps."""
    now = [1000.0]
    monkeypatch.setattr(time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize("speed", [1.0, 10.0, math.inf])
def test_datagrams_are_due_when_they_came(path: Path, clock: list[float], speed: float) -> None:
    sent = [clock[0] - 1000 for _ in on_time(Recording(path), speed)]
    steps = [0, 0.001, 0.002, 0.05, 0.051, 0.052]
    assert sent == pytest.approx([step / speed for step in steps])


def test_a_recording_that_is_slow_to_open_does_not_hurry_what_comes_first(
    path: Path, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = Recording(path)
    datagrams = list(recording.datagrams())

    def slowly() -> Iterator[Recorded]:
        clock[0] += 5
        yield from datagrams

    monkeypatch.setattr(recording, "datagrams", slowly)
    assert [clock[0] for _ in on_time(recording, 1.0)][:3] == pytest.approx([1005, 1005.001, 1005.002])


def recording(path: Path) -> TapRecording:
    return TapRecording(path, wire().envelopes, rig_table())


def test_what_the_tap_shows_is_in_the_file_and_what_it_lost_is_counted(tmp_path: Path) -> None:
    with closing(recording(tmp_path / "it.mcap")) as made:
        made.take(TAPPED[:1])
        made.take([Lost(7), *TAPPED[1:]])
        made.take([])
    assert (made.datagrams, made.missed) == (3, 7)
    assert [again(each) for each in read(tmp_path / "it.mcap")] == TAPPED
    assert made.size == (tmp_path / "it.mcap").stat().st_size


def test_what_came_is_written_before_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "PERIOD", 0)
    with closing(recording(tmp_path / "it.mcap")) as made:
        made.take(TAPPED)
        assert [again(each) for each in read(tmp_path / "it.mcap")] == TAPPED


def test_a_file_that_is_there_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "it.mcap").write_text("mine")
    with pytest.raises(UsageError, match="exists; choose another name"):
        recording(tmp_path / "it.mcap")
    assert (tmp_path / "it.mcap").read_text() == "mine"


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot write .*: No such file or directory"):
        recording(tmp_path / "nowhere" / "it.mcap")


LINE_TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
  uart: {{serial: {device}, baud: 460800, framing: cobs}}
endpoints:
  sensor_board: {{listener: uart, kind: board}}
routes: {{}}
"""


@pytest.mark.parametrize("place", [("uart", ("0.0.0.0", 0)), ("rover", BOARD)], ids=["of the line", "of another table"])
def test_frames_are_sent_at_the_other_end_of_a_line(tmp_path: Path, place: tuple[str, tuple[str, int]]) -> None:
    """As soon as the router has opened it."""
    listener, peer = place
    frames = seen(imu(1), b"bad", imu(2), peer=peer)
    path = recorded(
        tmp_path / "it.mcap", [each._replace(listener=listener, endpoint="sensor_board") for each in frames]
    )
    (tmp_path / "table.yaml").write_text(LINE_TABLE.format(protos=PROTOS, device=tmp_path / "uart"))
    (line,) = read_table(tmp_path / "table.yaml").lines
    verb = "replay", str(path), "-t", str(tmp_path / "table.yaml"), "--speed", "max"
    command = [sys.executable, "-m", "router", *verb]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as replay:
        assert replay.stderr is not None
        waiting = f"waiting for the router to open {tmp_path}/uart; press Ctrl-C to stop\n"
        assert replay.stderr.readline() == waiting
        with closing(Device(line)) as device:
            got: list[bytes] = []
            while len(got) < 3:
                got += [frame.data for frame in device.receive()]
            out, err = replay.communicate(timeout=30)
    assert got == [imu(1), b"bad", imu(2)]
    assert (out, err) == ("sent 3 datagrams\n", "")


TCP_TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
  tcp: {{accept: "127.0.0.1:{port}", framing: {{length: u16le}}}}
endpoints:
  sensor_board: {{listener: tcp, address: 127.0.6.30, kind: board}}
  drill: {{listener: tcp, address: 127.0.6.31, kind: board}}
routes: {{}}
"""


@pytest.mark.parametrize("listener", ["tcp", "rover"], ids=["of the server", "of another table"])
def test_frames_are_sent_by_the_boards_of_a_tcp_server(tmp_path: Path, listener: str) -> None:
    frames = [each._replace(listener=listener, endpoint="sensor_board") for each in seen(imu(1), b"bad", peer=BOARD)]
    drill = [each._replace(listener="tcp", endpoint="drill") for each in seen(imu(2), peer=("127.0.6.31", 0))]
    path, table_path = recorded(tmp_path / "it.mcap", [*frames, *drill]), tmp_path / "table.yaml"
    table_path.write_text(TCP_TABLE.format(protos=PROTOS, port=free_port(kind=socket.SOCK_STREAM)))
    table = read_table(table_path)
    (server,) = table.links
    ends = router_ends(server, boards_at(server, table))
    command = [sys.executable, "-m", "router", "replay", str(path), "-t", str(table_path), "--speed", "max"]
    got: list[list[bytes]] = [[], []]

    def arrived() -> bool:
        for end, frames in zip(ends, got, strict=True):
            if end.is_open:
                with suppress(ConnectionResetError):  # at the end
                    frames += [frame.data for frame in end.receive()]
        return sum(map(len, got)) == 3

    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as replay:
        try:
            wait_until(arrived)
            assert replay.communicate(timeout=30)[0] == "sent 3 datagrams\n"
        finally:
            for end in ends:
                end.close()
            replay.kill()
    assert got == [[imu(1), b"bad"], [imu(2)]]


def test_a_line_whose_device_is_there_is_told_when_it_is_needed(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "uart").touch()
    (tmp_path / "table.yaml").write_text(LINE_TABLE.format(protos=PROTOS, device=tmp_path / "uart"))
    assert main(["replay", str(path), "-t", str(tmp_path / "table.yaml"), "--speed", "max"]) == 2
    assert "the table does not have the listener 'rover'" in capsys.readouterr().err
    on_line = recorded(
        tmp_path / "line.mcap", [each._replace(listener="uart") for each in seen(imu(), peer=("0.0.0.0", 0))]
    )
    assert main(["replay", str(on_line), "-t", str(tmp_path / "table.yaml"), "--speed", "max"]) == 2
    assert "uart is there already, so the other end of 'uart' cannot be played" in capsys.readouterr().err
