"""The ends of links, serial lines and TCP connections, for tools: the router's, and the one that a board has."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from router import declared as c
from router.clock import wall_ns
from router.errors import TransportError, UsageError
from router.library import library
from router.net.links import device_holder, why_closed
from router.net.ready import readable
from router.table.addresses import LinkPlace
from router.table.model.tcp import TcpClient, TcpServer
from router.tools.link_end import OPENED_WITHIN, READ_WITHIN, LinkEnd
from router.tools.tap import PATIENCE, TappedDatagram, local_time, tapped_datagram
from router.tools.tcp_ends import Accepting, Connecting, Server
from router.tools.udp import Sent, paced, reachable

if TYPE_CHECKING:
    from router.carrier.frames import Frame
    from router.datagrams import Wire
    from router.table.model import RouteTable
    from router.table.model.endpoints import Endpoint, Listener
    from router.types.protobuf import Envelope


class Device(LinkEnd):
    """The device of a line, opened as the router does. Raises UsageError if that fails."""

    def __init__(self, line: Listener) -> None:
        serial = line.line
        assert serial is not None  # noqa: S101 - checked by the caller
        settings = c.Serial(serial.baud, c.Parity[serial.parity.name], serial.stop_bits)
        fd = library().serial_open(serial.serial.value.encode(), ctypes.byref(settings))
        if fd < 0:
            raise _not_opened(line, -fd)
        super().__init__(line, fd, serial.serial.value)

    @property
    def where(self) -> str:
        return f"to {self.place}"

    def close(self) -> None:
        with suppress(termios.error):  # it was unplugged
            termios.tcdrain(self._fd)
        super().close()


def _not_opened(line: Listener, error: int) -> UsageError:
    device = line.address.value.host
    why, remedy = why_closed(error)
    if error == errno.EBUSY and (holder := device_holder(device)):
        why, remedy = f"{holder} has it", "stop that; of a router, `router tap` shows what it receives"
    return UsageError(f"'{line.name}': cannot open {device}: {why}", remedy.replace("DEVICE", device))


class Pty(LinkEnd):
    """The other end of a line: a pty, with a link to it at the path of the line's device.

    Raises UsageError if the path is taken, or the link cannot be made.
    """

    opens_again = True

    def __init__(self, line: Listener) -> None:
        self.device = Path(line.address.value.host)
        fd, device = os.openpty()
        tty.setraw(device)  # before anybody opens it: it would echo
        self._pty = os.ttyname(device)
        self._sent_at = 0.0
        os.close(device)
        os.set_blocking(fd, False)
        super().__init__(line, fd, str(self.device))
        try:
            if self.device.is_symlink() and not self.device.exists():  # left by a simulator that was killed
                self.device.unlink()
            self.device.symlink_to(self._pty)
        except OSError as error:
            os.close(fd)
            raise _no_pty(line, error) from error

    @property
    def is_open(self) -> bool:
        """Whether somebody has opened the device."""
        poll = select.poll()
        poll.register(self._fd, 0)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    @property
    def awaited(self) -> str:
        return f"the router to open {self.place}"

    @property
    def where(self) -> str:
        return f"at {self.place}, a pty that the router can open"

    def __str__(self) -> str:
        return f"the pty {self.place}"

    def send(self, payload: bytes) -> None:
        """Likewise, but also raises OSError while nobody has opened the device."""
        if not self.is_open:
            self._begin()
            raise OSError(errno.ENOTCONN, f"nobody has opened {self.device}")  # it would wait there
        super().send(payload)
        self._sent_at = time.monotonic()

    def receive(self) -> list[Frame]:
        try:
            return super().receive()
        except OSError:
            self._begin()
            raise

    def ended(self, error: OSError) -> TransportError:
        if error.errno == errno.EMSGSIZE:
            return super().ended(error)
        return TransportError(f"the router has closed {self.place}", "its log says why")

    def close(self) -> None:
        """Close the pty after the router has had time to read it."""
        time.sleep(max(0.0, self._sent_at + READ_WITHIN - time.monotonic()))
        with suppress(OSError):  # somebody has removed the link
            if str(self.device.readlink()) == self._pty:
                self.device.unlink()
        super().close()


def _no_pty(line: Listener, error: OSError) -> UsageError:
    device = line.address.value.host
    other = f"name a table in which `serial` of {line.name} is a path in a folder of yours, such as /tmp/{line.name}"
    if isinstance(error, FileExistsError):
        what = f"{device} is there already, so the other end of '{line.name}' cannot be played"
        return UsageError(what, f"{other}, or remove it if it is left of another simulator")
    return UsageError(f"cannot make {device}, to play the other end of '{line.name}': {error.strerror}", other)


def link_of(name: str, table: RouteTable | None) -> Listener | None:
    """Return the link that is a listener of this name, or that has the endpoint of this name at its other end."""
    if table is None:
        return None
    endpoint = table.endpoints.get(name)
    listener = endpoint.listener.value if endpoint is not None and endpoint.listener is not None else name
    return next((link for link in table.links if link.name == listener), None)


def boards_at(link: Listener, table: RouteTable) -> list[Endpoint]:
    """Return the endpoints at the other end of a link: several only of a TCP server. Raises UsageError for none."""
    ends = (each for each in table.endpoints.values() if isinstance(each.address.value, LinkPlace))
    boards = [each for each in ends if each.listener is not None and each.listener.value == link.name]
    if not boards:
        raise UsageError(f"no endpoint of the table is at the other end of '{link.name}'", "add one")
    return boards


def board_end(link: Listener, board: Endpoint) -> LinkEnd:
    """Open the end of a link that a board has. Raises UsageError."""
    if isinstance(link.link, TcpClient):
        return Accepting(link, Server(link.name, link.link.connect.value), "the router")
    if isinstance(link.link, TcpServer):
        return Connecting(link, reachable(link.link.accept.value), board.address.value.host, is_patient=True)
    return Pty(link)


def router_ends(link: Listener, boards: Sequence[Endpoint]) -> list[LinkEnd]:
    """Open the router's end of a link to each of these boards. Raises UsageError."""
    if isinstance(link.link, TcpClient):
        return [Connecting(link, link.link.connect.value)]
    if isinstance(link.link, TcpServer):
        server = Server(link.name, link.link.accept.value, [board.address.value.host for board in boards])
        return [Accepting(link, server, board.name, board.address.value.host) for board in boards]
    return [Device(link)]


