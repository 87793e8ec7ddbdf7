"""Linux features that Python's socket module lacks: arrival times, drops, buffers, interfaces, the owner of a port."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache

from router.clock import wall_ns
from router.hosts import with_port
from router.log import logger
from router.net.addresses import bound_address

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pathlib import Path

    from router.errors import StartError

# Linux constants that the socket module does not name.
SO_ATTACH_FILTER = 26
SO_TIMESTAMP = 29
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SO_MEMINFO = 55
IP_MTU_DISCOVER = 10
IP_PMTUDISC_DONT = 0
IP_RECVERR = 11
IP_FREEBIND = 15
IP_MULTICAST_ALL = 49
IPV6_RECVERR = 25
IPV6_MULTICAST_ALL = 29
SIOCGSTAMPNS = 0x8907
SIOCGIFFLAGS = 0x8913
SIOCGIFADDR = 0x8915
IFF_UP = 0x1
IFNAMSIZ = 16
_IFREQ = struct.Struct("16s24s")
_TIMESPEC = struct.Struct("@ll")
_MEMINFO = struct.Struct("9I")
_MEMINFO_DROPS = 8
FIRST_OF_ROS = 7000
"""The lowest UDP port that ROS takes (`net.dds`)."""
BELOW_ROS = f"choose a port below {FIRST_OF_ROS}, here and in what sends to it"

_LINK_LOCAL = "20"
"""The scope of link-local addresses in /proc/net/if_inet6."""

_INODE = 9
"""Column of the inode in /proc/net/udp and /proc/net/tcp."""

_BOUND = {"udp": ("07", "01"), "tcp": ("0A",)}
"""States in /proc/net of sockets that keep others from binding their port: a UDP socket also if it is connected."""


def send_arrivals(opened: socket.socket) -> None:
    """Have the kernel deliver arrival times with datagrams, or else keep them for a system call."""
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    except OSError as error:
        if error.errno != errno.ENOPROTOOPT:
            raise
        _warn_once("the kernel does not send arrival times with datagrams: each datagram costs one more system call")
        arrivals(opened)


def discard_unstamped(opened: socket.socket) -> None:
    """Discard what is queued in a socket that does not note arrivals, with a warning: read later, it would look new."""
    if any(opened.getsockopt(socket.SOL_SOCKET, option) for option in (SO_TIMESTAMPNS, SO_TIMESTAMP)):
        return
    count = 0
    with suppress(BlockingIOError):
        while True:
            opened.recv(1, socket.MSG_DONTWAIT)
            count += 1
    if count:
        logger.warning(
            "datagrams of unknown age waited in an inherited socket and were discarded",
            address=with_port(*bound_address(opened)),
            datagrams=count,
            remedy="write Timestamping=ns in its socket unit",
        )


def arrivals(opened: socket.socket) -> Callable[[], int]:
    """Have the kernel stamp datagrams. Return a function for the arrival (wall clock, ns) of the last received one.

    That is when the kernel put it into the receive buffer, or the present time if the kernel cannot stamp. The function
    makes one system call and is for the receiving thread. It raises FileNotFoundError before the first datagram.
    """
    stamp = bytearray(_TIMESPEC.size)

    def arrived_at() -> int:
        fcntl.ioctl(opened, SIOCGSTAMPNS, stamp)
        seconds, nanoseconds = _TIMESPEC.unpack(stamp)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    try:
        arrived_at()
    except FileNotFoundError:  # nothing was received yet, but stamping is now on
        pass
    except OSError:
        _warn_once("the kernel provides no arrival times: 'ttl' ignores the time spent in the receive buffer")
        return wall_ns
    return arrived_at


@cache
def _warn_once(event: str) -> None:
    logger.warning(event)


def drops(opened: socket.socket) -> int:
    """Return the number of datagrams that the kernel has dropped since the socket was opened.

    Raises OSError for a closed socket.
    """
    # Linux before 4.12 lacks this, and qemu-user returns one word: use the table of all sockets then.
    with suppress(OSError, struct.error):
        words = _MEMINFO.unpack(opened.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size))
        return int(words[_MEMINFO_DROPS])
    inode = str(os.fstat(opened.fileno()).st_ino)
    return next((int(row[-1]) for row in _rows("udp") if row[_INODE] == inode), 0)


def ask_for_receive_buffer(opened: socket.socket, size: int) -> int:
    """Request `size` bytes, above the system's limit where that is allowed. Return the granted size."""
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
    if (granted := receive_buffer(opened)) >= size:
        return granted
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, size)
    except PermissionError:
        return granted
    return size


