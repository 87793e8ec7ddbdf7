"""The board of docs/guides/serial-line.md with the page's table: its C code on a line that is damaged and unplugged."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
import sys
import threading
import tty
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from urllib.request import urlopen

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.carrier.build import compile_c
from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.site import ROOT, RouterProcess, key, samples_in, wait_until
from tests.boards.board import skip_without_nanopb
from tests.docs_commands import blocks, written
from tests.oracles.framings import BAD, BAD_CHECKSUM, Framing, decoded, encoded
from tests.ports import free_port
from tests.readable import readable

PAGE = ROOT / "docs/guides/serial-line.md"
FRAMING = Framing("cobs", "crc16_ccitt_false")
SPEED_30, STOP = bytes.fromhex("1202083c"), bytes.fromhex("1200")
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Werror")
TOPICS = {"drill/depth": "std_msgs/msg/Float32", "drill/bad_frames": "std_msgs/msg/UInt32"}


class Wire:
    """One direction of a cable. It passes whole frames, and flips a bit of those that are to be `damaged`."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.damaged = 0
        self._partial = b""

    def passed(self, data: bytes) -> bytes:
        *frames, self._partial = (self._partial + data).split(b"\0")
        for number, frame in enumerate(frames):
            if self.damaged and frame:
                self.damaged -= 1
                frames[number] = frame[:2] + bytes([frame[2] ^ (0x40 if frame[2] != 0x40 else 0x20)]) + frame[3:]
            self.frames.append(frames[number])
        return b"".join(frame + b"\0" for frame in frames)

    def payloads(self) -> list[bytes | str]:
        return decoded(FRAMING, b"\0".join([*self.frames, b""]), 100)[0]


