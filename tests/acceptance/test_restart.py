"""Restarts under load of a router whose sockets belong to the service manager: what arrives meanwhile is not lost."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest

from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.service_manager import ServiceManager, make_room, room_of
from tests.acceptance.site import ROOT, udp, wait_until
from tests.ports import free_port

RATE = 2000
"""Datagrams per second and listener."""

BATCH = 20
STREAM = 1_000_000
"""The numbers of one stream are less than this apart."""

ROOM = 4 << 20
"""Bytes of the kernel for what comes within some seconds at that rate."""

HOSTS = ("127.0.0.5", "127.0.0.6")

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
listen: {{{listeners}}}
endpoints:
  driving_board: {{address: "127.0.0.222:{board}", kind: board}}
  basestation: {{address: "127.0.0.10:{basestation}", kind: basestation}}
routes:
  ph_info: {{source: any, destinations: [basestation]}}
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 1s
    deadman: {{timeout: 1h, send: {{manual_brake: {{brake: true}}}}, to: [driving_board]}}
  manual_arm: {{source: basestation, destinations: [driving_board], deadman: {{none: never stale}}}}
"""


def envelope(case: str, **values: object) -> bytes:
    return sample(case, WIRE.envelopes.first.cases[case].message_class(**values)).datagram


class Stream:
    """Numbers from a board to one listener, all the time. `sent` are all that it has sent."""

    def __init__(self, to: tuple[str, int], first: int) -> None:
        self._to = to
        self.first = first
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.sent: list[int] = []

    def _run(self) -> None:
        begin = monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
            while not self._ended.is_set():
                for _ in range(BATCH):
                    number = self.first + len(self.sent)
                    board.sendto(envelope("ph_info", ph_value=number), self._to)
                    self.sent.append(number)
                sleep(max(0.0, begin + len(self.sent) / RATE - monotonic()))

    def __enter__(self) -> Stream:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