def receive_buffer(opened: socket.socket) -> int:
    """Return the size in bytes, without the kernel's overhead."""
    # The kernel doubles the requested size, to cover its overhead, and returns the doubled value.
    return opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def bound_interface(opened: socket.socket) -> str | None:
    """Return the network interface that a socket is bound to, "" for none; None if the interface is gone."""
    try:
        return opened.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, IFNAMSIZ).rstrip(b"\0").decode()
    except OSError:
        return None


def report_sending_errors(opened: socket.socket) -> None:
    """Have the kernel report ICMP errors about datagrams sent from the socket's port."""
    opened.setsockopt(socket.IPPROTO_IP, IP_RECVERR, 1)
    if opened.family == socket.AF_INET6:
        opened.setsockopt(socket.IPPROTO_IPV6, IPV6_RECVERR, 1)


def allow_fragments(opened: socket.socket) -> None:
    """Clear "don't fragment" in the IPv4 datagrams that a socket sends.

    By default Linux sets it and learns a path's MTU from ICMP errors: where those are filtered, large datagrams vanish.
    IPv6 has no such flag: only the sender fragments, to the MTU that it has learned.
    """
    opened.setsockopt(socket.IPPROTO_IP, IP_MTU_DISCOVER, IP_PMTUDISC_DONT)


def refuse_input(opened: socket.socket) -> None:
    """Have the kernel drop everything that a socket would receive: a filter of one instruction returns 0 bytes."""
    instruction = ctypes.create_string_buffer(struct.pack("@HBBI", 6, 0, 0, 0))
    program = struct.pack("@HP", 1, ctypes.addressof(instruction))
    opened.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, program)


def interface_is_up(name: str) -> bool | None:
    """Return whether a network interface is up; None if there is no such interface."""
    answer = _ask_interface(name, SIOCGIFFLAGS)
    return None if answer is None else bool(int.from_bytes(answer[:2], "little") & IFF_UP)


def interface_address(name: str, family: socket.AddressFamily = socket.AF_INET) -> str | None:
    """Return the first IPv4 or IPv6 address of a network interface, or None. A link-local one only without another."""
    if family == socket.AF_INET6:
        return next((host for _, host in sorted(_ipv6_addresses(name))), None)
    answer = _ask_interface(name, SIOCGIFADDR)
    return None if answer is None else socket.inet_ntoa(answer[4:8])


def _ipv6_addresses(interface: str) -> Iterator[tuple[bool, str]]:
    """Yield whether it is link-local, and the address, for each IPv6 address of a network interface."""
    from pathlib import Path

    with suppress(FileNotFoundError):  # a kernel without IPv6
        for row in Path("/proc/net/if_inet6").read_text().splitlines():
            address, _, _, scope, _, name = row.split()
            if name == interface:
                host = socket.inet_ntop(socket.AF_INET6, bytes.fromhex(address))
                yield scope == _LINK_LOCAL, f"{host}%{name}" if scope == _LINK_LOCAL else host


def _ask_interface(name: str, request: int) -> bytes | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        try:
            answer = fcntl.ioctl(asking, request, _IFREQ.pack(name.encode(), b""))
        except OSError:
            return None
    return bytes(_IFREQ.unpack(answer)[1])


