"""The two ends of serial lines, for tools: the device, and a pty in its place, at which the other end is played."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from router import declared as c
from router.carrier.frames import Codec, Frame
from router.clock import wall_ns
from router.errors import TransportError, UsageError
from router.image.openings import framing_of
from router.library import library
from router.net.links import device_holder, why_closed
from router.tools.tap import PATIENCE, TappedDatagram, local_time, tapped_datagram
from router.tools.udp import Sent, paced

if TYPE_CHECKING:
    from router.datagrams import Wire
    from router.table.model import RouteTable
    from router.table.model.endpoints import Listener
    from router.types.protobuf import Envelope

READ_AT_ONCE = 65536

OPENED_WITHIN = 0.02
"""Seconds after which it is noticed that the router has opened a line."""

READ_WITHIN = 0.2
"""Seconds in which the router reads what was sent. Closing a pty discards the rest."""


class LineEnd:
    """One end of a serial line. It never blocks. `name` is for people."""

    def __init__(self, line: Listener, fd: int) -> None:
        assert line.line is not None  # noqa: S101 - checked by the caller
        self.name = line.name
        self.device = Path(line.line.serial.value)
        self._fd = fd
        self._codec = Codec(framing_of(line.line))
        self._rest = b""

    def fileno(self) -> int:
        return self._fd

    def send(self, payload: bytes) -> None:
        """Send a frame. Raises BlockingIOError if an earlier one is still waiting, OSError if it cannot be sent."""
        self._flush()
        if self._rest:
            raise BlockingIOError(errno.EAGAIN, "the line is full")
        self._rest = self._codec.write(payload)
        if not self._rest:
            raise OSError(errno.EMSGSIZE, os.strerror(errno.EMSGSIZE))
        self._flush()

    def finish(self) -> None:
        """Wait until what was sent has left. Raises OSError."""
        while self._rest:
            select.select([], [self._fd], [], PATIENCE)
            self._flush()

    def _flush(self) -> None:
        with suppress(BlockingIOError):
            self._rest = self._rest[os.write(self._fd, self._rest) :]

    def receive(self) -> list[Frame]:
        """Return the frames that are complete with the bytes that have arrived. Raises OSError at the stream's end."""
        try:
            data = os.read(self._fd, READ_AT_ONCE)
        except BlockingIOError:
            return []
        if not data:
            raise OSError(errno.EIO, os.strerror(errno.ENOTCONN))
        return [*self._codec.read(data)]

    def close(self) -> None:
        os.close(self._fd)


class Device(LineEnd):
    """The device of a line, opened as the router does. Raises UsageError if that fails."""

    def __init__(self, line: Listener) -> None:
        serial = line.line
        assert serial is not None  # noqa: S101 - checked by the caller
        settings = c.Serial(serial.baud, c.Parity[serial.parity.name], serial.stop_bits)
        fd = library().serial_open(serial.serial.value.encode(), ctypes.byref(settings))
        if fd < 0:
            raise _not_opened(line, -fd)
        super().__init__(line, fd)

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


class Pty(LineEnd):
    """The other end of a line: a pty, with a link to it at the path of the line's device.

    Raises UsageError if the path is taken, or the link cannot be made.
    """

    def __init__(self, line: Listener) -> None:
        fd, device = os.openpty()
        tty.setraw(device)  # before anybody opens it: it would echo
        self._pty = os.ttyname(device)
        self._sent_at = 0.0
        os.close(device)
        os.set_blocking(fd, False)
        super().__init__(line, fd)
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

    def await_opened(self) -> None:
        while not self.is_open:
            time.sleep(OPENED_WITHIN)

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

    def _begin(self) -> None:
        self._codec.begin()
        self._rest = b""

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


def line_of(name: str, table: RouteTable | None) -> Listener | None:
    """Return the line that is a listener of this name, or that has the endpoint of this name at its other end."""
    if table is None:
        return None
    endpoint = table.endpoints.get(name)
    listener = endpoint.listener.value if endpoint is not None and endpoint.listener is not None else name
    return next((line for line in table.lines if line.name == listener), None)


def end_of(line: Listener, *, is_board: bool) -> LineEnd:
    """Open the end of a line that the board has, or the router's. Raises UsageError."""
    return Pty(line) if is_board else Device(line)


def board_at(line: Listener, table: RouteTable) -> str:
    """Return the endpoint at the other end of a line, or the line's own name if the table lacks one."""
    ends = {each.listener.value: each.name for each in table.endpoints.values() if each.listener is not None}
    return ends.get(line.name, line.name)


def send(end: LineEnd, data: bytes, count: int | None, rate: float | None, sent: Sent) -> None:
    """Send frames like `udp.send`. At a pty, first wait until the router has opened it. Raises TransportError."""
    if isinstance(end, Pty):
        end.await_opened()
    for elapsed in paced(count, rate):
        send_once(end, data)
        sent.count += 1
        sent.seconds = elapsed


def send_once(end: LineEnd, data: bytes) -> None:
    """Send a frame, and wait until it has left. Raises TransportError."""
    try:
        end.send(data)
        end.finish()
    except OSError as error:
        raise _ended(end, error) from error


def listen(end: LineEnd, peer: str, wire: Wire, envelope: Envelope) -> Iterator[list[TappedDatagram]]:
    """Yield what frames hold, without end; after PATIENCE without one, an empty list. Raises TransportError."""
    while True:
        if isinstance(end, Pty) and not end.is_open:
            time.sleep(OPENED_WITHIN)
            yield []
            continue
        select.select([end], [], [], PATIENCE)
        try:
            frames = end.receive()
        except OSError as error:
            if not isinstance(end, Pty):
                raise _ended(end, error) from error
            frames = []
        yield [shown for frame in frames for shown in _shown(frame, peer, wire, envelope)]


def _shown(frame: Frame, peer: str, wire: Wire, envelope: Envelope) -> list[TappedDatagram]:
    at = wall_ns()
    if frame.problem:
        return [TappedDatagram(local_time(at), peer, frame.data, None, frame.problem)]
    return tapped_datagram(at, peer, frame.data, wire, envelope=envelope)


def _ended(end: LineEnd, error: OSError) -> TransportError:
    if error.errno == errno.EMSGSIZE:
        return TransportError(f"'{end.name}': its framing has no length for so many bytes")
    if isinstance(end, Pty):
        return TransportError(f"the router has closed {end.device}", "its log says why")
    why, remedy = why_closed(error.errno or 0)
    return TransportError(f"'{end.name}' is closed: {why}", remedy)