class Basestation:
    """Takes what comes, and looks at it later: after a restart, much comes at once."""

    def __init__(self) -> None:
        self.socket = udp("127.0.0.10")
        make_room(self.socket)
        self.socket.settimeout(0.1)
        self.datagrams: list[bytes] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._ended.is_set():
            with suppress(TimeoutError):
                self.datagrams.append(self.socket.recv(1000))

    def received(self, stream: Stream) -> list[int]:
        """The numbers of a stream that have come."""
        messages: list[Any] = [WIRE.decode(datagram).message for datagram in self.datagrams]
        numbers = [int(message.ph_value) for message in messages]
        return [number for number in numbers if number // STREAM == stream.first // STREAM]

    def __enter__(self) -> Basestation:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self.socket.close()


@contextmanager
def rover(
    folder: Path, listeners: int, basestation: int, board: int, *, stamps: bool = True
) -> Iterator[ServiceManager]:
    addresses = [(host, free_port(host)) for host in HOSTS[:listeners]]
    names = (f"number_{n}: {{address: '{host}:{port}'}}" for n, (host, port) in enumerate(addresses))
    table = folder / "table.yaml"
    table.write_text(TABLE.format(root=ROOT, listeners=", ".join(names), basestation=basestation, board=board))
    with closing(ServiceManager(folder, table, *addresses, stamps=stamps)) as manager:
        yield manager


@contextmanager
def under_load(folder: Path, listeners: int) -> Iterator[tuple[ServiceManager, Basestation, list[Stream]]]:
    """A router that has routed half a second of traffic, which goes on."""
    with Basestation() as station, rover(folder, listeners, station.socket.getsockname()[1], free_port()) as manager:
        if any(room_of(held) < ROOM for held in (station.socket, *manager.sockets)):
            pytest.skip("needs net.core.rmem_max for what arrives during a restart, or root")
        manager.start()
        manager.hear("READY=1")
        streams = [Stream(held.getsockname(), STREAM * n) for n, held in enumerate(manager.sockets)]
        with ExitStack() as sending:
            for stream in streams:
                sending.enter_context(stream)
            wait_until(lambda: len(station.datagrams) > RATE / 2, "half a second of traffic")
            yield manager, station, streams
        last = {envelope("ph_info", ph_value=stream.sent[-1]) for stream in streams}
        wait_until(lambda: last <= set(station.datagrams[-5000:]), "the last datagram")
        assert manager.end(signal.SIGTERM) == 0


MATRIX = [
    (signal.SIGTERM, 2, 1),
    *(
        pytest.param(number, listeners, 2, marks=pytest.mark.slow)
        for number in (signal.SIGTERM, signal.SIGKILL)
        for listeners in (1, 2)
    ),
]


@pytest.mark.parametrize(("number", "listeners", "restarts"), MATRIX)
def test_an_orderly_restart_loses_nothing_and_a_kill_at_most_the_datagram_in_hand(
    tmp_path: Path, number: signal.Signals, listeners: int, restarts: int
) -> None:
    orderly = number == signal.SIGTERM
    with under_load(tmp_path, listeners) as (manager, station, streams):
        for _ in range(restarts):
            assert manager.end(number) == (0 if orderly else -number)
            before = len(station.datagrams)
            manager.start()
            manager.hear("READY=1")
            wait_until(lambda before=before: len(station.datagrams) > before + RATE / 4, "traffic")  # type: ignore[misc]
    for stream in streams:
        received = station.received(stream)
        assert received == sorted(set(received))
        assert len(stream.sent) - len(received) <= (0 if orderly else restarts)
    assert manager.told.count("STOPPING=1") >= restarts * orderly


@contextmanager
def board_and_operator(
    folder: Path, *, stamps: bool = True
) -> Iterator[tuple[ServiceManager, socket.socket, socket.socket]]:
    with udp("127.0.0.222") as board, udp("127.0.0.10") as operator:
        ports = operator.getsockname()[1], board.getsockname()[1]
        with rover(folder, 1, *ports, stamps=stamps) as manager:
            yield manager, board, operator


def test_what_waited_for_the_router_goes_behind_the_brake_or_nowhere_if_it_is_stale(tmp_path: Path) -> None:
    """Before its first start as well, when no router has asked for the time of arrival yet."""
    drive, arm = envelope("manual_drive", forward_backward=50), envelope("manual_arm", speed=1)
    brake = envelope("manual_brake", brake=True)
    with board_and_operator(tmp_path) as (manager, board, operator), udp("127.0.0.5") as other:
        address = manager.sockets[0].getsockname()
        manager.sockets.append(other)  # which the table does not want
        for _ in range(2):
            operator.sendto(drive, address)
            for _ in range(10):
                operator.sendto(arm, address)
            sleep(1.1)
            manager.start()
            assert [board.recv(1000) for _ in range(11)] == [brake, *[arm] * 10]
            manager.hear("READY=1")
            board.settimeout(0.5)
            while True:  # on a busy machine it may be stale again
                operator.sendto(drive, address)
                with suppress(TimeoutError):
                    while (got := board.recv(1000)) == brake:
                        pass  # the brake of the start is repeated until the first command
                    assert got == drive
                    break
            assert manager.end(signal.SIGTERM) == 0
            board.settimeout(PATIENCE)
            while (last := board.recv(1000)) == drive:
                pass
            assert last == brake
        assert f"127.0.0.5:{other.getsockname()[1]}" in manager.text()
        manager.sockets.pop()
        board.setblocking(False)
        with pytest.raises(BlockingIOError):
            board.recv(1000)


def test_what_waited_in_a_socket_without_arrival_times_is_discarded(tmp_path: Path) -> None:
    """Read later, each would look new, so an old command would release the brake."""
    drive, arm = envelope("manual_drive", forward_backward=50), envelope("manual_arm", speed=1)
    with board_and_operator(tmp_path, stamps=False) as (manager, board, operator):
        address = manager.sockets[0].getsockname()
        for each in [drive, arm] * 20:
            operator.sendto(each, address)
        sleep(1.1)
        manager.start()
        manager.hear("READY=1")
        operator.sendto(arm, address)
        assert [board.recv(1000), board.recv(1000)] == [envelope("manual_brake", brake=True), arm]
        assert '"datagrams": 40' in manager.text()
        board.settimeout(0.3)
        with pytest.raises(TimeoutError):
            board.recv(1000)
        assert manager.end(signal.SIGTERM) == 0
