"""Why a serial line cannot be opened or was closed, in words."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping

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