def send(end: LinkEnd, data: bytes, count: int | None, rate: float | None, sent: Sent) -> None:
    """Send frames like `udp.send`, once the end is open. Raises TransportError."""
    end.await_open()
    for elapsed in paced(count, rate):
        send_once(end, data)
        sent.count += 1
        sent.seconds = elapsed


def send_once(end: LinkEnd, data: bytes) -> None:
    """Discard what has arrived, send a frame, and wait until it has left. Raises TransportError."""
    try:
        end.receive()  # the router closes a TCP connection that nobody reads
        end.send(data)
        end.finish()
    except OSError as error:
        raise end.ended(error) from error


def listen(ends: Sequence[tuple[LinkEnd, str]], wire: Wire, envelope: Envelope) -> Iterator[list[TappedDatagram]]:
    """Yield what frames hold, without end; after PATIENCE without one, an empty list. Raises TransportError.

    `ends`: each with the name of who is at its other end.
    """
    peers = dict(ends)
    while True:
        opened = [end for end in peers if end.is_open]
        if not opened:
            time.sleep(OPENED_WITHIN)
            yield []
            continue
        ready = readable(opened, PATIENCE)
        yield [shown for end in ready for frame in _arrived(end) for shown in _shown(frame, peers[end], wire, envelope)]


def _arrived(end: LinkEnd) -> list[Frame]:
    try:
        return end.receive()
    except OSError as error:
        if not end.opens_again:
            raise end.ended(error) from error
        return []


def _shown(frame: Frame, peer: str, wire: Wire, envelope: Envelope) -> list[TappedDatagram]:
    at = wall_ns()
    if frame.problem:
        return [TappedDatagram(local_time(at), peer, frame.data, None, frame.problem)]
    return tapped_datagram(at, peer, frame.data, wire, envelope=envelope)
