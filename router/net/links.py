"""Why a link, a serial line or TCP connection, cannot be opened or was closed, in words; who has a device."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path

_MEANINGS: Mapping[int, tuple[str, str]] = {
    errno.ENOENT: ("its device is not there", "plug it in, or correct `serial`: `ls -l /dev/serial/by-id`"),
    errno.EACCES: ("the router may not open it", "add the router's user to the group of the device: `ls -lL DEVICE`"),
    errno.EBUSY: ("another process has its device", "`fuser -v DEVICE` names it; ModemManager takes new devices"),
    errno.ENOTTY: ("it is no serial device", "correct `serial`"),
    errno.EINVAL: ("its driver refuses the settings", "correct `baud`, `parity` and `stop_bits`"),
    errno.EPROTO: (
        "a frame was bad, and without delimiters the next one cannot be found",
        "compare `framing`, `checksum` and `baud` with the firmware's; prefer `framing: cobs`",
    ),
    **dict.fromkeys(
        (errno.EIO, errno.ENXIO, errno.ENODEV),
        ("its device was unplugged", "check plug and power; `dmesg` says more"),
    ),
    errno.ENOTCONN: ("it has not connected yet", "check its power and network, and the address that it connects to"),
    errno.ECONNABORTED: ("it has connected again", "if that goes on, look whether two boards have its address"),
    errno.ECONNREFUSED: ("nothing listens there", "start its program, or correct `connect`"),
    errno.EADDRINUSE: ("another process has the port of the server", "`ss -ltnp` names it"),
    errno.EADDRNOTAVAIL: ("the server's address does not exist here", "`ip -br address` shows those that do"),
    errno.ENONET: ("its network interface is not there", "check plug and name: `ip -br link` shows those that are"),
    errno.ETIMEDOUT: ("it does not answer", "check its power and network"),
    **dict.fromkeys(
        (errno.EHOSTUNREACH, errno.ENETUNREACH),
        ("it cannot be reached", "check its power, cable or radio, and address"),
    ),
    **dict.fromkeys(
        (errno.ECONNRESET, errno.EPIPE), ("the other end has closed the connection", "its log may say why")
    ),
}


def why_closed(error: int) -> tuple[str, str]:
    """Return the meaning of an errno, with a remedy."""
    return _MEANINGS.get(error) or (os.strerror(error), "`dmesg` may say more")


def device_holder(device: str) -> str:
    """Return a process that has a device open, `python (pid 4711)`; "" if /proc shows none.

    Locked devices are shown to every user, others only to the user of the process and to root.
    """
    from router.net.kernel import described, open_files

    path = os.path.realpath(device)
    locked = _locked_by(path)
    holders = (each for each in Path("/proc").glob("[0-9]*") if path in open_files(each))
    holder = Path("/proc", locked) if locked else next(holders, None)
    return described(holder) if holder is not None else ""


def _locked_by(path: str) -> str:
    """Return the pid of the process that has locked a file, as routers do; "" if nobody has."""
    try:
        found = Path(path).stat()
        locks = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return ""
    place = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
    rows = (line.split() for line in locks if " FLOCK " in line)
    return next((row[4] for row in rows if place in row and row[4].isdigit() and row[4] != "0"), "")
