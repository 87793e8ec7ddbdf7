"""Checks of serial lines: is the device there, may this user open it, and who else has it or takes it.

Devices are not opened: that resets many boards.
"""

from __future__ import annotations

import errno
import grp
import os
import pwd
import stat
from collections.abc import Iterator
from pathlib import Path

from router.compiler.compiled_table import CompiledTable
from router.errors import did_you_mean
from router.net.kernel import processes_called
from router.net.links import device_holder, why_closed
from router.tools.doctor_checks import CheckResult, fine, page, problem, warning

BY_ID = Path("/dev/serial/by-id")
CHARACTER_DEVICES = Path("/sys/dev/char")
UDEV = Path("/run/udev/data")
MODEM_MANAGER = "ModemManager"
_USB = "ttyUSB", "ttyACM"


def lines(program: CompiledTable, *, running: bool) -> Iterator[CheckResult]:
    """Check the devices of serial lines. A `running` router may have another user, and has the devices."""
    for line in program.table.lines:
        device = Path(line.address.value.host)
        about = f"listener '{line.name}'"
        if (found := _of_device(device, about)) is not None:
            yield found
            continue
        holder = device_holder(str(device))
        if holder and not running:
            what = f"{about} cannot open {device}: {holder} has it"
            yield problem("listeners", what, "stop that program; the router waits for the device")
        elif not running and (refused := _refused(device)):
            yield problem("listeners", f"{about} cannot open {device}: this user may not", refused)
        else:
            yield fine("listeners", f"{about}: {device} is there" + (f"; {holder} has it" if holder else ""))
        yield from _taken_for_a_modem(device, about)


def _of_device(device: Path, about: str) -> CheckResult | None:
    """Return a finding for a device that is missing, or is no serial device."""
    try:
        found = device.stat()
    except OSError as error:
        why, remedy = why_closed(error.errno or 0)
        if device.parent == BY_ID and BY_ID.exists():
            remedy = did_you_mean(device.name, [each.name for each in BY_ID.iterdir()], closeness=0.8) or remedy
        what = f"{about} cannot open {device}: {why}"
        return warning("listeners", what, f"{remedy.replace('DEVICE', str(device))}; the router waits for it")
    if stat.S_ISCHR(found.st_mode):
        kind = CHARACTER_DEVICES / f"{os.major(found.st_rdev)}:{os.minor(found.st_rdev)}" / "subsystem"
        if not kind.exists() or kind.resolve().name == "tty":  # ptys have no entry
            return None
    why, remedy = why_closed(errno.ENOTTY)
    return problem("listeners", f"{about} cannot open {device}: {why}", remedy)


def _refused(device: Path) -> str:
    """Return how this user gets access to a device; "" if it has that."""
    if os.access(device, os.R_OK | os.W_OK):
        return ""
    found, user = device.stat(), pwd.getpwuid(os.geteuid()).pw_name
    if not found.st_gid or found.st_mode & 0o060 != 0o060:
        return f"have a udev rule give it a group that may write it, such as dialout: {_guide()}"
    group = grp.getgrgid(found.st_gid)
    if user in group.gr_mem:
        return f"log in again: {user} has been added to the group {group.gr_name} since"
    return f"run `sudo usermod -aG {group.gr_name} {user}`, and log in again"


def _taken_for_a_modem(device: Path, about: str) -> Iterator[CheckResult]:
    """Warn of ModemManager, unless a udev rule tells it to leave the device alone."""
    name = device.resolve().name
    if not name.startswith(_USB) or not any(processes_called(MODEM_MANAGER)):
        return
    number = device.stat().st_rdev
    try:
        properties = (UDEV / f"c{os.major(number)}:{os.minor(number)}").read_text()
    except OSError:  # in a container
        properties = ""
    if "E:ID_MM_DEVICE_IGNORE=1" not in properties:
        what = f"{about}: {MODEM_MANAGER} runs, which may have {device} for seconds and send it modem commands"
        yield warning("listeners", what, f"write a udev rule with ID_MM_DEVICE_IGNORE: {_guide()}")


def _guide() -> str:
    return page("docs/guides/serial-line.md#on-the-rover")