def port_taken(protocol: str, port: int) -> tuple[str, str]:
    """Return which process has a port, and the remedy, for an error message. `protocol` is udp or tcp."""
    process = _process(protocol, port)
    if not _is_this(process):
        return f"{described(process)} has the port", "stop it, or choose another port"
    from router.net.dds import is_of_ros

    if protocol == "udp" and is_of_ros(port, os.environ):
        return f"the ROS node of the router itself (pid {os.getpid()}) has the port", BELOW_ROS
    return f"the router itself (pid {os.getpid()}) has the port", "restart it, or choose another port"


def _is_this(process: Path | None) -> bool:
    return process is not None and process.name == str(os.getpid())


def why_not_bound(protocol: str, port: int, error: OSError) -> tuple[type[StartError], str, str]:
    """Return why a socket cannot be bound: the class of error, the reason, and the remedy, if any.

    `protocol` is udp or tcp. A missing privilege does not pass by itself, nor does a port that this process has.
    """
    from router.errors import ConfigurationError, StartError

    if error.errno == errno.EADDRINUSE:
        is_ours = _is_this(_process(protocol, port))
        return ConfigurationError if is_ours else StartError, *port_taken(protocol, port)
    if error.errno == errno.EACCES:
        remedy = "choose a higher port, or grant CAP_NET_BIND_SERVICE"
        return ConfigurationError, "ports below 1024 need a privilege", remedy
    is_absent = error.errno == errno.EADDRNOTAVAIL
    kind = ConfigurationError if error.errno == errno.EPERM else StartError
    return kind, "this machine has no such address" if is_absent else error.strerror or str(error), ""


def port_holder(protocol: str, port: int) -> str:
    """Return `python (pid 4711)`, or "another process" if /proc does not show it. `protocol` is udp or tcp."""
    return described(_process(protocol, port))


def port_holders(protocol: str, port: int) -> list[str]:
    """Return all processes that /proc shows to have a port: `python (pid 4711)`. `protocol` is udp or tcp."""
    return [described(process) for process in _processes(protocol, port)]


def described(process: Path | None) -> str:
    """Return `python (pid 4711)`, or "another process"."""
    return f"{_name(process)} (pid {process.name})" if process is not None else "another process"


def _process(protocol: str, port: int) -> Path | None:
    return next(_processes(protocol, port), None)


def _processes(protocol: str, port: int) -> Iterator[Path]:
    from pathlib import Path

    wanted = {f"socket:[{inode}]" for inode in _inodes(protocol, port)}
    processes = Path("/proc").glob("[0-9]*")
    return (process for process in processes if not wanted.isdisjoint(open_files(process)))


def _inodes(protocol: str, port: int) -> Iterator[str]:
    for table in protocol, f"{protocol}6":
        for row in _rows(table):
            local, state, inode = row[1], row[3], row[_INODE]
            if state in _BOUND[protocol] and int(local.rpartition(":")[2], 16) == port:
                yield inode


def _rows(table: str) -> Iterator[list[str]]:
    """Yield the rows of a table in /proc/net, as lists of columns. The kernel may have no table for IPv6."""
    from pathlib import Path

    with suppress(FileNotFoundError):
        yield from (line.split() for line in Path("/proc/net", table).read_text().splitlines()[1:])


def processes_called(name: str) -> Iterator[Path]:
    """Yield the processes of this name, as directories of /proc."""
    from pathlib import Path

    return (process for process in Path("/proc").glob("[0-9]*") if _name(process) == name)


def open_files(process: Path) -> Iterator[str]:
    """Yield what the descriptors of a process refer to, of those that may be seen."""
    try:
        descriptors = list((process / "fd").iterdir())
    except OSError:  # another user's process, or one that just ended
        return
    for descriptor in descriptors:
        with suppress(OSError):  # closed meanwhile, like the descriptor of the listing itself
            yield str(descriptor.readlink())


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text().strip()
    except OSError:
        return "a process"
