"""Why a serial line cannot be opened or was closed, in words, and who has its device."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path

_MEANINGS: Mapping[int, tuple[str, str]] = {
    errno.ENOENT: ("its device is not there", "plug it in, or correct `serial`: `ls -l /dev/serial/by-id`"),
    errno.EACCES: ("the router may not open its device", "add its user to the group of the device: `ls -lL DEVICE`"),
    errno.EBUSY: ("another process has its device", "`fuser -v DEVICE` names it; ModemManager takes new devices"),
    errno.ENOTTY: ("it is no serial device", "correct `serial`"),
    errno.EINVAL: ("its driver refuses the settings", "correct `baud`, `parity` and `stop_bits`"),
    errno.EPROTO: (
        "a frame was bad, and without delimiters the next one cannot be found",
        "compare `framing`, `checksum` and `baud` with the firmware's; prefer `framing: cobs`",
    ),
    **dict.fromkeys(
        (errno.EIO, errno.ENXIO, errno.ENODEV, errno.ENOTCONN),
        ("its device was unplugged", "check plug and power; `dmesg` says more"),
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