class Cable:
    """Connects the pty of the board with one that the router opens at `device` while it is plugged in."""

    def __init__(self, board: Path, device: Path) -> None:
        self._board = os.open(board, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._device, self._plug = device, -1
        self._lock, self._end = threading.Lock(), threading.Event()
        self.to_router, self.to_board = Wire(), Wire()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def plug_in(self) -> None:
        plug, device = os.openpty()
        tty.setraw(plug)
        os.set_blocking(plug, False)
        with self._lock:
            self._plug = plug
        self._device.symlink_to(os.ttyname(device))
        os.close(device)

    def pull(self) -> None:
        self._device.unlink()
        with self._lock:
            os.close(self._plug)
            self._plug = -1

    def close(self) -> None:
        self._end.set()
        self._thread.join(PATIENCE)
        self.pull()
        os.close(self._board)

    def _carry(self) -> None:
        while not self._end.wait(0.001):
            with self._lock:
                self._pass_on(self._board, self._plug, self.to_router)
                self._pass_on(self._plug, self._board, self.to_board)

    def _pass_on(self, source: int, to: int, wire: Wire) -> None:
        """What nobody takes is lost."""
        if source < 0 or not readable(source):
            return
        try:
            data = wire.passed(os.read(source, 4096))
            if to >= 0:
                os.write(to, data)
        except OSError:  # the other end is not open
            return


@dataclass
class Site:
    """The running board, what it printed, and the cable to the router."""

    folder: Path
    table: Path
    metrics: int
    board: subprocess.Popen[str]
    cable: Cable
    printed: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.board.stdout is not None
        with self.board.stdout as lines:
            self.printed.extend(line.rstrip("\n") for line in lines)

    def close(self) -> None:
        self.cable.close()
        self.board.kill()
        self.board.wait()
        self._reader.join(PATIENCE)

    def router(self) -> RouterProcess:
        return RouterProcess(self.folder, self.table, DRILL=str(self.folder / "drill"))

    def samples(self) -> Counter[str]:
        with urlopen(f"http://127.0.0.1:{self.metrics}/metrics", timeout=PATIENCE) as page:
            return Counter({name: int(value) for name, value in samples_in(page.read().decode()).items()})

    def rejected(self, reason: str) -> int:
        return self.samples()[key("datagrams_rejected_total", listener="drill_line", reason=reason)]

    def is_up(self) -> bool:
        return self.samples()[key("link_up", endpoint="drill_board")] == 1


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the page, in a folder with the program `board`."""
    skip_without_nanopb()
    folder = tmp_path_factory.mktemp("drill")
    for name, text in written(PAGE).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    generator = [sys.executable, "-m", "nanopb.generator.nanopb_generator", "-q", "-I", "protos", "-D", "."]
    subprocess.run([*generator, "drill.proto"], cwd=folder, check=True, capture_output=True, timeout=PATIENCE)
    sources = [str(folder / name) for name in ("board.c", "frames.c", "drill.pb.c")]
    headers = [f"-I{folder}", "-idirafter/usr/include/nanopb"]
    compile_c(["-U_GNU_SOURCE", *WARNINGS, *headers, *sources, "-lprotobuf-nanopb", "-o", str(folder / "board")])
    return folder


@pytest.fixture
def site(firmware: Path, tmp_path: Path) -> Iterator[Site]:
    metrics = free_port()
    table = firmware / "drill.yaml"
    own = tmp_path / "table.yaml"
    own.write_text(f"version: 1\nextends: {table}\nhttp: {{address: 127.0.0.1:{metrics}}}\n")
    board = subprocess.Popen([firmware / "board"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    wait_until((tmp_path / "uart").exists)
    site = Site(tmp_path, own, metrics, board, Cable(tmp_path / "uart", tmp_path / "drill"))
    site.cable.plug_in()
    yield site
    site.close()


def next_after(first: bytes | str, found: Sequence[bytes | str]) -> bytes | str | None:
    return next((after for before, after in pairwise(found) if before == first), None)


def test_telemetry_is_published_and_commands_turn_the_drill_until_they_stop(site: Site) -> None:
    with site.router(), RosPeer(TOPICS) as peer:
        assert peer.receive_on("drill/depth") == {"data": 1.5}
        wait_until(lambda: site.printed[:1] == ["speed 0"])
        assert set(site.cable.to_board.payloads()) == {STOP}  # the deadman, since the line opened
        peer.open_heard({"drill/speed": "std_msgs/msg/Int32"})
        peer.say("drill/speed", {"data": 30})
        wait_until(lambda: next_after(SPEED_30, site.cable.to_board.payloads()) == STOP)
        wait_until(lambda: next_after("speed 30", site.printed) == "speed 0")
        assert peer.receive_on("drill/bad_frames") == {"data": 0}


def test_damaged_frames_are_dropped_and_counted_at_both_ends(site: Site) -> None:
    with site.router(), RosPeer(TOPICS) as peer:
        peer.open_heard({"drill/speed": "std_msgs/msg/Int32"})
        site.cable.to_router.damaged = 3
        wait_until(lambda: site.rejected("bad_checksum") + site.rejected("bad_frame") == 3)
        assert peer.receive_on("drill/depth") == {"data": 1.5}
        site.cable.to_board.damaged = 1
        peer.say("drill/speed", {"data": 30})
        while peer.receive_on("drill/bad_frames") != {"data": 1}:
            pass
        assert "speed 30" not in site.printed
        peer.say("drill/speed", {"data": 30})
        wait_until(lambda: "speed 30" in site.printed)


def test_a_board_that_is_plugged_in_again_is_stopped_before_it_gets_commands(site: Site) -> None:
    with site.router(), RosPeer(TOPICS) as peer:
        peer.open_heard({"drill/speed": "std_msgs/msg/Int32"})
        peer.say("drill/speed", {"data": 30})
        wait_until(lambda: "speed 30" in site.printed)
        site.cable.pull()
        wait_until(lambda: not site.is_up())
        peer.say("drill/speed", {"data": 30}, {"data": 30})
        lost = key("messages_dropped_total", route="drill", target="drill_board", reason="send_error")
        wait_until(lambda: site.samples()[lost] == 2)
        wait_until(lambda: site.printed[-1] == "speed 0")  # by itself
        site.cable.to_board.frames.clear()
        site.cable.plug_in()
        wait_until(site.is_up)
        wait_until(lambda: bool(site.cable.to_board.payloads()))
        assert set(site.cable.to_board.payloads()) == {STOP}
        peer.say("drill/speed", {"data": 30})
        wait_until(lambda: site.printed[-1] == "speed 30")
        at = site.samples()[key("messages_published_total", route="drill_state", topic="drill/depth")]
        wait_until(
            lambda: site.samples()[key("messages_published_total", route="drill_state", topic="drill/depth")] > at
        )
        assert site.samples()[key("link_openings_total", endpoint="drill_board")] == 2
        assert site.rejected("bad_frame") == 0


def test_the_board_stops_when_the_router_dies(site: Site) -> None:
    with site.router() as router, RosPeer() as peer:
        peer.open_heard({"drill/speed": "std_msgs/msg/Int32"})
        peer.say("drill/speed", {"data": 30})
        wait_until(lambda: site.printed[-1] == "speed 30")
        router.stop(signal.SIGKILL)
        wait_until(lambda: site.printed[-1] == "speed 0")


def test_the_frame_on_the_page_is_the_one_of_speed_30() -> None:
    [shown] = [block for block in blocks(PAGE) if block.language == "text" and "the envelope" in "".join(block.lines)]
    columns = [re.match(r" *((?:[0-9a-f]{2} ?)+) ", line) for line in shown.lines]
    assert bytes.fromhex("".join(found[1] for found in columns if found)) == encoded(FRAMING, SPEED_30)


LONG = 600
"""Bytes of the largest payload here, which takes several blocks of COBS."""


class Frames:
    """The page's frames.c, as a library for longer payloads."""

    def __init__(self, folder: Path) -> None:
        files = written(PAGE)
        (folder / "frames.h").write_text(files["frames.h"].replace("MAX_PAYLOAD = 64", f"MAX_PAYLOAD = {LONG}"))
        (folder / "frames.c").write_text(files["frames.c"])
        compile_c([*WARNINGS, "-shared", "-fPIC", str(folder / "frames.c"), "-o", str(folder / "frames.so")])
        library = ctypes.CDLL(str(folder / "frames.so"))
        self._write, self._read = library.frame_write, library.frame_read
        self._write.argtypes = (ctypes.c_char_p, ctypes.c_size_t, ctypes.c_char_p)
        self._write.restype = ctypes.c_size_t
        self._read.argtypes = (ctypes.c_void_p, ctypes.c_uint8)
        self.longest = LONG + (LONG + 2) // 254 + 4

    def written(self, payload: bytes) -> bytes:
        frame = ctypes.create_string_buffer(self.longest + 8)
        size = self._write(payload, len(payload), frame)
        return frame.raw[:size]

    def read(self, stream: bytes) -> list[bytes]:
        reader = ctypes.create_string_buffer(self.longest + 64)
        return [reader.raw[:size] for byte in stream if (size := self._read(reader, byte)) >= 0]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    return Frames(tmp_path_factory.mktemp("frames"))


payloads = st.one_of(
    st.binary(max_size=LONG),
    st.integers(0, LONG).map(lambda size: b"\1" * size),
    st.tuples(st.integers(0, 300), st.integers(0, 299)).map(lambda sizes: b"\1" * sizes[0] + b"\0" + b"\2" * sizes[1]),
)


@given(st.lists(payloads, max_size=4))
def test_the_boards_frames_are_read_by_the_oracle_and_fit(frames: Frames, sent: list[bytes]) -> None:
    stream = [frames.written(payload) for payload in sent]
    assert all(len(frame) <= frames.longest for frame in stream)
    assert decoded(FRAMING, b"".join(stream), LONG)[0] == sent
    assert frames.read(b"".join(encoded(FRAMING, payload) for payload in sent)) == sent


streams = st.lists(payloads).map(lambda each: b"".join(encoded(FRAMING, payload) for payload in each))


@given(st.one_of(st.binary(max_size=2000), streams), st.integers(0), st.integers(0, 255))
def test_the_board_reads_what_the_oracle_reads_of_damaged_streams(
    frames: Frames, stream: bytes, at: int, byte: int
) -> None:
    if stream:
        at %= len(stream)
        stream = stream[:at] + bytes([byte]) + stream[at + 1 :]
    good = [payload for payload in decoded(FRAMING, stream, LONG)[0] if payload not in (BAD, BAD_CHECKSUM)]
    assert frames.read(stream) == good
