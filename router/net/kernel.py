"""What Linux tells of a UDP socket, and the socket module does not: when a datagram arrived, and what was dropped.

And of a network interface: whether it is there and up, and its address.
"""

from __future__ import annotations

import fcntl
import socket
import struct
from collections.abc import Callable
from contextlib import suppress

# Linux values that the socket module does not name.
SO_RCVBUFFORCE = 33
SO_MEMINFO = 55
SIOCGSTAMPNS = 0x8907
SIOCGIFFLAGS = 0x8913
SIOCGIFADDR = 0x8915
IFF_UP = 0x1
IFNAMSIZ = 16
_IFREQ = struct.Struct("16s24s")
_TIMESPEC = struct.Struct("@ll")
_MEMINFO = struct.Struct("9I")
_MEMINFO_DROPS = 8


def arrivals(opened: socket.socket) -> Callable[[], int]:
    """From now on the kernel stamps what arrives. Returns what tells when it got the datagram last received, in ns of
    the wall clock.

    The time that it lay in the receive buffer does not count. Costs a system call, and receiving costs nothing
    more for it. For the thread that receives; raises FileNotFoundError before the first datagram.
    """
    stamp = bytearray(_TIMESPEC.size)

    def arrived_at() -> int:
        fcntl.ioctl(opened, SIOCGSTAMPNS, stamp)
        seconds, nanoseconds = _TIMESPEC.unpack(stamp)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    with suppress(FileNotFoundError):  # nothing was received yet, but now that it was asked the kernel stamps
        arrived_at()
    return arrived_at


def drops(opened: socket.socket) -> int:
    """Datagrams that the kernel threw away before anybody received them, since the socket was opened."""
    words = _MEMINFO.unpack(opened.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size))
    return int(words[_MEMINFO_DROPS])


def ask_for_receive_buffer(opened: socket.socket, size: int) -> int:
    """Asks for `size` bytes, past the system's limit where that is allowed. Returns how many were granted."""
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
    if (granted := receive_buffer(opened)) >= size:
        return granted
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, size)
    except PermissionError:
        return granted
    return size


def receive_buffer(opened: socket.socket) -> int:
    """Its size in bytes, as it is asked for."""
    # The kernel counts its own overhead too: it doubles what was asked for, and tells the doubled value.
    return opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def bound_interface(opened: socket.socket) -> str | None:
    """The network interface that a socket is bound to, empty for none; None where that interface has gone."""
    try:
        return opened.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, IFNAMSIZ).rstrip(b"\0").decode()
    except OSError:
        return None


def interface_is_up(name: str) -> bool | None:
    """Whether it is; None where there is no such network interface."""
    answer = _ask_interface(name, SIOCGIFFLAGS)
    return None if answer is None else bool(int.from_bytes(answer[:2], "little") & IFF_UP)


def interface_address(name: str) -> str | None:
    """Its first IPv4 address, if there is one."""
    answer = _ask_interface(name, SIOCGIFADDR)
    return None if answer is None else socket.inet_ntoa(answer[4:8])


def _ask_interface(name: str, request: int) -> bytes | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        try:
            answer = fcntl.ioctl(asking, request, _IFREQ.pack(name.encode(), b""))
        except OSError:
            return None
    return bytes(_IFREQ.unpack(answer)[1])
